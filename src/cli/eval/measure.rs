//! Measure recall on a data set.

use super::args::{DataArgs, MethodArgs, OutputArgs, SequenceArgs};
use super::{describe, open_describer, write};
use crate::cli::model_args::ModelOptions;
use crate::cli::output::{note, say_part};
use crate::cli::progress::ProgressBars;
use anyhow::{Context, bail, ensure};
use maud::html;
use placeformer_core::types::{Calibration, ConfidenceCurve, ScoreKind};
use placeformer_lab::datasets::{Dataset, DatasetKind};
use placeformer_lab::eval::ablate::{Ablation, Base, ablate};
use placeformer_lab::eval::answers::DatasetAnswers;
use placeformer_lab::eval::calibrate::shipped_curve;
use placeformer_lab::eval::features::{Describe, ModelDescriber};
use placeformer_lab::eval::own_places::{LeaveOut, OwnPlaces};
use placeformer_lab::eval::report::{Painter, gallery};
use placeformer_lab::eval::run::Answer;
use placeformer_lab::eval::sequences::{SequenceRun, measure_sequences};
use placeformer_lab::eval::summarise::summarise;
use placeformer_lab::eval::summary::{RunConfig, Summary};
use placeformer_lab::eval::{EvalError, prediction, report};
use placeformer_models::built_in_calibration;
use placeformer_vision::extract::ExtractConfig;
use placeformer_vision::rerank::{Ranking, RerankConfig, Reranker, feature_names};
use std::path::Path;

/// Arguments of an evaluation without a further subcommand.
#[derive(Debug, clap::Args)]
pub(super) struct MeasureArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    sequences: SequenceArgs,
    #[command(flatten)]
    output: OutputArgs,
}

/// Runs it.
pub(super) fn run(args: MeasureArgs) -> anyhow::Result<()> {
    args.method.rerank.check()?;
    args.sequences.options(args.method.seed)?;
    let dataset = args.data.load()?;
    let extract = args.model.extract_config()?;
    let describer = open_describer(&extract)?;
    let (answers, summary) = measure(&args, &dataset, &describer)?;
    say_part!("{}", report::text(&summary))?;
    if let Some(path) = &args.output.predictions {
        write_predictions(path, &args, &dataset, &answers.answers)?;
    }

    let mut ablation = None;
    let mut json = serde_json::to_value(&summary)?;
    if args.method.ablate {
        let Ablation { rows, left_out } = run_ablation(&args, &dataset, &extract)?;
        for row in left_out {
            note!("left out {row} (--patch-memory)");
        }
        say_part!("\n{}", report::ablation_text(&rows))?;
        ablation = Some(report::ablation_html(&rows));
        json["ablation"] = serde_json::to_value(&rows)?;
    }
    if let Some(path) = &args.output.json {
        write(path, &(serde_json::to_string_pretty(&json)? + "\n"))?;
    }
    if let Some(path) = &args.output.html {
        let reranker = Reranker::new(args.method.rerank.config());
        let painter = Painter {
            extractor: &describer.extractor,
            limits: &describer.limits,
            reranker: &reranker,
        };
        let gallery = gallery(&painter, &dataset, &answers.answers, args.output.pictures)?;
        let details = html! {
            @if let Some(ablation) = ablation { (ablation) }
            (gallery)
        };
        write(path, &report::html(&summary, &dataset, &answers, &details))?;
    }
    Ok(())
}

/// Describes the data set, answers its queries and measures the answers.
fn measure(
    args: &MeasureArgs,
    dataset: &Dataset,
    describer: &ModelDescriber,
) -> anyhow::Result<(DatasetAnswers, Summary)> {
    let method = &args.method;
    let extractor = &describer.extractor;
    let config = RunConfig {
        model: extractor.model_id().clone(),
        global: method.global,
        candidates: method.rerank.candidates,
        extract: extractor.config().clone(),
        rerank: (!method.no_rerank).then(|| method.rerank.config()),
        bootstrap: method.bootstrap,
        seed: method.seed,
    };
    let mut given = None;
    if let Some(path) = &method.calibration {
        let calibration = read_calibration(path)?;
        config.check_calibration(&calibration)?;
        given = Some(calibration);
    }
    let mut own = None;
    if method.leave_out {
        own = OwnPlaces::of(dataset, LeaveOut::Always, args.data.radius);
        note!("each query is also asked with its own place left out of the database");
    }

    let progress = ProgressBars::default();
    let cache = &args.output.cache;
    let described = describe(describer, cache, dataset, method.global, &progress)?;
    let mut answers = described.answer(
        dataset,
        own.as_ref(),
        config.candidates,
        config.rerank.as_ref(),
        &progress,
    )?;
    order(&mut answers, &config, given.as_ref())?;
    let mut summary = summarise(
        dataset,
        &described.database,
        &described.queries,
        &answers,
        config,
        given.as_ref(),
    );
    if let Some(options) = args.sequences.options(method.seed)? {
        let config = summary.config.clone();
        let score = config.rerank.as_ref().map(|rerank| rerank.score);
        ensure!(
            score.is_none_or(|score| score == ScoreKind::Paper),
            "--sequences measures tracks by S: leave --score out"
        );
        let run = SequenceRun {
            dataset,
            described: &described,
            answers: &answers,
            rerank: config.rerank.as_ref(),
            curve: &curve(&config, given.as_ref())?,
            options,
        };
        measure_sequences(&run, &mut summary)?;
    }
    Ok((answers, summary))
}

/// What turns scores into confidences: the calibration given, or else the model's own.
fn curve(config: &RunConfig, given: Option<&Calibration>) -> anyhow::Result<ConfidenceCurve> {
    if let Some(given) = given {
        return Ok(given.curve(config.rerank.is_some()).clone());
    }
    let rerank = config.rerank.as_ref().map(RerankConfig::id);
    shipped_curve(&config.model, rerank.as_ref()).context(
        "the model has no calibration for this re-ranking, which tracks need: fit one with \
         `eval calibrate --out`, and give it with --calibration",
    )
}

/// Orders the candidates by the score of `config`. A learned one comes from the calibration given,
/// or from the model's own.
fn order(
    answers: &mut DatasetAnswers,
    config: &RunConfig,
    given: Option<&Calibration>,
) -> anyhow::Result<()> {
    let Some(rerank) = &config.rerank else {
        return Ok(());
    };
    match rerank.score {
        ScoreKind::Paper => {}
        ScoreKind::Fused => answers.order_by(&Ranking::Fused),
        ScoreKind::Learned => {
            let shipped = built_in_calibration(&config.model);
            let calibrations = given.into_iter().chain(shipped.as_ref());
            let mut learned = calibrations.filter_map(Calibration::learned_score);
            let score = learned.next().context(
                "the model has no learned score: give one of eval calibrate by --calibration",
            )?;
            score.check_features(&feature_names(&rerank.scales))?;
            answers.order_by(&Ranking::Learned(score));
        }
    }
    Ok(())
}

fn read_calibration(path: &Path) -> anyhow::Result<Calibration> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    serde_json::from_str(&text).with_context(|| format!("{} is no calibration", path.display()))
}

fn write_predictions(
    path: &Path,
    args: &MeasureArgs,
    dataset: &Dataset,
    answers: &[Answer],
) -> anyhow::Result<()> {
    match args.data.dataset {
        Some(DatasetKind::MslsTest | DatasetKind::MslsVal) => {
            let unanswered = prediction::write_msls(path, dataset, answers)?;
            if unanswered > 0 {
                note!(
                    "warning: {unanswered} of the queries could not be answered; their lines name \
                     references that mean nothing, because the official evaluation wants a line \
                     for every query"
                );
            }
        }
        Some(DatasetKind::RobotcarSeasonsV2) => prediction::write_robotcar(path, dataset, answers)?,
        _ => bail!("only MSLS and RobotCar Seasons have a prediction file"),
    }
    note!("wrote {}", path.display());
    Ok(())
}

fn run_ablation(
    args: &MeasureArgs,
    dataset: &Dataset,
    extract: &ExtractConfig,
) -> anyhow::Result<Ablation> {
    let rerank = args.method.rerank.config();
    let mut backbones = vec![extract.preset];
    for &preset in &args.method.backbones {
        if preset != extract.preset {
            backbones.push(preset);
        }
    }
    let base = Base {
        extract,
        rerank: &rerank,
        candidates: args.method.rerank.candidates,
        backbones: &backbones,
        cache: &args.output.cache.folder()?,
        memory_bytes: args.output.cache.memory_bytes(),
        radius_m: args.data.radius,
    };
    let open = |config: &ExtractConfig| -> Result<Box<dyn Describe>, EvalError> {
        match open_describer(config) {
            Ok(describer) => Ok(Box::new(describer)),
            Err(error) => Err(EvalError::Setting(format!("{error:#}"))),
        }
    };
    Ok(ablate(dataset, &base, &open, &ProgressBars::default())?)
}

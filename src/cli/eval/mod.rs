//! Measure recall on a data set, or calibrate confidences on it.

mod calibrate;

use super::data_args::ReadArgs;
use super::model_args::ModelOptions;
use crate::cli::output::say_part;
use crate::cli::progress::ProgressBars;
use anyhow::{Context, bail, ensure};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use placeformer_core::types::{Calibration, ModelId, ScaleSet};
use placeformer_lab::datasets::{self, Dataset, DatasetKind, DatasetOptions};
use placeformer_lab::eval::ablate::{Ablation, Base, ablate};
use placeformer_lab::eval::calibrate::{LeaveOut, OwnPlaces};
use placeformer_lab::eval::features::{
    Describe, FeatureCache, Features, GlobalKind, ModelDescriber,
};
use placeformer_lab::eval::report::{Painter, gallery};
use placeformer_lab::eval::run::{Answer, QuerySeconds, rerank_all, search_all};
use placeformer_lab::eval::summary::{Asked, RunConfig, Summary, summarise};
use placeformer_lab::eval::{EvalError, prediction, report};
use placeformer_models::open_extractor;
use placeformer_vision::extract::{ExtractConfig, Extractor, Preset};
use placeformer_vision::image::ImageConfig;
use placeformer_vision::rerank::{RerankConfig, Reranker};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "Examples:
  placeformer eval --dataset msls-val --root /data/msls --html report.html
  placeformer eval --dataset msls-test --root /data/msls --predictions answers.txt  (the challenge's file)
  placeformer eval --dataset csv --root DIR --leave-out --calibration own.json      (can unknown places be told?)

The 95% intervals come from resampling queries as if they were independent. Frames that follow each other along a street
are not, so there the truth is wider.";

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true, after_help = EXAMPLES)]
pub struct EvalArgs {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    measure: MeasureArgs,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Fit how far best answers can be trusted.
    ///
    /// Every query is answered as the service would, and two curves are fitted to what the best
    /// answers were worth: one on S and global distance for re-ranked answers, one on the distance
    /// alone for the others. An answer is trusted from the confidence on at which the share of
    /// right ones reaches --target-precision (cross-validated, never below 0.5).
    ///
    /// Queries without a match come from the ground truth (an empty reference). Where it has none,
    /// every query is asked twice, the second time with its own place left out of the database: its
    /// positives and, where positions are known, all images within four times the radius.
    /// Confidences hold for the mix of known and unknown places they were fitted on; half and half
    /// is what leaving out gives.
    Calibrate(Box<calibrate::CalibrateArgs>),
}

#[derive(Debug, clap::Args)]
struct MeasureArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    output: OutputArgs,
}

/// Which images, and what is right.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Data set")]
struct DataArgs {
    /// Folder of reference images.
    #[arg(
        long,
        value_name = "DIR",
        requires = "queries",
        requires = "ground_truth",
        conflicts_with = "dataset"
    )]
    database: Option<PathBuf>,
    /// Folder of query images.
    #[arg(long, value_name = "DIR", requires = "database")]
    queries: Option<PathBuf>,
    /// CSV `query,reference`, one accepted pair a row; an empty reference says that no match
    /// exists.
    #[arg(long, value_name = "CSV", requires = "database")]
    ground_truth: Option<PathBuf>,
    /// A data set in the layout in which it is distributed.
    #[arg(
        long,
        value_enum,
        requires = "root",
        required_unless_present = "database"
    )]
    dataset: Option<DatasetKind>,
    /// Where that data set lies.
    #[arg(long, value_name = "DIR", requires = "dataset")]
    root: Option<PathBuf>,
    #[command(flatten)]
    reading: ReadArgs,
    /// Greatest distance of a positive in metres.
    #[arg(long, default_value_t = 25.0, value_name = "METRES")]
    radius: f64,
    /// Greatest difference of view angles of a positive in degrees [default: 40 for MSLS, else no
    /// rule].
    #[arg(long, value_name = "DEGREES")]
    max_angle: Option<f64>,
    /// Greatest frame distance of a positive (Nordland).
    #[arg(long, default_value_t = 10, value_name = "FRAMES")]
    frame_tolerance: u64,
    /// Exchange the seasons of Nordland: winter as the database, summer as the queries.
    #[arg(long)]
    swap: bool,
}

/// What is done to the images.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Method")]
struct MethodArgs {
    /// What is searched: the head's output, or the mean patch token before it.
    #[arg(long, value_enum, default_value = "head")]
    global: GlobalKind,
    #[command(flatten)]
    rerank: RerankArgs,
    /// Leave re-ranking out.
    #[arg(long)]
    no_rerank: bool,
    /// Ask every query a second time with its own place left out of the database (its positives,
    /// and all within four times the radius), so that rejection is measured where the ground truth
    /// names no unknown place. Recall is that of the first time; times are those of both.
    #[arg(long)]
    leave_out: bool,
    /// Show how far the confidences of this calibration (of `eval calibrate --out`) can be believed
    /// here.
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Repeat along the axes of the paper's ablation tables.
    #[arg(long)]
    ablate: bool,
    /// Backbones the ablation compares; their weights are pulled if they are missing.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "PRESET,...",
        requires = "ablate"
    )]
    backbones: Vec<Preset>,
    /// Bootstrap resamples behind the 95% intervals.
    #[arg(long, default_value_t = 2000, value_name = "N")]
    bootstrap: usize,
    /// Seed of the bootstrap.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// How candidates are re-ranked.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Method")]
struct RerankArgs {
    /// Candidates that are re-ranked.
    #[arg(long, default_value_t = 100, value_name = "N")]
    candidates: usize,
    /// Scale combinations whose inliers add up to S.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "1,1+2,2+3",
        value_name = "SET,..."
    )]
    scales: Vec<ScaleSet>,
}

/// Where results go.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Output")]
struct OutputArgs {
    /// Write everything measured as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write a self-contained report.
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Queries of each kind (worst, best, without match) shown as pictures in the report.
    #[arg(long, default_value_t = 4, value_name = "N")]
    pictures: usize,
    /// Write the benchmark's prediction file (MSLS, RobotCar Seasons).
    #[arg(long, value_name = "FILE")]
    predictions: Option<PathBuf>,
    #[command(flatten)]
    cache: CacheArgs,
}

/// Where descriptors are kept.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Output")]
struct CacheArgs {
    /// Folder where descriptors are kept between runs.
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Megabytes of key patches held in memory.
    #[arg(long, default_value_t = 1024, value_name = "MB")]
    patch_memory: u64,
}

/// Runs it.
pub fn run(args: EvalArgs) -> anyhow::Result<()> {
    placeformer_kernels::self_check()?;
    match args.action {
        Some(Action::Calibrate(args)) => calibrate::run(*args),
        None => run_measure(args.measure),
    }
}

fn run_measure(args: MeasureArgs) -> anyhow::Result<()> {
    args.method.rerank.check()?;
    let dataset = args.data.load()?;
    let extract = args.model.extract_config()?;
    let measured = measure(&args, &dataset, &extract)?;
    say_part!("{}", report::text(&measured.summary))?;
    if let Some(path) = &args.output.predictions {
        write_predictions(path, &args, &dataset, &measured.answered.answers)?;
    }
    let mut details = String::new();
    let mut json = serde_json::to_value(&measured.summary)?;
    if args.method.ablate {
        let Ablation { rows, left_out } = run_ablation(&args, &dataset, &extract)?;
        left_out
            .iter()
            .for_each(|row| eprintln!("left out {row} (--patch-memory)"));
        say_part!("\n{}", report::ablation_text(&rows))?;
        details += &report::ablation_html(&rows);
        json["ablation"] = serde_json::to_value(&rows)?;
    }
    if let Some(path) = &args.output.json {
        write(path, &(serde_json::to_string_pretty(&json)? + "\n"))?;
    }
    if let Some(path) = &args.output.html {
        let limits = ImageConfig::default();
        let reranker = Reranker::new(args.method.rerank.config());
        let painter = Painter {
            extractor: &measured.extractor,
            limits: &limits,
            reranker: &reranker,
        };
        let Answered {
            answers, left_out, ..
        } = &measured.answered;
        details += &gallery(&painter, &dataset, answers, args.output.pictures)?;
        write(
            path,
            &report::html(&measured.summary, &dataset, answers, left_out, &details),
        )?;
    }
    Ok(())
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    eprintln!("wrote {}", path.display());
    Ok(())
}

impl DataArgs {
    fn load(&self) -> anyhow::Result<Dataset> {
        let options = DatasetOptions {
            radius_m: self.radius,
            max_angle_deg: self.max_angle,
            frame_tolerance: self.frame_tolerance,
            swap: self.swap,
            ..self.reading.options()
        };
        options.check()?;
        let dataset = match (
            &self.database,
            &self.queries,
            &self.ground_truth,
            self.dataset,
            &self.root,
        ) {
            (Some(database), Some(queries), Some(truth), ..) => {
                datasets::load_pairs(database, queries, truth)?
            }
            (_, _, _, Some(kind), Some(root)) => datasets::load(kind, root, &options)?,
            _ => bail!("give --dataset and --root, or --database, --queries and --ground-truth"),
        };
        eprintln!(
            "{}: {} references, {} queries",
            dataset.name,
            dataset.database.len(),
            dataset.queries.len()
        );
        Ok(dataset)
    }
}

impl CacheArgs {
    fn folder(&self) -> anyhow::Result<PathBuf> {
        match &self.cache {
            Some(folder) => Ok(folder.clone()),
            None => Ok(placeformer_models::cache_dir()?.join("eval")),
        }
    }
}

impl RerankArgs {
    fn check(&self) -> anyhow::Result<()> {
        ensure!(self.candidates > 0, "--candidates must be at least 1");
        Ok(self.config().check()?)
    }

    fn config(&self) -> RerankConfig {
        RerankConfig {
            scales: self.scales.clone(),
            ..Default::default()
        }
    }
}

struct Measured {
    extractor: Extractor,
    answered: Answered,
    summary: Summary,
}

/// The answers to a data set.
struct Answered {
    answers: Vec<Answer>,
    /// Those to the same queries with their own place left out of the database, if they were asked
    /// so too.
    left_out: Vec<Answer>,
    seconds: QuerySeconds,
}

fn describer(config: &ExtractConfig) -> anyhow::Result<ModelDescriber> {
    Ok(ModelDescriber {
        extractor: open_extractor(config, &ProgressBars::default())?,
        limits: ImageConfig::default(),
    })
}

/// Both sides of a data set, described.
struct Described {
    extractor: Extractor,
    cache: FeatureCache,
    database: Features,
    queries: Features,
}

impl Described {
    fn new(
        extract: &ExtractConfig,
        cache: &CacheArgs,
        dataset: &Dataset,
        global: GlobalKind,
    ) -> anyhow::Result<Self> {
        let describer = describer(extract)?;
        let cache = FeatureCache::open(&cache.folder()?, &describer, cache.patch_memory << 20)?;
        let images = dataset.database.len() + dataset.queries.len();
        let bar = bar(images as u64, "describing");
        let side = |items, name| cache.describe_all(&describer, items, name, global, &bar);
        let (database, queries) = (
            side(&dataset.database, "database")?,
            side(&dataset.queries, "query")?,
        );
        bar.finish_and_clear();
        let fresh = database.fresh + queries.fresh;
        eprintln!(
            "described {fresh} images, {} more were cached or unreadable",
            images - fresh
        );
        Ok(Self {
            extractor: describer.extractor,
            cache,
            database,
            queries,
        })
    }

    /// Answers every query as the service would, and where `own` says so a second time without its
    /// own place. Nothing is re-ranked without a configuration.
    fn answer(
        &self,
        dataset: &Dataset,
        own: Option<&OwnPlaces>,
        candidates: usize,
        config: Option<&RerankConfig>,
    ) -> anyhow::Result<Answered> {
        let wanted = |query| own.map_or(candidates, |own| own.widened(query, candidates));
        let (mut answers, search) = search_all(&self.database, &self.queries, wanted);
        if let Some(own) = own {
            eprintln!("each query is also asked with its own place left out of the database");
            answers
                .iter_mut()
                .for_each(|answer| own.trim(answer, candidates));
        }
        let (answers, seconds) = match config {
            None => (answers, QuerySeconds::default()),
            Some(config) => self.rerank(answers, config)?,
        };
        let seconds = QuerySeconds { search, ..seconds };
        let (answers, left_out) = match own {
            None => (answers, Vec::new()),
            Some(own) => own.part_all(dataset, &answers, candidates),
        };
        Ok(Answered {
            answers,
            left_out,
            seconds,
        })
    }

    fn rerank(
        &self,
        answers: Vec<Answer>,
        config: &RerankConfig,
    ) -> anyhow::Result<(Vec<Answer>, QuerySeconds)> {
        let bar = bar(answers.len() as u64, "re-ranking");
        let patches = |features: &Features, index| self.cache.patches(features, index);
        let reranked = rerank_all(
            &patches,
            &self.database,
            &self.queries,
            answers,
            config,
            &bar,
        )?;
        bar.finish_and_clear();
        Ok(reranked)
    }
}

fn measure(
    args: &MeasureArgs,
    dataset: &Dataset,
    extract: &ExtractConfig,
) -> anyhow::Result<Measured> {
    let given = args
        .method
        .calibration
        .as_deref()
        .map(read_calibration)
        .transpose()?;
    let described = Described::new(extract, &args.output.cache, dataset, args.method.global)?;
    let candidates = args.method.rerank.candidates;
    let rerank = (!args.method.no_rerank).then(|| args.method.rerank.config());
    if let Some(given) = &given {
        check_calibration(
            given,
            args.method.global,
            described.extractor.model_id(),
            rerank.as_ref(),
        )?;
    }
    let own = args
        .method
        .leave_out
        .then(|| OwnPlaces::of(dataset, LeaveOut::Always, args.data.radius))
        .flatten();
    let answered = described.answer(dataset, own.as_ref(), candidates, rerank.as_ref())?;
    let config = RunConfig {
        model: described.extractor.model_id().clone(),
        global: args.method.global,
        candidates,
        extract: described.extractor.config().clone(),
        rerank,
        bootstrap: args.method.bootstrap,
        seed: args.method.seed,
    };
    let Described {
        extractor,
        database,
        queries,
        ..
    } = described;
    let asked = Asked {
        answers: &answered.answers,
        left_out: &answered.left_out,
        seconds: answered.seconds,
    };
    let summary = summarise(dataset, &database, &queries, asked, config, given.as_ref())?;
    Ok(Measured {
        extractor,
        answered,
        summary,
    })
}

fn read_calibration(path: &Path) -> anyhow::Result<Calibration> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    serde_json::from_str(&text).with_context(|| format!("{} is no calibration", path.display()))
}

/// Confidences mean something only for the model and the re-ranking they were fitted on.
fn check_calibration(
    given: &Calibration,
    global: GlobalKind,
    model: &ModelId,
    rerank: Option<&RerankConfig>,
) -> anyhow::Result<()> {
    ensure!(
        global == GlobalKind::Head,
        "a calibration holds for distances of the head: leave --global out"
    );
    ensure!(
        given.model() == model,
        "the calibration is one of {}, and this model is {model}",
        given.model()
    );
    if let Some(rerank) = rerank {
        let id = rerank.id();
        ensure!(
            given.rerank() == &id,
            "the calibration is one of re-ranking {}, and this is {id}",
            given.rerank()
        );
    }
    Ok(())
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
                eprintln!(
                    "warning: {unanswered} of the queries could not be answered; their lines name references that mean \
                     nothing, because the official evaluation wants a line for every query"
                );
            }
        }
        Some(DatasetKind::RobotcarSeasonsV2) => prediction::write_robotcar(path, dataset, answers)?,
        _ => bail!("only MSLS and RobotCar Seasons have a prediction file"),
    }
    eprintln!("wrote {}", path.display());
    Ok(())
}

fn run_ablation(
    args: &MeasureArgs,
    dataset: &Dataset,
    extract: &ExtractConfig,
) -> anyhow::Result<Ablation> {
    let rerank = args.method.rerank.config();
    let mut backbones = vec![extract.preset];
    backbones.extend(
        args.method
            .backbones
            .iter()
            .filter(|&&preset| preset != extract.preset),
    );
    let base = Base {
        extract,
        rerank: &rerank,
        candidates: args.method.rerank.candidates,
        backbones: &backbones,
        cache: &args.output.cache.folder()?,
        memory_bytes: args.output.cache.patch_memory << 20,
    };
    let open = |config: &ExtractConfig| -> Result<Box<dyn Describe>, EvalError> {
        let describer =
            describer(config).map_err(|error| EvalError::Setting(format!("{error:#}")))?;
        Ok(Box::new(describer))
    };
    Ok(ablate(dataset, &base, &open, &MultiProgress::new())?)
}

fn bar(length: u64, message: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length)
        .with_style(style)
        .with_message(message)
}

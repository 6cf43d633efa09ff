//! Fit how far best answers can be trusted.

use super::args::{CacheArgs, DataArgs, RerankArgs};
use super::{describe, open_describer, write};
use crate::cli::choice::choice;
use crate::cli::client::{ServerArgs, ServerClient};
use crate::cli::model_args::ModelOptions;
use crate::cli::output::{note, say_part};
use crate::cli::progress::ProgressBars;
use anyhow::{Context, ensure};
use placeformer_core::types::{Calibration, MapName, ModelId};
use placeformer_lab::choice::Choice;
use placeformer_lab::datasets::{Dataset, Parted, Quarter};
use placeformer_lab::eval::answers::DatasetAnswers;
use placeformer_lab::eval::calibrate::{Applied, BestAnswers, Fitted, Purpose, fit};
use placeformer_lab::eval::features::GlobalKind;
use placeformer_lab::eval::learn::Lessons;
use placeformer_lab::eval::own_places::{LeaveOut, MARGIN, OwnPlaces};
use placeformer_lab::eval::score_table::{score_rows, score_text};
use std::path::PathBuf;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub(super) struct CalibrateArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    rerank: RerankArgs,
    #[command(flatten)]
    fit: FitArgs,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    server: ServerArgs,
}

/// What is fitted.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Calibration")]
struct FitArgs {
    /// Share of right answers among those that are trusted.
    #[arg(long, default_value_t = 0.99, value_name = "SHARE", value_parser = parse_share)]
    target_precision: f64,
    /// When each query's own place is left out of the database to make it unknown.
    #[arg(
        long,
        value_parser = choice::<LeaveOut>(),
        default_value = "auto",
        value_name = "WHEN"
    )]
    leave_out: LeaveOut,
    /// Seed of the cross-validation.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Quarters of the ground to hold out, each in turn: nothing is fitted on their queries, and
    /// what was fitted on the others is judged on them.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1..,
        value_parser = choice::<Quarter>(),
        value_name = "QUARTER"
    )]
    quarters: Vec<Quarter>,
}

/// Where it goes.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Output")]
struct OutputArgs {
    /// Write the calibration as JSON.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Store the calibration with this map of the server.
    #[arg(long, value_name = "NAME")]
    map: Option<MapName>,
    /// What to call the data in the calibration [default: the data set's own name].
    #[arg(long, value_name = "NAME")]
    data_name: Option<String>,
    #[command(flatten)]
    cache: CacheArgs,
}

fn parse_share(text: &str) -> Result<f64, String> {
    let share: f64 = text.parse().map_err(|_| "it is not a number".to_owned())?;
    if share > 0.0 && share <= 1.0 {
        Ok(share)
    } else {
        Err("use a share above 0 and up to 1, such as 0.99".into())
    }
}

/// Runs it.
pub(super) fn run(args: CalibrateArgs) -> anyhow::Result<()> {
    args.rerank.check()?;
    let writes = args.output.out.is_some() || args.output.map.is_some();
    ensure!(
        !writes || args.fit.quarters.len() <= 1,
        "--out and --map want one calibration: hold one quarter out, or none"
    );
    let dataset = args.data.load()?;
    let parts = part(&args, &dataset)?;
    let extract = args.model.extract_config()?;
    let describer = open_describer(&extract)?;
    let own = OwnPlaces::of(&dataset, args.fit.leave_out, args.data.radius);
    if own.is_some() {
        note!("each query is also asked with its own place left out of the database");
    }
    let rerank = args.rerank.config();
    let progress = ProgressBars::default();
    let cache = &args.output.cache;
    let described = describe(&describer, cache, &dataset, GlobalKind::Head, &progress)?;
    let candidates = args.rerank.candidates;
    let asked = described.answer(&dataset, own.as_ref(), candidates, Some(&rerank), &progress)?;

    let fitting = Fitting {
        args: &args,
        dataset: &dataset,
        model: describer.extractor.model_id(),
    };
    let mut fitted = None;
    for (quarter, parted) in &parts {
        let of_rest = fitting.fit(asked.only(&parted.rest))?;
        fitting.judge(*quarter, parted, &asked, &of_rest)?;
        fitted = Some(of_rest);
    }
    // Of several quarters each has its own; what holds for all is fitted on all.
    let fitted = match fitted {
        Some(fitted) if parts.len() == 1 => fitted,
        _ => fitting.fit(asked)?,
    };
    say_part!("{}", fitted.text())?;
    if let Some(path) = &args.output.out {
        write(
            path,
            &(serde_json::to_string_pretty(&fitted.calibration)? + "\n"),
        )?;
    }
    if let Some(map) = &args.output.map {
        store(args.server, map, &fitted.calibration)?;
    }
    Ok(())
}

/// The queries of each quarter that is held out, and the others.
fn part(args: &CalibrateArgs, dataset: &Dataset) -> anyhow::Result<Vec<(Quarter, Parted)>> {
    let gap_m = args.data.radius * MARGIN;
    let mut parts = Vec::new();
    for &quarter in &args.fit.quarters {
        let parted = quarter.part(dataset, gap_m);
        let parted = parted.with_context(|| {
            let name = quarter.as_str();
            format!("--quarters {name}: too few queries have a position, or they lie too close")
        })?;
        parts.push((quarter, parted));
    }
    Ok(parts)
}

/// What every fit has in common.
struct Fitting<'a> {
    args: &'a CalibrateArgs,
    dataset: &'a Dataset,
    model: &'a ModelId,
}

impl Fitting<'_> {
    fn fit(&self, asked: DatasetAnswers) -> anyhow::Result<Fitted> {
        let args = self.args;
        let data_name = args.output.data_name.clone();
        let purpose = Purpose {
            model: self.model.clone(),
            rerank: args.rerank.config(),
            data: data_name.unwrap_or_else(|| self.dataset.name.clone()),
            target_precision: args.fit.target_precision,
            seed: args.fit.seed,
            radius_m: args.data.radius,
        };
        Ok(fit(self.dataset, asked, purpose)?)
    }

    /// Says what the fit to the other queries is worth on those of a quarter.
    fn judge(
        &self,
        quarter: Quarter,
        parted: &Parted,
        asked: &DatasetAnswers,
        fitted: &Fitted,
    ) -> anyhow::Result<()> {
        let Self { args, dataset, .. } = *self;
        let rerank = args.rerank.config();
        let rest = asked.only(&parted.rest);
        let lessons = Lessons::of(dataset, &rest, &rerank.scales, args.data.radius);
        let learned = lessons.learn(|_| true)?;
        let mut held_out = asked.only(&parted.held_out);
        let name = quarter.as_str();
        let rows = score_rows(dataset, &held_out, &learned);
        say_part!("{}", score_text(&format!("{name} held out"), &rows))?;

        held_out.order_by(&fitted.ranking(&rerank)?);
        let DatasetAnswers {
            answers, left_out, ..
        } = &held_out;
        let best = BestAnswers::of(dataset, answers, left_out, rerank.score);
        let applied = Applied::of(fitted.calibration.curve(true), &best.reranked);
        say_part!("{name}, {}: {}\n\n", rerank.score.as_str(), applied.text())?;
        Ok(())
    }
}

fn store(server: ServerArgs, map: &MapName, calibration: &Calibration) -> anyhow::Result<()> {
    let address = server.server.clone();
    let client = ServerClient::new(server)?;
    let stored = client.put_json(&format!("/maps/{map}/calibration"), calibration);
    let stored = stored.with_context(|| format!("cannot store the calibration with map {map}"))?;
    ensure!(
        stored["model"] == calibration.model().as_str(),
        "the server stored something else: {stored}"
    );
    note!("stored with map {map} at {address}");
    Ok(())
}

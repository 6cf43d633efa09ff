//! Fit how far best answers can be trusted.

use super::args::{CacheArgs, DataArgs, RerankArgs};
use super::{describe, open_describer, write};
use crate::cli::choice::choice;
use crate::cli::client::{ServerArgs, ServerClient};
use crate::cli::model_args::ModelOptions;
use crate::cli::output::{note, say_part};
use crate::cli::progress::ProgressBars;
use anyhow::{Context, ensure};
use placeformer_core::types::{Calibration, MapName};
use placeformer_lab::eval::calibrate::{BestAnswers, Purpose, calibrate};
use placeformer_lab::eval::features::GlobalKind;
use placeformer_lab::eval::own_places::{LeaveOut, OwnPlaces};
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
    let dataset = args.data.load()?;
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
    let answered =
        described.answer(&dataset, own.as_ref(), candidates, Some(&rerank), &progress)?;
    let answers = BestAnswers::of(&dataset, &answered.answers, &answered.left_out);
    let fitted = calibrate(
        &answers,
        Purpose {
            model: describer.extractor.model_id().clone(),
            rerank: rerank.id(),
            data: args.output.data_name.unwrap_or(dataset.name),
            target_precision: args.fit.target_precision,
            seed: args.fit.seed,
        },
    )?;
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

//! Measure recall on a data set, or calibrate confidences on it.

mod args;
mod calibrate;
mod measure;

use crate::cli::output::note;
use crate::cli::progress::ProgressBars;
use anyhow::Context;
use args::CacheArgs;
use placeformer_core::progress::Progress;
use placeformer_lab::datasets::Dataset;
use placeformer_lab::eval::answers::DescribedDataset;
use placeformer_lab::eval::features::{GlobalKind, ModelDescriber};
use placeformer_models::open_extractor;
use placeformer_vision::extract::ExtractConfig;
use placeformer_vision::image::ImageConfig;
use std::path::Path;

const EXAMPLES: &str = "Examples:
  placeformer eval --dataset msls-val --root /data/msls --html report.html
  placeformer eval --dataset msls-test --root /data/msls --predictions answers.txt  \
(the challenge's file)
  placeformer eval --dataset csv --root DIR --leave-out --calibration own.json      \
(can unknown places be told?)

The 95% intervals come from resampling queries as if they were independent. Frames that follow \
each other along a street
are not, so there the truth is wider.";

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = EXAMPLES
)]
pub struct EvalArgs {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    measure: measure::MeasureArgs,
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
    /// With --score learned, a score of candidates is fitted as well, to all that re-ranking finds
    /// out about them: a logistic regression that goes into the calibration. --quarters says what
    /// each way of ordering candidates is worth on ground that nothing was fitted on.
    ///
    /// Queries without a match come from the ground truth (an empty reference). Where it has none,
    /// every query is asked twice, the second time with its own place left out of the database: its
    /// positives and, where positions are known, all images within four times the radius.
    /// Confidences hold for the mix of known and unknown places they were fitted on; half and half
    /// is what leaving out gives.
    Calibrate(Box<calibrate::CalibrateArgs>),
}

/// Runs it.
pub fn run(args: EvalArgs) -> anyhow::Result<()> {
    placeformer_kernels::self_check()?;
    match args.action {
        Some(Action::Calibrate(args)) => calibrate::run(*args),
        None => measure::run(args.measure),
    }
}

fn open_describer(config: &ExtractConfig) -> anyhow::Result<ModelDescriber> {
    Ok(ModelDescriber {
        extractor: open_extractor(config, &ProgressBars::default())?,
        limits: ImageConfig::default(),
    })
}

/// Describes a data set, and says how much of it was new.
fn describe(
    describer: &ModelDescriber,
    cache: &CacheArgs,
    dataset: &Dataset,
    global: GlobalKind,
    progress: &dyn Progress,
) -> anyhow::Result<DescribedDataset> {
    let cache = cache.open(describer)?;
    let described = DescribedDataset::new(describer, cache, dataset, global, progress)?;
    let images = dataset.database.len() + dataset.queries.len();
    let fresh = described.fresh();
    note!(
        "described {fresh} images, {} more were cached or unreadable",
        images - fresh
    );
    Ok(described)
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    note!("wrote {}", path.display());
    Ok(())
}

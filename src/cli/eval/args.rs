//! Flags of the evaluation: data, method, output.

use crate::cli::choice::choice;
use crate::cli::data_args::ReadArgs;
use crate::cli::output::note;
use anyhow::{bail, ensure};
use placeformer_core::types::{ScaleSet, ScoreKind};
use placeformer_lab::choice::Choice;
use placeformer_lab::datasets::{self, Dataset, DatasetKind, DatasetOptions, GroundPart};
use placeformer_lab::eval::features::{Describe, FeatureCache, GlobalKind};
use placeformer_lab::eval::sequences::SequenceOptions;
use placeformer_vision::extract::Preset;
use placeformer_vision::rerank::RerankConfig;
use std::path::PathBuf;

/// Which images, and what is right.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Data set")]
pub(super) struct DataArgs {
    /// Folder of reference images.
    #[arg(
        long,
        value_name = "DIR",
        requires = "queries",
        requires = "ground_truth",
        conflicts_with = "dataset"
    )]
    pub(super) database: Option<PathBuf>,
    /// Folder of query images.
    #[arg(long, value_name = "DIR", requires = "database")]
    pub(super) queries: Option<PathBuf>,
    /// CSV `query,reference`, one accepted pair a row; an empty reference says that no match
    /// exists.
    #[arg(long, value_name = "CSV", requires = "database")]
    pub(super) ground_truth: Option<PathBuf>,
    /// A data set in the layout in which it is distributed.
    #[arg(
        long,
        value_parser = choice::<DatasetKind>(),
        requires = "root",
        required_unless_present = "database"
    )]
    pub(super) dataset: Option<DatasetKind>,
    /// Where that data set lies.
    #[arg(long, value_name = "DIR", requires = "dataset")]
    pub(super) root: Option<PathBuf>,
    /// Only this part of the ground: blocks of 500 m that share no place with those of another
    /// part. `train --by-parts` learns from `train`, validates on `selection` and never sees `report`.
    #[arg(long, value_name = "PART", value_parser = choice::<GroundPart>())]
    pub(super) hold_out: Option<GroundPart>,
    #[command(flatten)]
    pub(super) reading: ReadArgs,
    /// Greatest distance of a positive in metres.
    #[arg(long, default_value_t = 25.0, value_name = "METRES")]
    pub(super) radius: f64,
    /// Greatest difference of view angles of a positive in degrees [default: 40 for MSLS, else no
    /// rule].
    #[arg(long, value_name = "DEGREES")]
    pub(super) max_angle: Option<f64>,
    /// Greatest frame distance of a positive (Nordland).
    #[arg(long, default_value_t = 10, value_name = "FRAMES")]
    pub(super) frame_tolerance: u64,
    /// Exchange the seasons of Nordland: winter as the database, summer as the queries.
    #[arg(long)]
    pub(super) swap: bool,
}

/// What is done to the images.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Method")]
pub(super) struct MethodArgs {
    /// What is searched: the head's output, or the mean patch token before it.
    #[arg(long, value_parser = choice::<GlobalKind>(), default_value = "head")]
    pub(super) global: GlobalKind,
    #[command(flatten)]
    pub(super) rerank: RerankArgs,
    /// Leave re-ranking out.
    #[arg(long)]
    pub(super) no_rerank: bool,
    /// Ask every query a second time with its own place left out of the database (its positives,
    /// and all within four times the radius), so that rejection is measured where the ground truth
    /// names no unknown place. Recall is that of the first time; times are those of both.
    #[arg(long)]
    pub(super) leave_out: bool,
    /// Show how far the confidences of this calibration (of `eval calibrate --out`) can be believed
    /// here.
    #[arg(long, value_name = "FILE")]
    pub(super) calibration: Option<PathBuf>,
    /// Repeat along the axes of the paper's ablation tables.
    #[arg(long)]
    pub(super) ablate: bool,
    /// Backbones the ablation compares; their weights are pulled if they are missing.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1..,
        value_name = "PRESET",
        requires = "ablate"
    )]
    pub(super) backbones: Vec<Preset>,
    /// Bootstrap resamples behind the 95% intervals.
    #[arg(long, default_value_t = 2000, value_name = "N")]
    pub(super) bootstrap: usize,
    /// Seed of the bootstrap.
    #[arg(long, default_value_t = 0)]
    pub(super) seed: u64,
}

/// How candidates are re-ranked.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Method")]
pub(super) struct RerankArgs {
    /// Candidates that are re-ranked.
    #[arg(long, default_value_t = 100, value_name = "N")]
    pub(super) candidates: usize,
    /// Scale combinations whose inliers add up to S.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1..,
        default_value = "1,1+2,2+3",
        value_name = "SET"
    )]
    pub(super) scales: Vec<ScaleSet>,
    /// What candidates are ordered by: the number of inliers, that fused with the global distance,
    /// or a score learned by `eval calibrate`.
    #[arg(
        long,
        value_parser = parse_score,
        default_value = "paper",
        value_name = "paper|fused|learned"
    )]
    pub(super) score: ScoreKind,
}

/// Whether and how queries are followed as the frames of a drive.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Sequences")]
pub(super) struct SequenceArgs {
    /// Follow the queries in the order of their names as the frames of a drive, too, each with what
    /// was believed after the one before: recall, trust, and how soon a vehicle is found again that
    /// was carried elsewhere.
    #[arg(long)]
    sequences: bool,
    /// Seconds between two frames.
    #[arg(
        long,
        default_value_t = 1.0,
        value_name = "SECONDS",
        requires = "sequences"
    )]
    frame_seconds: f64,
    /// Highest speed of the vehicle.
    #[arg(
        long,
        default_value_t = 15.0,
        value_name = "M/S",
        requires = "sequences"
    )]
    max_speed: f64,
    /// Metres between two references that follow each other by name, where the data set gives no
    /// positions.
    #[arg(
        long,
        default_value_t = 10.0,
        value_name = "METRES",
        requires = "sequences"
    )]
    spacing: f64,
    /// Give the filter odometry with this error, as a share of the distance; needs positions.
    #[arg(long, value_name = "SHARE", requires = "sequences")]
    odometry_error: Option<f64>,
    /// Legs of the drive in which the vehicle is carried elsewhere.
    #[arg(long, default_value_t = 6, value_name = "N", requires = "sequences")]
    legs: usize,
}

impl SequenceArgs {
    /// The options, if sequences are wanted.
    pub(super) fn options(&self, seed: u64) -> anyhow::Result<Option<SequenceOptions>> {
        if !self.sequences {
            return Ok(None);
        }
        let options = SequenceOptions {
            frame_seconds: self.frame_seconds,
            max_speed_mps: self.max_speed,
            spacing_m: self.spacing,
            odometry_error: self.odometry_error,
            legs: self.legs,
            seed,
        };
        options.check()?;
        Ok(Some(options))
    }
}

/// Where results go.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Output")]
pub(super) struct OutputArgs {
    /// Write everything measured as JSON.
    #[arg(long, value_name = "FILE")]
    pub(super) json: Option<PathBuf>,
    /// Write a self-contained report.
    #[arg(long, value_name = "FILE")]
    pub(super) html: Option<PathBuf>,
    /// Queries of each kind (worst, best, without match) shown as pictures in the report.
    #[arg(long, default_value_t = 4, value_name = "N")]
    pub(super) pictures: usize,
    /// Write the benchmark's prediction file (MSLS, RobotCar Seasons).
    #[arg(long, value_name = "FILE")]
    pub(super) predictions: Option<PathBuf>,
    #[command(flatten)]
    pub(super) cache: CacheArgs,
}

/// Where descriptors are kept.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Output")]
pub(super) struct CacheArgs {
    /// Folder where descriptors are kept between runs.
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Megabytes of key patches held in memory.
    #[arg(long, default_value_t = 1024, value_name = "MB")]
    patch_memory: u64,
}

fn parse_score(text: &str) -> Result<ScoreKind, String> {
    let mut kinds = ScoreKind::ALL.into_iter();
    let known = kinds.find(|kind| kind.as_str() == text);
    known.ok_or_else(|| "use paper, fused or learned".to_owned())
}

impl DataArgs {
    pub(super) fn load(&self) -> anyhow::Result<Dataset> {
        let options = DatasetOptions {
            radius_m: self.radius,
            max_angle_deg: self.max_angle,
            frame_tolerance: self.frame_tolerance,
            swap: self.swap,
            ..self.reading.options()
        };
        options.check()?;
        let folders = (&self.database, &self.queries, &self.ground_truth);
        let dataset = if let (Some(database), Some(queries), Some(truth)) = folders {
            datasets::load_pairs(database, queries, truth)?
        } else if let (Some(kind), Some(root)) = (self.dataset, &self.root) {
            datasets::load(kind, root, &options)?
        } else {
            bail!("give --dataset and --root, or --database, --queries and --ground-truth");
        };
        let dataset = match self.hold_out {
            Some(part) => {
                let name = format!("{}, part {}", dataset.name, part.as_str());
                Dataset {
                    name,
                    ..part.of(&dataset)?
                }
            }
            None => dataset,
        };
        note!(
            "{}: {} references, {} queries",
            dataset.name,
            dataset.database.len(),
            dataset.queries.len()
        );
        Ok(dataset)
    }
}

impl CacheArgs {
    /// Opens what `describer` recorded in earlier runs.
    pub(super) fn open(&self, describer: &dyn Describe) -> anyhow::Result<FeatureCache> {
        let folder = self.folder()?;
        Ok(FeatureCache::open(&folder, describer, self.memory_bytes())?)
    }

    /// Bytes of key patches held in memory.
    pub(super) fn memory_bytes(&self) -> u64 {
        self.patch_memory << 20
    }

    pub(super) fn folder(&self) -> anyhow::Result<PathBuf> {
        match &self.cache {
            Some(folder) => Ok(folder.clone()),
            None => Ok(placeformer_models::cache_dir()?.join("eval")),
        }
    }
}

impl RerankArgs {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        ensure!(self.candidates > 0, "--candidates must be at least 1");
        Ok(self.config().check()?)
    }

    pub(super) fn config(&self) -> RerankConfig {
        RerankConfig {
            scales: self.scales.clone(),
            score: self.score,
            ..Default::default()
        }
    }
}

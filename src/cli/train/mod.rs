//! Train the model.
//!
//! The head alone is trained on pooled tokens that are computed once; blocks of the backbone are
//! trained on the images themselves. Both run in a folder that holds all they need to go on after
//! an interruption.

mod backbone;
mod data;
mod head;

use super::model_args::ModelOptions;
use crate::cli::output::say;
use anyhow::{Context, ensure};
use clap::Args;
use data::TrainData;
use placeformer_lab::train::{
    Augmentation, Outcome, Schedule, TrainConfig, TrainableBlocks, read_log, report,
};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;

pub(super) use head::train_head;

const EXAMPLES: &str =
    "Examples: the paper's order, first MSLS, then Pitts30k from where that ended
  placeformer train --trainable last-2 --dataset msls-val --root /data/msls --out first \\
      --validation-dataset msls-val --validation-root /data/msls
  placeformer train --trainable last-2 --dataset pitts30k --root /data/pitts30k --out second \\
      --validation-dataset pitts30k --validation-root /data/pitts30k \\
      --weights first/weights.safetensors --head first/head.safetensors";

/// Arguments of this subcommand.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct TrainArgs {
    /// What moves: the head alone (minutes on a CPU), the last N computed blocks and the head
    /// (last-N), or all. Blocks need three images a triplet in memory: lower --batch where that
    /// does not fit.
    #[arg(long, default_value = "head", value_name = "head|last-N|all")]
    trainable: Trainable,
    #[command(flatten)]
    run: RunArgs,
    #[command(flatten)]
    augmentation: AugmentArgs,
}

/// Arguments of `head train`.
#[derive(Debug, Args)]
pub struct HeadTrainArgs {
    #[command(flatten)]
    run: RunArgs,
}

/// What is common to training the head and training the backbone.
#[derive(Debug, Args)]
struct RunArgs {
    /// Folder of the run; one that holds a checkpoint of the same run is continued.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Folder where pooled tokens are kept between runs [default: in the user's cache].
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    #[command(flatten)]
    data: TrainData,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    model: ModelOptions,
}

/// How it is trained.
#[derive(Debug, Args)]
#[command(next_help_heading = "Method")]
struct MethodArgs {
    /// Steps of the whole run, unless validation stops improving before.
    #[arg(long, default_value_t = 5000, value_name = "N")]
    steps: u64,
    /// Steps of growing learning rate before the cosine falls [default: 100, at most a tenth of the
    /// steps].
    #[arg(long, value_name = "N")]
    warm_up: Option<u64>,
    /// Highest learning rate of Adam (paper: 5e-4).
    #[arg(long, default_value_t = 5e-4, value_name = "RATE")]
    learning_rate: f64,
    /// Triplets per step.
    #[arg(long, default_value_t = 16, value_name = "N")]
    batch: usize,
    /// Margin of the triplet loss on squared distances (paper: 0.01).
    #[arg(long, default_value_t = 0.01)]
    margin: f64,
    /// Steps between two minings of hard negatives; also between validations and checkpoints.
    #[arg(long, default_value_t = 100, value_name = "STEPS")]
    mine_every: u64,
    /// Hardest negatives of each query, one of which is drawn.
    #[arg(long, default_value_t = 10, value_name = "N")]
    negatives: usize,
    /// Most database images compared when mining, drawn anew each time.
    #[arg(long, default_value_t = 20_000, value_name = "N")]
    mining_pool: usize,
    /// Minings without a better validation recall (mean of R@1 and R@10) after which the run stops.
    #[arg(long, default_value_t = 8, value_name = "N")]
    patience: u32,
    /// Where every random choice comes from, the held-out blocks too.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Variation of the images when blocks are trained; pooled tokens of a head's training cannot be
/// varied.
#[derive(Debug, Args)]
#[command(next_help_heading = "Augmentation (not with --trainable head)")]
struct AugmentArgs {
    /// Brightness factor within 1 +- this [default: 0.3].
    #[arg(long, value_name = "SHARE")]
    brightness: Option<f32>,
    /// Contrast factor within 1 +- this [default: 0.3].
    #[arg(long, value_name = "SHARE")]
    contrast: Option<f32>,
    /// Saturation factor within 1 +- this [default: 0.3].
    #[arg(long, value_name = "SHARE")]
    saturation: Option<f32>,
    /// Corners of the view move by up to this share of the sides [default: 0.08].
    #[arg(long, value_name = "SHARE")]
    viewpoint: Option<f32>,
}

/// What moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Trainable {
    Head,
    Blocks(TrainableBlocks),
}

impl FromStr for Trainable {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "head" => return Ok(Self::Head),
            "all" => return Ok(Self::Blocks(TrainableBlocks::All)),
            _ => {}
        }
        let count = text.strip_prefix("last-").map(str::parse);
        match count {
            Some(Ok(count)) if count > 0 => Ok(Self::Blocks(TrainableBlocks::Last(count))),
            _ => Err("use head, last-N with N from 1, or all".into()),
        }
    }
}

/// Runs it.
pub fn run(args: TrainArgs) -> anyhow::Result<()> {
    match args.trainable {
        Trainable::Head => {
            ensure!(
                args.augmentation.is_unset(),
                "a head is trained on cached tokens, which cannot be varied: \
                 leave the augmentation flags out"
            );
            head::train(&args.run)
        }
        Trainable::Blocks(blocks) => {
            backbone::train(&args.run, blocks, args.augmentation.strengths())
        }
    }
}

impl AugmentArgs {
    fn is_unset(&self) -> bool {
        [
            self.brightness,
            self.contrast,
            self.saturation,
            self.viewpoint,
        ]
        .iter()
        .all(Option::is_none)
    }

    fn strengths(&self) -> Augmentation {
        let default = Augmentation::default();
        Augmentation {
            brightness: self.brightness.unwrap_or(default.brightness),
            contrast: self.contrast.unwrap_or(default.contrast),
            saturation: self.saturation.unwrap_or(default.saturation),
            viewpoint: self.viewpoint.unwrap_or(default.viewpoint),
        }
    }
}

impl RunArgs {
    /// The settings, checked before anything slow begins.
    fn config(&self, augmentation: Augmentation) -> anyhow::Result<TrainConfig> {
        let method = &self.method;
        let warm_up = method.warm_up.unwrap_or((method.steps / 10).min(100));
        let config = TrainConfig {
            margin: method.margin,
            schedule: Schedule {
                peak: method.learning_rate,
                warm_up,
                total: method.steps,
            },
            batch: method.batch,
            steps_per_cycle: method.mine_every,
            negatives: method.negatives,
            mining_pool: method.mining_pool,
            patience: method.patience,
            augmentation,
            seed: method.seed,
        };
        config.check()?;
        Ok(config)
    }

    fn cache_folder(&self) -> anyhow::Result<PathBuf> {
        match &self.cache {
            Some(folder) => Ok(folder.clone()),
            None => Ok(placeformer_models::cache_dir()?.join("pooled")),
        }
    }
}

/// What a report and a head's notes say about a run.
fn facts(args: &RunArgs, trainable: &str, data: &str, start: &str) -> Vec<(String, String)> {
    [
        ("trained", trainable.to_owned()),
        ("from", start.to_owned()),
        ("folders", args.data.names()),
        ("data", data.to_owned()),
        ("distances", args.data.distances()),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .into()
}

/// Notes of a trained head: how it was made, and its validation recall.
fn notes(
    args: &RunArgs,
    input_size: &str,
    data: &str,
    outcome: &Outcome,
) -> BTreeMap<String, String> {
    let recall = |recall: &placeformer_lab::train::ValidationRecall| {
        format!(
            "R@1 {:.1}, R@5 {:.1}, R@10 {:.1}",
            recall.at_1, recall.at_5, recall.at_10
        )
    };
    BTreeMap::from([
        ("method".to_owned(), "triplet margin loss".to_owned()),
        ("input_size".to_owned(), input_size.to_owned()),
        ("data".to_owned(), data.to_owned()),
        ("steps".to_owned(), outcome.steps.to_string()),
        ("seed".to_owned(), args.method.seed.to_string()),
        ("validation_before".to_owned(), recall(&outcome.initial)),
        ("validation".to_owned(), recall(&outcome.best)),
    ])
}

/// Writes the page of a finished run and says how it went.
fn finish(
    folder: &Path,
    facts: &[(String, String)],
    config: &TrainConfig,
    outcome: &Outcome,
) -> anyhow::Result<()> {
    let path = folder.join("report.html");
    let page = report::html(facts, config, &read_log(folder)?, outcome);
    std::fs::write(&path, page).with_context(|| format!("cannot write {}", path.display()))?;
    say!("{}", report::verdict(outcome))?;
    for (name, recall) in [("before", &outcome.initial), ("kept", &outcome.best)] {
        say!(
            "{name:7} R@1 {:5.1}  R@5 {:5.1}  R@10 {:5.1}",
            recall.at_1,
            recall.at_5,
            recall.at_10
        )?;
    }
    say!("{}", folder.join("head.safetensors").display())?;
    Ok(())
}

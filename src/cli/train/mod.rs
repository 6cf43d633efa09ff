//! Train the model.
//!
//! The head alone is trained on pooled tokens that are computed once; blocks of the backbone are
//! trained on the images themselves, or on tokens before the first trained block. All run in a
//! folder that holds what they need to go on after an interruption.

mod backbone;
mod data;
mod head;
mod method;

use super::model_args::ModelOptions;
use crate::cli::output::say;
use anyhow::{Context, ensure};
use clap::Args;
use data::TrainData;
use method::{AugmentArgs, BlockArgs, MethodArgs, STREET_BLOCKS};
use placeformer_lab::train::{Outcome, TrainConfig, TrainableBlocks, read_log, report};
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
      --weights first/weights.safetensors --head first/head.safetensors

One's own city, from photographs with positions and headings (positions.csv); a quarter of the
ground is never seen, and `eval --hold-out report` measures on it
  placeformer train --recipe streets --dataset csv --root /data/city --by-parts --out run
  placeformer eval --dataset csv --root /data/city --hold-out report \\
      --difference run/difference.safetensors --head run/head.safetensors";

/// Arguments of this subcommand.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct TrainArgs {
    /// What moves: the head alone (minutes on a CPU), the last N computed blocks and the head with
    /// its aggregate (last-N), or all. A step of blocks needs all of its images in memory, unless
    /// --images-at-once says otherwise [default: head; last-3 with --recipe streets].
    #[arg(long, value_name = "head|last-N|all")]
    trainable: Option<Trainable>,
    #[command(flatten)]
    run: RunArgs,
    #[command(flatten)]
    blocks: BlockArgs,
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
    let default = args
        .run
        .method
        .recipe
        .pick(Trainable::Head, Trainable::Blocks(STREET_BLOCKS));
    match args.trainable.unwrap_or(default) {
        Trainable::Head => {
            ensure!(
                args.augmentation.is_unset(),
                "a head is trained on cached tokens, which cannot be varied: \
                 leave the augmentation flags out"
            );
            ensure!(
                args.blocks.is_unset(),
                "a head alone has no blocks: leave the flags of blocks out, or say --trainable last-N"
            );
            head::train(&args.run)
        }
        Trainable::Blocks(blocks) => {
            let config = args
                .run
                .method
                .block_config(&args.blocks, &args.augmentation)?;
            backbone::train(&args.run, &args.blocks, blocks, &config)
        }
    }
}

/// Where `given` is not set, the folder `name` in the user's cache.
fn cache_folder(given: Option<&PathBuf>, name: &str) -> anyhow::Result<PathBuf> {
    match given {
        Some(folder) => Ok(folder.clone()),
        None => Ok(placeformer_models::cache_dir()?.join(name)),
    }
}

/// What a report and a head's notes say about a run.
fn facts(args: &RunArgs, trainable: &str, data: &str, start: &str) -> Vec<(String, String)> {
    [
        ("trained", trainable.to_owned()),
        ("from", start.to_owned()),
        ("folders", args.data.names()),
        ("data", data.to_owned()),
        ("distances", args.data.distances(args.method.recipe)),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .into()
}

/// Writes what a run is about to do into its folder, for whoever finds only that.
fn write_settings(
    folder: &Path,
    facts: &[(String, String)],
    config: &TrainConfig,
) -> anyhow::Result<()> {
    let facts: BTreeMap<&str, &str> = facts
        .iter()
        .map(|(name, value)| (name.as_str(), value.as_str()))
        .collect();
    let settings = serde_json::json!({ "run": facts, "settings": config });
    let path = folder.join("settings.json");
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let text = serde_json::to_string_pretty(&settings)? + "\n";
    std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// Notes of a trained head: how it was made, and its validation recall.
fn notes(
    config: &TrainConfig,
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
    let method = serde_json::to_string(config).unwrap_or_default();
    BTreeMap::from([
        ("method".to_owned(), method),
        ("input_size".to_owned(), input_size.to_owned()),
        ("data".to_owned(), data.to_owned()),
        ("steps".to_owned(), outcome.steps.to_string()),
        ("seed".to_owned(), config.seed.to_string()),
        ("validation_before".to_owned(), recall(&outcome.initial)),
        ("validation".to_owned(), recall(&outcome.kept)),
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
    for (name, recall) in [("before", &outcome.initial), ("kept", &outcome.kept)] {
        say!(
            "{name:7} R@1 {:5.1}  R@5 {:5.1}  R@10 {:5.1}",
            recall.at_1,
            recall.at_5,
            recall.at_10
        )?;
    }
    Ok(())
}

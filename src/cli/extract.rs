//! Show every intermediate of extraction.

use crate::extract::pull::resolve_model;
use crate::extract::{
    ExtractConfig, ExtractionTrace, Extractor, HeadChoice, Precision, Preset, TraceArray, TraceValues,
};
use crate::image::{ImageConfig, load_tensor};
use crate::types::{ImageSize, PoolingStride};
use anyhow::Context;
use clap::Args;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Arguments of this subcommand.
#[derive(Debug, Args)]
pub struct ExtractArgs {
    /// The image (JPEG, PNG or WebP).
    image: PathBuf,
    /// Print every intermediate as JSON.
    #[arg(long)]
    json: bool,
    /// Write every intermediate to this safetensors file.
    #[arg(long, value_name = "FILE")]
    safetensors: Option<PathBuf>,
    #[command(flatten)]
    model: ModelOptions,
}

/// Which model to use and how: shared by every subcommand that describes images itself.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Model")]
pub struct ModelOptions {
    /// The backbone.
    #[arg(long, default_value_t)]
    pub preset: Preset,
    /// A weights file instead of the pulled one.
    #[arg(long, value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Fail rather than fetch a model that is not there.
    #[arg(long)]
    pub offline: bool,
    /// Size images are squashed to, WIDTHxHEIGHT.
    #[arg(long, value_name = "SIZE")]
    pub input_size: Option<ImageSize>,
    /// 0-based block whose tokens are used.
    #[arg(long, value_name = "BLOCK")]
    pub exit_block: Option<usize>,
    /// Whether tokens pass the final LayerNorm.
    #[arg(long, value_name = "BOOL")]
    pub token_norm: Option<bool>,
    /// 0-based block whose CLS attention ranks patches; the exit block unless set.
    #[arg(long, value_name = "BLOCK")]
    pub attention_block: Option<usize>,
    /// Attention heads, where weights were trained with another count than the preset's.
    #[arg(long)]
    pub heads: Option<usize>,
    /// Least attention of a key patch, in multiples of the uniform level [default: 1].
    #[arg(long)]
    pub tau: Option<f32>,
    /// Most key patches at scales 1, 2, 3 [default: 400,200,50].
    #[arg(long, value_delimiter = ',', num_args = 3, value_name = "N")]
    pub caps: Option<Vec<usize>>,
    /// Move fused windows by one patch instead of their own width.
    #[arg(long)]
    pub dense: bool,
    /// Projection to the global descriptor: `default`, `none` or a file.
    #[arg(long)]
    pub head: Option<HeadChoice>,
    /// Arithmetic of the linear layers.
    #[arg(long, default_value_t)]
    pub precision: Precision,
}

impl ModelOptions {
    /// The settings these options stand for.
    pub fn config(&self) -> ExtractConfig {
        let default = ExtractConfig::default();
        ExtractConfig {
            preset: self.preset,
            input_size: self.input_size,
            exit_block: self.exit_block,
            token_norm: self.token_norm,
            attention_block: self.attention_block,
            heads: self.heads,
            tau: self.tau.unwrap_or(default.tau),
            // clap has counted them.
            caps: self.caps.as_deref().and_then(|caps| caps.try_into().ok()).unwrap_or(default.caps),
            stride: if self.dense { PoolingStride::One } else { PoolingStride::Kernel },
            head: self.head.clone().unwrap_or_default(),
            precision: self.precision,
        }
    }

    /// The weights file, pulled on first use.
    pub fn weights(&self) -> anyhow::Result<PathBuf> {
        match &self.weights {
            Some(path) => Ok(path.clone()),
            None => Ok(resolve_model(self.preset, self.offline)?),
        }
    }

    /// The model, ready to use.
    pub fn load(&self) -> anyhow::Result<Extractor> {
        let config = self.config();
        config.encoder_spec()?;
        Ok(Extractor::load(&config, &self.weights()?, None)?)
    }
}

/// Runs it.
pub fn run(args: ExtractArgs) -> anyhow::Result<()> {
    let extractor = args.model.load()?;
    let bytes = std::fs::read(&args.image).with_context(|| args.image.display().to_string())?;
    let image = load_tensor(&bytes, &ImageConfig::default(), extractor.input_size())
        .with_context(|| args.image.display().to_string())?;
    let trace = extractor.trace(&image)?;
    if let Some(path) = &args.safetensors {
        write_safetensors(path, &trace, &extractor)?;
    }
    match args.json {
        true => println!("{}", serde_json::to_string(&as_json(&trace, &extractor))?),
        false => print_summary(&trace, &extractor),
    }
    Ok(())
}

fn as_json(trace: &ExtractionTrace, extractor: &Extractor) -> Value {
    let array = |array: TraceArray| {
        let values = match array.values {
            TraceValues::F32(values) => json!(values),
            TraceValues::I64(values) => json!(values),
        };
        (array.name, json!({"shape": array.shape, "values": values}))
    };
    json!({
        "model": extractor.model_id(),
        "spec": trace.spec,
        "grid": trace.encoded.grid,
        "arrays": trace.arrays().into_iter().map(array).collect::<serde_json::Map<_, _>>(),
    })
}

fn write_safetensors(path: &Path, trace: &ExtractionTrace, extractor: &Extractor) -> anyhow::Result<()> {
    let arrays = trace.arrays();
    let views: Result<Vec<_>, _> = arrays
        .iter()
        .map(|array| {
            let (dtype, bytes): (_, &[u8]) = match &array.values {
                TraceValues::F32(values) => (Dtype::F32, bytemuck::cast_slice(values)),
                TraceValues::I64(values) => (Dtype::I64, bytemuck::cast_slice(values)),
            };
            TensorView::new(dtype, array.shape.clone(), bytes).map(|view| (&array.name, view))
        })
        .collect();
    let metadata = [("model".to_owned(), extractor.model_id().to_string())].into();
    safetensors::serialize_to_file(views?, Some(metadata), path).with_context(|| path.display().to_string())
}

fn print_summary(trace: &ExtractionTrace, extractor: &Extractor) {
    println!("model {}", extractor.model_id());
    for array in trace.arrays() {
        let shape = array.shape.iter().map(usize::to_string).collect::<Vec<_>>().join("x");
        let (low, high, mean) = match &array.values {
            TraceValues::F32(values) => range(values.iter().map(|&v| v as f64)),
            TraceValues::I64(values) => range(values.iter().map(|&v| v as f64)),
        };
        println!("{:32} {shape:>12}  min {low:>10.4}  max {high:>10.4}  mean {mean:>10.4}", array.name);
    }
}

fn range(values: impl Iterator<Item = f64> + Clone) -> (f64, f64, f64) {
    let count = values.clone().count().max(1) as f64;
    let low = values.clone().fold(f64::INFINITY, f64::min);
    let high = values.clone().fold(f64::NEG_INFINITY, f64::max);
    (low, high, values.sum::<f64>() / count)
}

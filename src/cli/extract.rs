//! Show every intermediate of extraction.

use super::model_args::ModelOptions;
use crate::cli::output::{OutputError, say};
use anyhow::Context;
use clap::Args;
use placeformer_models::open_extractor;
use placeformer_vision::extract::{ExtractionTrace, Extractor, TraceArray, TraceValues};
use placeformer_vision::image::{ImageConfig, load_tensor};
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

/// Runs it.
pub fn run(args: ExtractArgs) -> anyhow::Result<()> {
    let extractor = open_extractor(&args.model.extract_config()?)?;
    let bytes = std::fs::read(&args.image).with_context(|| args.image.display().to_string())?;
    let image = load_tensor(&bytes, &ImageConfig::default(), extractor.input_size())
        .with_context(|| args.image.display().to_string())?;
    let trace = extractor.trace(&image)?;
    if let Some(path) = &args.safetensors {
        write_safetensors(path, &trace, &extractor)?;
    }
    match args.json {
        true => say!("{}", serde_json::to_string(&as_json(&trace, &extractor))?)?,
        false => print_summary(&trace, &extractor)?,
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

fn write_safetensors(
    path: &Path,
    trace: &ExtractionTrace,
    extractor: &Extractor,
) -> anyhow::Result<()> {
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
    safetensors::serialize_to_file(views?, Some(metadata), path)
        .with_context(|| path.display().to_string())
}

fn print_summary(trace: &ExtractionTrace, extractor: &Extractor) -> Result<(), OutputError> {
    say!("model {}", extractor.model_id())?;
    for array in trace.arrays() {
        let shape = array
            .shape
            .iter()
            .map(usize::to_string)
            .collect::<Vec<_>>()
            .join("x");
        let (low, high, mean) = match &array.values {
            TraceValues::F32(values) => range(values.iter().map(|&v| v as f64)),
            TraceValues::I64(values) => range(values.iter().map(|&v| v as f64)),
        };
        say!(
            "{:32} {shape:>12}  min {low:>10.4}  max {high:>10.4}  mean {mean:>10.4}",
            array.name
        )?;
    }
    Ok(())
}

fn range(values: impl Iterator<Item = f64> + Clone) -> (f64, f64, f64) {
    let count = values.clone().count().max(1) as f64;
    let low = values.clone().fold(f64::INFINITY, f64::min);
    let high = values.clone().fold(f64::NEG_INFINITY, f64::max);
    (low, high, values.sum::<f64>() / count)
}

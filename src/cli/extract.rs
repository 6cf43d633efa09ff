//! Show every intermediate of extraction.

use super::model_args::ModelOptions;
use crate::cli::output::{OutputError, say};
use crate::cli::progress::ProgressBars;
use anyhow::Context;
use clap::Args;
use placeformer_models::open_extractor;
use placeformer_vision::extract::{ExtractionTrace, Extractor, TraceValues};
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
    let extractor = open_extractor(&args.model.extract_config()?, &ProgressBars::default())?;
    let bytes = std::fs::read(&args.image).with_context(|| args.image.display().to_string())?;
    let image = load_tensor(&bytes, &ImageConfig::default(), extractor.input_size())
        .with_context(|| args.image.display().to_string())?;
    let trace = extractor.trace(&image)?;
    if let Some(path) = &args.safetensors {
        write_safetensors(path, &trace, &extractor)?;
    }
    if args.json {
        say!("{}", as_json(&trace, &extractor))?;
    } else {
        print_summary(&trace, &extractor)?;
    }
    Ok(())
}

fn as_json(trace: &ExtractionTrace, extractor: &Extractor) -> Value {
    let mut arrays = serde_json::Map::new();
    for array in trace.arrays() {
        let values = match array.values {
            TraceValues::F32(values) => json!(values),
            TraceValues::I64(values) => json!(values),
        };
        let array_json = json!({"shape": array.shape, "values": values});
        arrays.insert(array.name, array_json);
    }
    json!({
        "model": extractor.model_id(),
        "spec": trace.spec,
        "grid": trace.encoded.grid,
        "arrays": arrays,
    })
}

fn write_safetensors(
    path: &Path,
    trace: &ExtractionTrace,
    extractor: &Extractor,
) -> anyhow::Result<()> {
    let arrays = trace.arrays();
    let mut views = Vec::with_capacity(arrays.len());
    for array in &arrays {
        let (dtype, bytes): (_, &[u8]) = match &array.values {
            TraceValues::F32(values) => (Dtype::F32, bytemuck::cast_slice(values)),
            TraceValues::I64(values) => (Dtype::I64, bytemuck::cast_slice(values)),
        };
        let view = TensorView::new(dtype, array.shape.clone(), bytes)?;
        views.push((&array.name, view));
    }
    let metadata = [("model".to_owned(), extractor.model_id().to_string())].into();
    safetensors::serialize_to_file(views, Some(metadata), path)
        .with_context(|| path.display().to_string())
}

fn print_summary(trace: &ExtractionTrace, extractor: &Extractor) -> Result<(), OutputError> {
    say!("model {}", extractor.model_id())?;
    for array in trace.arrays() {
        let sides: Vec<String> = array.shape.iter().map(usize::to_string).collect();
        let shape = sides.join("x");
        let Summary { low, high, mean } = match &array.values {
            TraceValues::F32(values) => summarise(values.iter().map(|&value| value as f64)),
            TraceValues::I64(values) => summarise(values.iter().map(|&value| value as f64)),
        };
        say!(
            "{:32} {shape:>12}  min {low:>10.4}  max {high:>10.4}  mean {mean:>10.4}",
            array.name
        )?;
    }
    Ok(())
}

/// Range and mean of an array.
struct Summary {
    low: f64,
    high: f64,
    mean: f64,
}

fn summarise(values: impl Iterator<Item = f64>) -> Summary {
    let mut low = f64::INFINITY;
    let mut high = f64::NEG_INFINITY;
    let mut sum = 0.0;
    let mut count: usize = 0;
    for value in values {
        low = low.min(value);
        high = high.max(value);
        sum += value;
        count += 1;
    }
    let mean = sum / count.max(1) as f64;
    Summary { low, high, mean }
}

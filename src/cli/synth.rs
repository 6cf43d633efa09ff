//! Render synthetic street scenes.

use crate::cli::output::say;
use indicatif::{ProgressBar, ProgressStyle};
use placeformer_core::types::ImageSize;
use placeformer_lab::synth::{Condition, DatasetOptions, image_count, write_dataset};
use std::path::PathBuf;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct SynthArgs {
    /// Folder to write database/, queries/, ground_truth.csv and positions.csv to.
    #[arg(long)]
    out: PathBuf,
    /// Mapped places.
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    places: u64,
    /// Reference images of each place.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u64).range(1..=64))]
    views: u64,
    /// Seed of the town: the same seed gives the same bytes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Size of every image.
    #[arg(long, default_value = "640x480", value_parser = parse_size)]
    size: ImageSize,
    /// Conditions of the queries, in turn; references are taken by day.
    #[arg(long, value_delimiter = ',', default_values_t = [Condition::Dusk, Condition::Overcast, Condition::Day])]
    conditions: Vec<Condition>,
}

/// Sizes that render in reasonable time and memory.
fn parse_size(text: &str) -> Result<ImageSize, String> {
    let size: ImageSize = text
        .parse()
        .map_err(|error: placeformer_core::types::InvalidValue| error.to_string())?;
    if (16..=4096).contains(&size.width) && (16..=4096).contains(&size.height) {
        Ok(size)
    } else {
        Err(format!("size: {size} is outside 16 to 4096 pixels a side"))
    }
}

/// Runs it.
pub fn run(args: SynthArgs) -> anyhow::Result<()> {
    let options = DatasetOptions {
        places: args.places,
        views: args.views,
        seed: args.seed,
        size: args.size,
        conditions: args.conditions,
    };
    let bar = ProgressBar::new(image_count(&options));
    bar.set_style(ProgressStyle::with_template(
        "rendering {wide_bar} {pos}/{len} images, {eta} left",
    )?);
    let summary = write_dataset(&args.out, &options, || bar.inc(1))?;
    bar.finish_and_clear();
    say!(
        "{}: {} references of {} places, {} queries ({} of places that are not mapped)",
        args.out.display(),
        summary.references,
        args.places,
        summary.queries,
        summary.unmatched
    )?;
    Ok(())
}

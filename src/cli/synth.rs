//! Render synthetic street scenes.

use crate::cli::output::say;
use crate::cli::progress::ProgressBars;
use placeformer_core::types::ImageSize;
use placeformer_lab::synth::{Condition, TownOptions, write_town};
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
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1..,
        default_values_t = [Condition::Dusk, Condition::Overcast, Condition::Day]
    )]
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
    let options = TownOptions {
        places: args.places,
        views: args.views,
        seed: args.seed,
        size: args.size,
        conditions: args.conditions,
    };
    let summary = write_town(&args.out, &options, &ProgressBars::default())?;
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

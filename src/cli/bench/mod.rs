//! Measure every stage beside its baselines.

mod end_to_end;
mod peers;
mod service;
mod table;

use super::model_args::ModelOptions;
use crate::cli::output::{note, say};
use crate::cli::progress::ProgressBars;
use anyhow::{Context, ensure};
use end_to_end::{EndToEnd, EndToEndRow};
use placeformer_core::progress::{Progress, Task};
use placeformer_lab::bench::{Bench, BenchError, BenchRow, Limits, NAMES};
use placeformer_models::resolve_weights;
use placeformer_vision::extract::{ExtractError, Extractor};
use serde::Serialize;
use service::PipelineServices;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct BenchArgs {
    /// Rows to measure, such as extract,search_1m; all but search_10m (14 GB) unless given.
    #[arg(long, value_name = "NAME", value_delimiter = ',', num_args = 1..)]
    only: Vec<String>,
    /// Paired runs of the slow rows; quick ones take more.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Also write the result as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Measure POST /query through a server instead, at every number of clients and references.
    #[arg(long)]
    end_to_end: bool,
    /// References of the map, with --end-to-end; random ones beyond the drawn.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1..,
        default_values_t = [1_000, 100_000, 1_000_000],
        requires = "end_to_end"
    )]
    references: Vec<u64>,
    /// Drawn references with patches, with --end-to-end.
    #[arg(long, default_value_t = 1_000, requires = "end_to_end")]
    drawn: u64,
    /// Clients that ask one query after the other, with --end-to-end.
    #[arg(
        long,
        value_delimiter = ',',
        num_args = 1..,
        default_values_t = [1, 8],
        requires = "end_to_end"
    )]
    clients: Vec<usize>,
    /// Seconds of each measurement, with --end-to-end.
    #[arg(long, default_value_t = 20.0, requires = "end_to_end")]
    seconds: f64,
    /// Also measure what users assemble today (OpenVINO, faiss, numpy, OpenCV) with this Python,
    /// which needs benches/peers/requirements.txt.
    #[arg(long, value_name = "PYTHON", requires = "end_to_end")]
    peers: Option<PathBuf>,
    /// Keep the drawn references here, to measure again sooner; a temporary folder otherwise.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Serve what --end-to-end drew in --folder-of-filled, and this many made-up references: how it
    /// starts its server.
    #[arg(long, hide = true, value_name = "N", requires = "folder_of_filled")]
    serve_filled: Option<u64>,
    #[arg(long, hide = true, value_name = "DIR")]
    folder_of_filled: Option<PathBuf>,
    #[command(flatten)]
    model: ModelOptions,
}

/// What a run found, as written by `--json`.
#[derive(Debug, Serialize)]
struct Report {
    version: &'static str,
    simd: String,
    threads: usize,
    encoder: String,
    limits: Limits,
    rows: Vec<BenchRow>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    end_to_end: Vec<EndToEndRow>,
}

/// Runs it.
pub fn run(args: BenchArgs) -> anyhow::Result<()> {
    if cfg!(debug_assertions) {
        note!(
            "warning: this is a development build; its times mean nothing (cargo build --release)"
        );
    }
    let simd = placeformer_kernels::self_check()?;
    if let (Some(extra), Some(folder)) = (args.serve_filled, &args.folder_of_filled) {
        return end_to_end::serve_filled(folder, extra, args.model.extract_config()?);
    }
    let config = args.model.extract_config()?;
    let path = resolve_weights(&config, &ProgressBars::default())?;
    let weights = config.load_weights(&path)?;
    let extractor = Arc::new(Extractor::from_weights(&config, &weights, &config.head)?);
    let (folder, _temporary) = folder(args.data.as_deref())?;
    let limits = Limits::measure(simd);
    let mut report = Report {
        version: env!("CARGO_PKG_VERSION"),
        simd: simd.level().to_string(),
        threads: rayon::current_num_threads(),
        encoder: extractor.encoder_name(),
        limits,
        rows: Vec::new(),
        end_to_end: Vec::new(),
    };
    say!("{}", table::machine(&report))?;
    if args.end_to_end {
        let plan = args.end_to_end_plan(&extractor, &folder, &path);
        report.end_to_end = plan.measure()?;
    } else {
        let bench = Bench {
            extractor,
            weights,
            spec: config.encoder_spec()?,
            limits,
            folder,
            rounds: args.rounds as usize,
            services: &PipelineServices,
        };
        report.rows = rows(&bench, &args.only)?;
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_vec_pretty(&report)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    if args.end_to_end {
        say!("{}", table::end_to_end(&report.end_to_end))?;
    } else {
        say!("{}", table::rows(&report.rows))?;
    }
    Ok(())
}

impl BenchArgs {
    fn end_to_end_plan<'a>(
        &'a self,
        extractor: &'a Extractor,
        folder: &'a Path,
        weights: &'a Path,
    ) -> EndToEnd<'a> {
        EndToEnd {
            references: &self.references,
            drawn: self.drawn,
            clients: &self.clients,
            seconds: self.seconds,
            extractor,
            folder,
            peers: self.peers.as_deref().map(|python| (python, weights)),
        }
    }
}

fn rows(bench: &Bench, only: &[String]) -> anyhow::Result<Vec<BenchRow>> {
    for name in only {
        ensure!(
            NAMES.contains(&name.as_str()),
            "there is no row {name:?}; there are {}",
            NAMES.join(", ")
        );
    }
    let wanted = |name: &&str| match only {
        [] => *name != "search_10m",
        only => only.iter().any(|wanted| wanted == name),
    };
    let names: Vec<&str> = NAMES.into_iter().filter(wanted).collect();
    let bars = ProgressBars::default();
    let task = Task::begin(&bars, "measuring", names.len() as u64);
    let mut rows = Vec::new();
    for name in names {
        task.set_note(name);
        match bench.row(name) {
            Ok(row) => rows.push(row),
            // Named rows must be measured; of all rows, those this CPU can.
            Err(BenchError::Extract(error @ ExtractError::Precision { .. })) if only.is_empty() => {
                bars.suspend(&mut || note!("left out {name}: {error}"));
            }
            Err(error) => return Err(error.into()),
        }
        task.add(1);
    }
    Ok(rows)
}

/// The folder given, or one that is removed with the second value.
fn folder(given: Option<&Path>) -> anyhow::Result<(PathBuf, Option<TemporaryFolder>)> {
    if let Some(path) = given {
        std::fs::create_dir_all(path).with_context(|| format!("cannot make {}", path.display()))?;
        return Ok((path.to_owned(), None));
    }
    let path = std::env::temp_dir().join(format!("placeformer-bench-{}", std::process::id()));
    std::fs::create_dir(&path).with_context(|| format!("cannot make {}", path.display()))?;
    Ok((path.clone(), Some(TemporaryFolder(path))))
}

struct TemporaryFolder(PathBuf);

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        if let Err(error) = std::fs::remove_dir_all(&self.0) {
            note!("warning: {} is left behind: {error}", self.0.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Arguments {
        #[command(flatten)]
        bench: BenchArgs,
    }

    #[test]
    fn lists_are_separated_by_commas_or_by_spaces_as_the_help_prints_them() {
        for numbers in [&["1000,100000"][..], &["1000", "100000"]] {
            let line = [&["bench", "--end-to-end", "--references"], numbers].concat();
            let parsed = Arguments::try_parse_from(line).unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(parsed.bench.references, [1000, 100_000]);
        }
    }
}

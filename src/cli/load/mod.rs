//! Drive a server at a constant rate and report what its clients felt.
//!
//! The load is an open loop: request *i* is due at `start + i / rate` whether or not earlier
//! answers have come back, and its latency counts from the moment it was *due*. A closed-loop
//! client slows down with the server and so hides the queue in which real vehicles would stand
//! (coordinated omission); this one does not.

mod bounds;
mod drive;
mod report;
mod target;

use crate::cli::client::TrustArgs;
use crate::cli::output::say;
use anyhow::{Context, ensure};
use bounds::Bounds;
use bytes::Bytes;
use drive::{Capacity, measure_capacity, open_loop};
use placeformer_core::folder::list_images;
use report::Report;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use target::{Target, watch_memory};

/// Time between two samples of the server's memory.
const MEMORY_INTERVAL: Duration = Duration::from_secs(2);

/// Arguments of this subcommand.
#[derive(Debug, clap::Args)]
pub struct LoadArgs {
    /// Base address of the server, such as http://127.0.0.1:8080.
    #[arg(long)]
    server: String,
    /// The map to query.
    #[arg(long)]
    map: String,
    /// Folder of JPEG, PNG or WebP query photos, sent in turn.
    #[arg(long, value_name = "DIR")]
    images: PathBuf,
    /// Requests per second.
    #[arg(
        long,
        required_unless_present = "times_capacity",
        conflicts_with = "times_capacity"
    )]
    rate: Option<f64>,
    /// Measure the capacity first (see --capacity-seconds), then run at this multiple of it.
    #[arg(long, value_name = "X")]
    times_capacity: Option<f64>,
    /// Seconds of closed-loop load for measuring the capacity.
    #[arg(long, default_value_t = 15.0)]
    capacity_seconds: f64,
    /// Concurrent clients while measuring the capacity.
    #[arg(long, default_value_t = 4)]
    capacity_clients: usize,
    /// Seconds to run.
    #[arg(long, default_value_t = 60.0)]
    duration: f64,
    /// Extra query parameters, such as "top_k=5&deadline_ms=500".
    #[arg(long, default_value = "")]
    options: String,
    /// API key, sent as a bearer token.
    #[arg(long, env = "PLACEFORMER_API_KEY", hide_env_values = true)]
    api_key: Option<String>,
    #[command(flatten)]
    trust: TrustArgs,
    /// Most requests under way at once; beyond it a due request is counted as not sent.
    #[arg(long, default_value_t = 4096)]
    max_in_flight: usize,
    #[command(flatten)]
    bounds: Bounds,
    /// Also write the report as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Runs it.
pub fn run(args: LoadArgs) -> anyhow::Result<()> {
    let is_valid = args.duration.is_finite() && args.duration > 0.0;
    ensure!(is_valid, "--duration must be a positive number of seconds");
    let images = read_images(&args.images)?;
    let target = Target::new(
        &args.server,
        &args.map,
        &args.options,
        args.api_key.clone(),
        args.trust.clone(),
        images,
    )?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let report = runtime.block_on(drive(&args, Arc::new(target)))?;
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_vec_pretty(&report)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    say!("{report}")?;
    let broken = args.bounds.broken_by(&report);
    ensure!(broken.is_empty(), "{}", broken.join("; "));
    Ok(())
}

async fn drive(args: &LoadArgs, target: Arc<Target>) -> anyhow::Result<Report> {
    target.expect_ready().await?;
    let capacity = match args.times_capacity {
        Some(_) => Some(measure_capacity(&target, &args.capacity()).await?),
        None => None,
    };
    let rate = args.rate(capacity)?;
    let memory = tokio::spawn(watch_memory(Arc::clone(&target), MEMORY_INTERVAL));
    let duration = Duration::from_secs_f64(args.duration);
    let tally = open_loop(&target, rate, duration, args.max_in_flight).await;
    memory.abort();
    Ok(Report::new(
        rate,
        capacity,
        args.duration,
        tally,
        target.memory_samples(),
    ))
}

impl LoadArgs {
    /// How the capacity is measured.
    fn capacity(&self) -> Capacity {
        Capacity {
            clients: self.capacity_clients,
            seconds: self.capacity_seconds,
        }
    }

    /// Requests per second: those asked for, or a multiple of the measured capacity.
    fn rate(&self, capacity: Option<f64>) -> anyhow::Result<f64> {
        let times = self.times_capacity.zip(capacity);
        let measured = times.map(|(times, capacity)| times * capacity);
        let rate = self
            .rate
            .or(measured)
            .context("give --rate or --times-capacity")?;
        ensure!(
            rate.is_finite() && rate > 0.0,
            "the rate must be positive, not {rate}"
        );
        Ok(rate)
    }
}

/// Reads every image below `folder`, sorted by path so that runs repeat.
fn read_images(folder: &Path) -> anyhow::Result<Vec<Bytes>> {
    let mut images = Vec::new();
    for (_, path) in list_images(folder)? {
        let image =
            std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        images.push(image.into());
    }
    ensure!(
        !images.is_empty(),
        "{} holds no JPEG, PNG or WebP image",
        folder.display()
    );
    Ok(images)
}

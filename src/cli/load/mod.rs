//! Drive a server at a constant rate and report what its clients felt.
//!
//! Open loop: request *i* is due at `start + i / rate` whether or not earlier answers have come
//! back, and its latency counts from the moment it was *due*. A closed-loop client slows down with
//! the server and so hides the queue that real vehicles would stand in (coordinated omission); this
//! one does not.

mod client;
mod report;

use crate::cli::output::say;
use anyhow::{Context, bail, ensure};
use bytes::Bytes;
use client::{Outcome, Target};
use placeformer_core::folder::list_images;
use report::{Bounds, Report, Tally};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, mpsc};

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
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let report = runtime.block_on(drive(&args))?;
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_vec_pretty(&report)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    say!("{report}")?;
    let broken = args.bounds.broken_by(&report);
    ensure!(broken.is_empty(), "{}", broken.join("; "));
    Ok(())
}

async fn drive(args: &LoadArgs) -> anyhow::Result<Report> {
    ensure!(
        args.duration.is_finite() && args.duration > 0.0,
        "--duration must be a positive number of seconds"
    );
    let images = read_images(&args.images)?;
    let target = Arc::new(Target::new(
        &args.server,
        &args.map,
        &args.options,
        args.api_key.clone(),
        images,
    )?);
    target.expect_ready().await?;
    let capacity = match args.times_capacity {
        Some(_) => {
            Some(measure_capacity(&target, args.capacity_clients, args.capacity_seconds).await?)
        }
        None => None,
    };
    let rate = match (args.rate, args.times_capacity, capacity) {
        (Some(rate), _, _) => rate,
        (None, Some(times), Some(capacity)) => times * capacity,
        _ => bail!("give --rate or --times-capacity"),
    };
    ensure!(
        rate.is_finite() && rate > 0.0,
        "the rate must be positive, not {rate}"
    );
    let memory = tokio::spawn(client::watch_memory(
        Arc::clone(&target),
        Duration::from_secs(2),
    ));
    let tally = open_loop(
        &target,
        rate,
        Duration::from_secs_f64(args.duration),
        args.max_in_flight,
    )
    .await;
    memory.abort();
    Ok(Report::new(
        rate,
        capacity,
        args.duration,
        tally,
        target.memory_samples(),
    ))
}

/// Sends requests when they are due and collects what became of each.
async fn open_loop(
    target: &Arc<Target>,
    rate: f64,
    duration: Duration,
    max_in_flight: usize,
) -> Tally {
    let in_flight = Arc::new(Semaphore::new(max_in_flight));
    let (sender, mut outcomes) = mpsc::channel::<(Duration, Outcome)>(2 * max_in_flight.max(1));
    let collector = tokio::spawn(async move {
        let mut tally = Tally::default();
        while let Some((latency, outcome)) = outcomes.recv().await {
            tally.add(latency, outcome);
        }
        tally
    });
    let start = Instant::now();
    let total = (rate * duration.as_secs_f64()).ceil() as u64;
    for number in 0..total {
        let due = start + Duration::from_secs_f64(number as f64 / rate);
        tokio::time::sleep_until(due.into()).await;
        let Ok(permit) = Arc::clone(&in_flight).try_acquire_owned() else {
            // The receiver lives until the last sender is dropped, so sending cannot fail here or
            // below.
            let _ = sender.send((Duration::ZERO, Outcome::NotSent)).await;
            continue;
        };
        let (target, sender) = (Arc::clone(target), sender.clone());
        tokio::spawn(async move {
            let outcome = target.query(number as usize).await;
            let _ = sender.send((due.elapsed(), outcome)).await;
            drop(permit);
        });
    }
    drop(sender);
    collector.await.unwrap_or_default()
}

/// Answers per second that a few clients get when each waits for its answer before asking again.
async fn measure_capacity(
    target: &Arc<Target>,
    clients: usize,
    seconds: f64,
) -> anyhow::Result<f64> {
    let start = Instant::now();
    let end = start + Duration::from_secs_f64(seconds);
    let workers: Vec<_> = (0..clients.max(1))
        .map(|worker| {
            let target = Arc::clone(target);
            tokio::spawn(async move {
                let mut answered = 0u64;
                let mut number = worker;
                while Instant::now() < end {
                    match target.query(number).await {
                        Outcome::Admitted => answered += 1,
                        Outcome::Rejected { .. } => {
                            tokio::time::sleep(Duration::from_millis(50)).await
                        }
                        Outcome::Failed(reason) => return Err(reason),
                        Outcome::NotSent => {}
                    }
                    number += clients;
                }
                Ok(answered)
            })
        })
        .collect();
    let mut answered = 0;
    for worker in workers {
        answered += worker
            .await?
            .map_err(|reason| anyhow::anyhow!("while measuring the capacity: {reason}"))?;
    }
    ensure!(
        answered > 0,
        "no query was answered in {seconds} s, so there is no capacity to multiply"
    );
    Ok(answered as f64 / start.elapsed().as_secs_f64())
}

/// Reads every image below `folder`, sorted by path so that runs repeat.
fn read_images(folder: &Path) -> anyhow::Result<Vec<Bytes>> {
    let images = list_images(folder)?;
    ensure!(
        !images.is_empty(),
        "{} holds no JPEG, PNG or WebP image",
        folder.display()
    );
    let read = |path: PathBuf| {
        std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))
    };
    images
        .into_iter()
        .map(|(_, path)| Ok(read(path)?.into()))
        .collect()
}

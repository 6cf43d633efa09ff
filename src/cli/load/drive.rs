//! The two ways of asking: at a constant rate, and as fast as answers come.

use super::report::Tally;
use super::target::{RequestOutcome, Target};
use anyhow::{anyhow, ensure};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, mpsc};

/// How the capacity is measured.
pub(super) struct Capacity {
    /// Concurrent clients.
    pub(super) clients: usize,
    /// Seconds of the measurement.
    pub(super) seconds: f64,
}

/// How long a client waits that was turned away while the capacity is measured.
const PAUSE: Duration = Duration::from_millis(50);

/// Sends requests when they are due and collects what became of each.
pub(super) async fn open_loop(
    target: &Arc<Target>,
    rate: f64,
    duration: Duration,
    max_in_flight: usize,
) -> Tally {
    let in_flight = Arc::new(Semaphore::new(max_in_flight));
    let (sender, outcomes) = mpsc::channel(2 * max_in_flight.max(1));
    let collector = tokio::spawn(collect(outcomes));
    let start = Instant::now();
    let total = (rate * duration.as_secs_f64()).ceil() as u64;
    for number in 0..total {
        let due = start + Duration::from_secs_f64(number as f64 / rate);
        tokio::time::sleep_until(due.into()).await;
        let Ok(permit) = Arc::clone(&in_flight).try_acquire_owned() else {
            // The collector receives until the last sender is dropped, so that sending cannot fail
            // here or below.
            let _ = sender.send((Duration::ZERO, RequestOutcome::NotSent)).await;
            continue;
        };
        let target = Arc::clone(target);
        let sender = sender.clone();
        tokio::spawn(async move {
            let outcome = target.query(number as usize).await;
            let _ = sender.send((due.elapsed(), outcome)).await;
            drop(permit);
        });
    }
    drop(sender);
    collector.await.unwrap_or_default()
}

/// Adds up outcomes with their latencies until the last sender is gone.
async fn collect(mut outcomes: mpsc::Receiver<(Duration, RequestOutcome)>) -> Tally {
    let mut tally = Tally::default();
    while let Some((latency, outcome)) = outcomes.recv().await {
        tally.add(latency, outcome);
    }
    tally
}

/// Answers per second that a few clients get when each waits for its answer before asking again.
pub(super) async fn measure_capacity(
    target: &Arc<Target>,
    capacity: &Capacity,
) -> anyhow::Result<f64> {
    let Capacity { clients, seconds } = *capacity;
    let start = Instant::now();
    let end = start + Duration::from_secs_f64(seconds);
    let workers: Vec<_> = (0..clients.max(1))
        .map(|first| tokio::spawn(closed_loop(Arc::clone(target), first, clients, end)))
        .collect();
    let mut answered = 0;
    for worker in workers {
        answered += worker
            .await?
            .map_err(|reason| anyhow!("while measuring the capacity: {reason}"))?;
    }
    ensure!(
        answered > 0,
        "no query was answered in {seconds} s, so there is no capacity to multiply"
    );
    Ok(answered as f64 / start.elapsed().as_secs_f64())
}

/// Asks one query after the other until `end`: photo `first` and every `clients`-th from there.
/// Returns how many were answered.
async fn closed_loop(
    target: Arc<Target>,
    first: usize,
    clients: usize,
    end: Instant,
) -> Result<u64, String> {
    let mut answered = 0;
    let mut number = first;
    while Instant::now() < end {
        match target.query(number).await {
            RequestOutcome::Admitted => answered += 1,
            RequestOutcome::Rejected { .. } => tokio::time::sleep(PAUSE).await,
            RequestOutcome::Failed(reason) => return Err(reason),
            RequestOutcome::NotSent => {}
        }
        number += clients;
    }
    Ok(answered)
}

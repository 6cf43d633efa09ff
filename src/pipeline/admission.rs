//! Bounds on how many requests wait for or are in compute at once, and for how long.
//!
//! Waiting costs memory and, worse, time that the caller may not have. A request that would have to
//! wait too long, judged by how fast the requests before it leave, is refused at once with the time
//! after which it is worth trying again. So whatever is admitted is answered soon, no matter how
//! many requests arrive.
//!
//! Queries and new references each have an [`Admission`] of their own, because a bulk import must
//! not keep vehicles from being answered. Requests that need only the store (listings, look-ups,
//! changes) wait for a [`ConcurrencyLimit`], so that they never take all the threads and
//! connections that queries need.

use super::PipelineError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

/// Requests admitted while it is not known yet how fast they leave.
const ADMITTED_AT_UNKNOWN_RATE: usize = 8;

/// Shortest and longest advice to a refused caller.
const RETRY_AFTER: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(30)];

/// A bounded queue in front of the compute worker.
pub(super) struct Admission {
    places: Arc<Semaphore>,
    capacity: usize,
    /// Smoothed time between two departures in microseconds, while busy; 0 before the first.
    departure_interval_us: AtomicU64,
    last_departure: Mutex<Instant>,
    metrics: Arc<Metrics>,
}

/// A place in the queue; given back when dropped.
pub(super) struct Ticket {
    /// Taken out by `drop`, so that the place is free before the departure is counted.
    place: Option<OwnedSemaphorePermit>,
    admission: Arc<Admission>,
    admitted_at: Instant,
}

impl Admission {
    pub(super) fn new(capacity: usize, metrics: Arc<Metrics>) -> Arc<Self> {
        Arc::new(Self {
            places: Arc::new(Semaphore::new(capacity)),
            capacity,
            departure_interval_us: AtomicU64::new(0),
            last_departure: Mutex::new(Instant::now()),
            metrics,
        })
    }

    /// Takes a place in the queue if the request is expected to be served within `max_wait`;
    /// [`Duration::MAX`] stands for any time at all.
    ///
    /// # Errors
    /// The queue is full or too slow; the error says when to come back.
    pub(super) fn admit(self: &Arc<Self>, max_wait: Duration) -> Result<Ticket, PipelineError> {
        let waiting = self.depth();
        let expected_wait = self.expected_wait(waiting);
        let too_late = match expected_wait {
            Some(wait) => wait > max_wait,
            None => waiting >= ADMITTED_AT_UNKNOWN_RATE && max_wait < Duration::MAX,
        };
        match self.places.clone().try_acquire_owned() {
            Ok(place) if !too_late => {
                self.metrics.queue_entered();
                Ok(Ticket {
                    place: Some(place),
                    admission: self.clone(),
                    admitted_at: Instant::now(),
                })
            }
            _ => {
                self.metrics.rejected(Rejection::QueueFull);
                Err(PipelineError::Overloaded {
                    waiting,
                    retry_after: retry_after(expected_wait.unwrap_or_default(), max_wait),
                })
            }
        }
    }

    /// Requests admitted and not yet departed.
    fn depth(&self) -> usize {
        self.capacity - self.places.available_permits()
    }

    /// Time until `waiting` requests have departed; `None` before the first departure.
    fn expected_wait(&self, waiting: usize) -> Option<Duration> {
        match self.departure_interval_us.load(Ordering::Relaxed) {
            0 => None,
            interval => {
                let wait = interval.saturating_mul(waiting as u64);
                Some(Duration::from_micros(wait))
            }
        }
    }

    /// Counts a departure into the smoothed interval between departures.
    fn departed(&self, admitted_at: Instant) {
        let now = Instant::now();
        let mut last = self
            .last_departure
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        // The server may have been idle before this request came, and idle time says nothing about
        // how long requests take.
        let busy_since = (*last).max(admitted_at);
        let interval = now.saturating_duration_since(busy_since).as_micros() as u64;
        *last = now;

        let smoothed = match self.departure_interval_us.load(Ordering::Relaxed) {
            0 => interval,
            smoothed => (smoothed * 7 + interval) / 8,
        };
        self.departure_interval_us
            .store(smoothed.max(1), Ordering::Relaxed);
    }
}

/// When a refused caller should come back: after the time in which the expected wait shrinks to
/// half of the longest one that it accepts.
fn retry_after(expected_wait: Duration, max_wait: Duration) -> Duration {
    let acceptable = max_wait.min(expected_wait) / 2;
    let [shortest, longest] = RETRY_AFTER;
    expected_wait
        .saturating_sub(acceptable)
        .clamp(shortest, longest)
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.place.take();
        self.admission.departed(self.admitted_at);
        self.admission.metrics.queue_left();
    }
}

/// A bound on requests that use the store at once. The first to wait is the first to be served.
pub(super) struct ConcurrencyLimit {
    permits: Arc<Semaphore>,
    metrics: Arc<Metrics>,
}

impl ConcurrencyLimit {
    pub(super) fn new(at_once: usize, metrics: Arc<Metrics>) -> Self {
        Self {
            permits: Arc::new(Semaphore::new(at_once)),
            metrics,
        }
    }

    /// Waits for a permit, but not longer than `max_wait`. It is given back when dropped.
    ///
    /// Cancel safety: dropped while waiting, the request leaves the queue.
    pub(super) async fn acquire(
        &self,
        max_wait: Duration,
    ) -> Result<OwnedSemaphorePermit, PipelineError> {
        match timeout(max_wait, self.permits.clone().acquire_owned()).await {
            // The semaphore is never closed.
            Ok(permit) => permit.map_err(|_| PipelineError::ShuttingDown),
            Err(_) => {
                self.metrics.rejected(Rejection::StoreBusy);
                Err(PipelineError::StoreBusy)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn admission(capacity: usize) -> Arc<Admission> {
        Admission::new(capacity, Arc::new(Metrics::new().unwrap()))
    }

    #[test]
    fn a_full_queue_refuses_until_a_place_is_given_back() {
        let admission = admission(2);
        let first = admission.admit(Duration::MAX).ok().unwrap();
        let _second = admission.admit(Duration::MAX).ok().unwrap();
        assert_eq!(admission.depth(), 2);
        let Err(refused) = admission.admit(Duration::MAX) else {
            panic!("a third was admitted")
        };
        assert!(refused.retry_after().unwrap() >= Duration::from_secs(1));
        drop(first);
        assert!(admission.admit(Duration::MAX).is_ok());
    }

    #[test]
    fn a_request_that_would_wait_too_long_is_refused_unless_the_queue_is_empty() {
        let admission = admission(100);
        admission
            .departure_interval_us
            .store(300_000, Ordering::Relaxed);
        let max_wait = Duration::from_secs(1);
        let admitted: Vec<_> = (0..4)
            .map(|_| admission.admit(max_wait).ok().unwrap())
            .collect();
        let Err(refused) = admission.admit(max_wait) else {
            panic!("a fifth would wait 1.2 s")
        };
        assert_eq!(refused.retry_after(), Some(Duration::from_secs(1)));
        assert!(
            admission.admit(Duration::from_secs(2)).is_ok(),
            "a request with more time is admitted"
        );
        drop(admitted);
        admission
            .departure_interval_us
            .store(60_000_000, Ordering::Relaxed);
        assert!(
            admission.admit(max_wait).is_ok(),
            "an idle server always tries"
        );
    }

    #[test]
    fn a_burst_at_unknown_rate_is_bounded() {
        let admission = admission(100);
        let admitted: Vec<_> = (0..20)
            .map_while(|_| admission.admit(Duration::from_secs(1)).ok())
            .collect();
        assert_eq!(admitted.len(), ADMITTED_AT_UNKNOWN_RATE);
    }
}

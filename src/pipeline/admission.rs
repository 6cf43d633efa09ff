//! The door: how many requests may wait for or be in compute at once, and for how long.
//!
//! Waiting costs memory and, worse, time that the caller may not have. A request whose turn would
//! come too late, by the pace at which others leave, is refused at once with the time after which
//! it is worth trying again; so what is let in is answered soon, however much is asked.
//!
//! Queries and ingest each have a door of their own: a bulk import must not turn vehicles away.
//! What needs only the store (listings, look-ups, changes) waits for one of a few [`Turns`], so
//! that it never takes all the threads and connections that queries need.

use super::PipelineError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

/// Requests let in while nothing is known about the pace yet.
const PLACES_AT_UNKNOWN_PACE: usize = 8;

pub(super) struct Admission {
    places: Arc<Semaphore>,
    capacity: usize,
    /// Smoothed time between two departures in microseconds, while busy; 0 before the first.
    departure_us: AtomicU64,
    last_departure: Mutex<Instant>,
    metrics: Arc<Metrics>,
}

/// A place in the queue; given back when dropped.
pub(super) struct Ticket {
    place: Option<OwnedSemaphorePermit>,
    admission: Arc<Admission>,
    entered: Instant,
}

impl Admission {
    pub(super) fn new(capacity: usize, metrics: Arc<Metrics>) -> Arc<Self> {
        Arc::new(Self {
            places: Arc::new(Semaphore::new(capacity)),
            capacity,
            departure_us: AtomicU64::new(0),
            last_departure: Mutex::new(Instant::now()),
            metrics,
        })
    }

    /// Takes a place if the turn will come within `patience`, or says when to come back.
    pub(super) fn enter(self: &Arc<Self>, patience: Duration) -> Result<Ticket, PipelineError> {
        let inside = self.depth();
        let pace = self.departure_us.load(Ordering::Relaxed);
        let wait = Duration::from_micros(pace.saturating_mul(inside as u64));
        let too_late = if pace == 0 {
            inside >= PLACES_AT_UNKNOWN_PACE && patience < Duration::MAX
        } else {
            wait > patience
        };
        match self.places.clone().try_acquire_owned() {
            Ok(place) if !too_late => {
                self.metrics.queue_entered();
                Ok(Ticket {
                    place: Some(place),
                    admission: self.clone(),
                    entered: Instant::now(),
                })
            }
            _ => {
                self.metrics.rejected(Rejection::QueueFull);
                Err(PipelineError::Overloaded {
                    waiting: inside,
                    retry_after: come_back_after(wait, patience),
                })
            }
        }
    }

    /// Requests inside.
    fn depth(&self) -> usize {
        self.capacity - self.places.available_permits()
    }

    fn departed(&self, entered: Instant) {
        let now = Instant::now();
        let mut last = self
            .last_departure
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        // Idle time before this request came says nothing about the pace.
        let gap = now
            .saturating_duration_since((*last).max(entered))
            .as_micros() as u64;
        *last = now;
        let smoothed = self.departure_us.load(Ordering::Relaxed);
        let next = if smoothed == 0 {
            gap
        } else {
            (smoothed * 7 + gap) / 8
        };
        self.departure_us.store(next.max(1), Ordering::Relaxed);
    }
}

/// Until half of what waits too long has left, 1 to 30 seconds.
fn come_back_after(wait: Duration, patience: Duration) -> Duration {
    let beyond = wait.saturating_sub(patience.min(wait) / 2);
    beyond.clamp(Duration::from_secs(1), Duration::from_secs(30))
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.place.take();
        self.admission.departed(self.entered);
        self.admission.metrics.queue_left();
    }
}

/// A few places that are taken in turn, first come, first served.
pub(super) struct Turns {
    places: Arc<Semaphore>,
    metrics: Arc<Metrics>,
}

impl Turns {
    pub(super) fn new(places: usize, metrics: Arc<Metrics>) -> Self {
        Self {
            places: Arc::new(Semaphore::new(places)),
            metrics,
        }
    }

    /// Waits for a place, but not longer than `patience`. It is given back when dropped.
    ///
    /// Cancel safety: who is dropped while waiting leaves the line.
    pub(super) async fn take(
        &self,
        patience: Duration,
    ) -> Result<OwnedSemaphorePermit, PipelineError> {
        match timeout(patience, self.places.clone().acquire_owned()).await {
            // The semaphore is never closed.
            Ok(place) => place.map_err(|_| PipelineError::ShuttingDown),
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
    fn the_door_closes_when_full_and_opens_again() {
        let admission = admission(2);
        let first = admission.enter(Duration::MAX).ok().unwrap();
        let _second = admission.enter(Duration::MAX).ok().unwrap();
        assert_eq!(admission.depth(), 2);
        let Err(refused) = admission.enter(Duration::MAX) else {
            panic!("a third was let in")
        };
        assert!(refused.retry_after().unwrap() >= Duration::from_secs(1));
        drop(first);
        assert!(admission.enter(Duration::MAX).is_ok());
    }

    #[test]
    fn who_would_wait_too_long_is_refused_and_who_finds_nobody_is_not() {
        let admission = admission(100);
        admission.departure_us.store(300_000, Ordering::Relaxed);
        let patience = Duration::from_secs(1);
        let inside: Vec<_> = (0..4)
            .map(|_| admission.enter(patience).ok().unwrap())
            .collect();
        let Err(refused) = admission.enter(patience) else {
            panic!("a fifth would wait 1.2 s")
        };
        assert_eq!(refused.retry_after(), Some(Duration::from_secs(1)));
        assert!(
            admission.enter(Duration::from_secs(2)).is_ok(),
            "the more patient are let in"
        );
        drop(inside);
        admission.departure_us.store(60_000_000, Ordering::Relaxed);
        assert!(
            admission.enter(patience).is_ok(),
            "an idle server always tries"
        );
    }

    #[test]
    fn a_burst_at_unknown_pace_is_bounded() {
        let admission = admission(100);
        let inside: Vec<_> = (0..20)
            .map_while(|_| admission.enter(Duration::from_secs(1)).ok())
            .collect();
        assert_eq!(inside.len(), PLACES_AT_UNKNOWN_PACE);
    }
}

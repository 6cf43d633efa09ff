//! The door: how many requests may wait for or be in compute at once.
//!
//! Waiting costs memory and, worse, time that the caller may not have; beyond the bound a request is refused at
//! once, with the time after which a place is likely to be free.

use super::PipelineError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

pub(super) struct Admission {
    places: Arc<Semaphore>,
    capacity: usize,
    /// Smoothed time between two departures in microseconds, while busy.
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

    /// Takes a place, or says when to come back.
    pub(super) fn enter(self: &Arc<Self>) -> Result<Ticket, PipelineError> {
        match self.places.clone().try_acquire_owned() {
            Ok(place) => {
                self.metrics.set_queue_depth(self.depth());
                Ok(Ticket { place: Some(place), admission: self.clone(), entered: Instant::now() })
            }
            Err(_) => {
                self.metrics.rejected(Rejection::QueueFull);
                Err(PipelineError::Overloaded { waiting: self.capacity, retry_after: self.drain_time() })
            }
        }
    }

    /// Requests inside.
    pub(super) fn depth(&self) -> usize {
        self.capacity - self.places.available_permits()
    }

    /// How long half the queue needs to drain at the current pace, 1 to 30 seconds.
    fn drain_time(&self) -> Duration {
        let half = Duration::from_micros(self.departure_us.load(Ordering::Relaxed)) * (self.capacity as u32 / 2);
        half.clamp(Duration::from_secs(1), Duration::from_secs(30))
    }

    fn departed(&self, entered: Instant) {
        let now = Instant::now();
        let mut last = self.last_departure.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        // Idle time before this request came says nothing about the pace.
        let gap = now.saturating_duration_since((*last).max(entered)).as_micros() as u64;
        *last = now;
        let smoothed = self.departure_us.load(Ordering::Relaxed);
        self.departure_us.store(if smoothed == 0 { gap } else { (smoothed * 7 + gap) / 8 }, Ordering::Relaxed);
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.place.take();
        self.admission.departed(self.entered);
        self.admission.metrics.set_queue_depth(self.admission.depth());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_door_closes_when_full_and_opens_again() {
        let admission = Admission::new(2, Arc::new(Metrics::new().unwrap()));
        let first = admission.enter().ok().unwrap();
        let _second = admission.enter().ok().unwrap();
        assert_eq!(admission.depth(), 2);
        let Err(refused) = admission.enter() else { panic!("a third was let in") };
        assert!(refused.retry_after().unwrap() >= Duration::from_secs(1));
        drop(first);
        assert!(admission.enter().is_ok());
    }
}

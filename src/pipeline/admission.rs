//! Bounds on how many requests wait for or are in compute at once, and for how long.
//!
//! Waiting costs memory and, worse, time that the caller may not have. A request that would have to
//! wait too long, judged by how fast the requests before it leave, is refused at once with the time
//! after which it is worth trying again. So whatever is admitted is answered soon, no matter how
//! many requests arrive.
//!
//! Callers share the places. Compute serves them in turn ([`super::fair`]), so that the wait of a
//! request depends on how many of its own caller are ahead of it, and not on how many another has
//! sent. Any caller may fill the places while it is alone; as many again are kept for those that
//! then come and hold less than their share. So one caller that asks without end is refused, and
//! the others are admitted as if there were hardly anybody.
//!
//! Queries and new references each have an [`Admission`] of their own, because a bulk import must
//! not keep vehicles from being answered. Requests that need only the store (listings, look-ups,
//! changes) wait for a [`ConcurrencyLimit`], so that they never take all the threads and
//! connections that queries need.

use super::PipelineError;
use super::caller::Caller;
use super::fair::{FairPermit, FairSemaphore};
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::time::timeout;

/// Requests of one caller admitted while it is not known yet how fast they leave.
const ADMITTED_AT_UNKNOWN_RATE: usize = 8;

/// Shortest and longest advice to a refused caller.
const RETRY_AFTER: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(30)];

/// Of the places kept for callers that hold less than their share, the part that one of them may
/// hold: a quarter of those still free, so that there are some for the next caller.
const PART_OF_KEPT: usize = 4;

/// A bounded queue in front of the compute worker.
pub(super) struct Admission {
    capacity: usize,
    queue: Mutex<Queue>,
    metrics: Arc<Metrics>,
}

/// Who is in the queue, and how fast it moves.
struct Queue {
    /// Requests admitted and not yet departed, of each caller that has any.
    held: HashMap<Caller, usize>,
    /// Their sum.
    depth: usize,
    /// Smoothed time between two departures while busy; none before the first.
    departure_interval: Option<Duration>,
    last_departure: Instant,
}

/// A place in the queue; given back when dropped.
pub(super) struct Ticket {
    admission: Arc<Admission>,
    caller: Caller,
    admitted_at: Instant,
}

impl Admission {
    /// A queue of `capacity` places, and as many for callers that hold less than their share.
    pub(super) fn new(capacity: usize, metrics: Arc<Metrics>) -> Arc<Self> {
        let queue = Queue {
            held: HashMap::new(),
            depth: 0,
            departure_interval: None,
            last_departure: Instant::now(),
        };
        Arc::new(Self {
            capacity,
            queue: Mutex::new(queue),
            metrics,
        })
    }

    /// Takes a place in the queue for `caller` if the request is expected to be served within
    /// `max_wait`; [`Duration::MAX`] stands for any time at all.
    ///
    /// # Errors
    /// The queue is full for this caller, or too slow; the error says when to come back.
    pub(super) fn admit(
        self: &Arc<Self>,
        caller: &Caller,
        max_wait: Duration,
    ) -> Result<Ticket, PipelineError> {
        let mut queue = self.lock();
        let ahead = queue.ahead_of(caller);
        let expected_wait = queue.expected_wait(ahead);
        let too_late = match expected_wait {
            Some(wait) => wait > max_wait,
            None => ahead >= ADMITTED_AT_UNKNOWN_RATE && max_wait < Duration::MAX,
        };
        if too_late || !queue.has_place_for(caller, self.capacity) {
            self.metrics.rejected(Rejection::QueueFull);
            return Err(PipelineError::Overloaded {
                waiting: queue.depth,
                retry_after: retry_after(expected_wait.unwrap_or_default(), max_wait),
            });
        }
        queue.enter(caller);
        self.metrics.queue_entered();
        Ok(Ticket {
            admission: self.clone(),
            caller: caller.clone(),
            admitted_at: Instant::now(),
        })
    }

    // A thread that panics with the lock leaves the counts whole, because nothing between their
    // changes can panic. So a poisoned lock can be used all the same.
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Queue {
    fn held_by(&self, caller: &Caller) -> usize {
        self.held.get(caller).copied().unwrap_or(0)
    }

    /// Requests that are served before the next of `caller` if callers take turns: all of its own,
    /// and of each other caller as many as there are turns until then.
    fn ahead_of(&self, caller: &Caller) -> usize {
        let own = self.held_by(caller);
        let others = self.held.iter().filter(|(other, _)| *other != caller);
        own + others.map(|(_, held)| (*held).min(own + 1)).sum::<usize>()
    }

    /// Whether there is a place for one more request of `caller`. Each half of the queue has
    /// `capacity` places.
    fn has_place_for(&self, caller: &Caller, capacity: usize) -> bool {
        if self.depth < capacity {
            return true;
        }
        let kept = capacity.saturating_mul(2).saturating_sub(self.depth);
        let own = self.held_by(caller);
        if own == 0 {
            return kept > 0;
        }
        let share = capacity / self.held.len();
        own < share.min(kept / PART_OF_KEPT)
    }

    /// Time until `ahead` requests have departed; `None` before the first departure.
    fn expected_wait(&self, ahead: usize) -> Option<Duration> {
        let ahead = u32::try_from(ahead).unwrap_or(u32::MAX);
        Some(self.departure_interval?.saturating_mul(ahead))
    }

    fn enter(&mut self, caller: &Caller) {
        *self.held.entry(caller.clone()).or_default() += 1;
        self.depth += 1;
    }

    fn leave(&mut self, caller: &Caller) {
        self.depth -= 1;
        if let Some(held) = self.held.get_mut(caller) {
            *held -= 1;
            if *held == 0 {
                self.held.remove(caller);
            }
        }
    }

    /// Counts a departure into the smoothed interval between departures.
    fn departed(&mut self, admitted_at: Instant) {
        let now = Instant::now();
        // The server may have been idle before this request came, and idle time says nothing about
        // how long requests take.
        let busy_since = self.last_departure.max(admitted_at);
        let interval = now.saturating_duration_since(busy_since);
        self.last_departure = now;
        let smoothed = match self.departure_interval {
            None => interval,
            Some(smoothed) => (smoothed * 7 + interval) / 8,
        };
        self.departure_interval = Some(smoothed.max(Duration::from_micros(1)));
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

impl Ticket {
    /// Whose place it is.
    pub(super) fn caller(&self) -> &Caller {
        &self.caller
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        let mut queue = self.admission.lock();
        queue.leave(&self.caller);
        queue.departed(self.admitted_at);
        self.admission.metrics.queue_left();
    }
}

/// A bound on requests that use the store at once. Callers take turns; of one caller, the first to
/// wait is the first to be served.
pub(super) struct ConcurrencyLimit {
    permits: FairSemaphore,
    metrics: Arc<Metrics>,
}

impl ConcurrencyLimit {
    pub(super) fn new(at_once: usize, metrics: Arc<Metrics>) -> Self {
        Self {
            permits: FairSemaphore::new(at_once),
            metrics,
        }
    }

    /// Waits for a permit, but not longer than `max_wait`. It is given back when dropped.
    ///
    /// Cancel safety: dropped while waiting, the request leaves its line.
    pub(super) async fn acquire(
        &self,
        caller: &Caller,
        max_wait: Duration,
    ) -> Result<FairPermit, PipelineError> {
        timeout(max_wait, self.permits.acquire(caller))
            .await
            .map_err(|_| {
                self.metrics.rejected(Rejection::StoreBusy);
                PipelineError::StoreBusy
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use proptest::prelude::*;

    fn admission(capacity: usize) -> Arc<Admission> {
        Admission::new(capacity, Arc::new(Metrics::new().unwrap()))
    }

    fn caller(name: usize) -> Caller {
        Caller::Key(name.to_string().into())
    }

    fn one() -> Caller {
        caller(0)
    }

    fn departing_every(admission: &Admission, interval: Duration) {
        admission.lock().departure_interval = Some(interval);
    }

    #[test]
    fn a_full_queue_refuses_until_a_place_is_given_back() {
        let admission = admission(2);
        let first = admission.admit(&one(), Duration::MAX).ok().unwrap();
        let _second = admission.admit(&one(), Duration::MAX).ok().unwrap();
        assert_eq!(admission.lock().depth, 2);
        let Err(refused) = admission.admit(&one(), Duration::MAX) else {
            panic!("a third was admitted")
        };
        assert!(refused.retry_after().unwrap() >= Duration::from_secs(1));
        drop(first);
        assert!(admission.admit(&one(), Duration::MAX).is_ok());
    }

    #[test]
    fn a_request_that_would_wait_too_long_is_refused_unless_the_queue_is_empty() {
        let admission = admission(100);
        departing_every(&admission, Duration::from_millis(300));
        let max_wait = Duration::from_secs(1);
        let admitted: Vec<_> = (0..4)
            .map(|_| admission.admit(&one(), max_wait).ok().unwrap())
            .collect();
        let Err(refused) = admission.admit(&one(), max_wait) else {
            panic!("a fifth would wait 1.2 s")
        };
        assert_eq!(refused.retry_after(), Some(Duration::from_secs(1)));
        assert!(
            admission.admit(&one(), Duration::from_secs(2)).is_ok(),
            "a request with more time is admitted"
        );
        drop(admitted);
        departing_every(&admission, Duration::from_secs(60));
        assert!(
            admission.admit(&one(), max_wait).is_ok(),
            "an idle server always tries"
        );
    }

    #[test]
    fn a_burst_at_unknown_rate_is_bounded() {
        let admission = admission(100);
        let admitted: Vec<_> = (0..20)
            .map_while(|_| admission.admit(&one(), Duration::from_secs(1)).ok())
            .collect();
        assert_eq!(admitted.len(), ADMITTED_AT_UNKNOWN_RATE);
    }

    #[test]
    fn a_caller_that_fills_the_queue_does_not_keep_another_out() {
        let admission = admission(64);
        let flood: Vec<_> = (0..200)
            .map_while(|_| admission.admit(&caller(0), Duration::MAX).ok())
            .collect();
        assert_eq!(flood.len(), 64, "one alone may fill the places");
        let mut others = Vec::new();
        for name in 1..=32 {
            let place = admission.admit(&caller(name), Duration::MAX);
            others.push(place.ok().unwrap_or_else(|| panic!("{name} was kept out")));
            assert!(admission.admit(&caller(0), Duration::MAX).is_err());
        }
        drop(flood);
        assert!(admission.admit(&caller(0), Duration::MAX).is_ok());
    }

    #[test]
    fn the_wait_of_a_caller_is_that_of_its_own_turn() {
        let admission = admission(64);
        departing_every(&admission, Duration::from_millis(100));
        let max_wait = Duration::from_millis(1950);
        let flood: Vec<_> = (0..200)
            .map_while(|_| admission.admit(&caller(0), max_wait).ok())
            .collect();
        assert_eq!(flood.len(), 20);
        let short = Duration::from_millis(150);
        let first = admission.admit(&caller(1), short);
        assert!(first.is_ok(), "one request is ahead of it and not twenty");
        let Err(refused) = admission.admit(&caller(1), short) else {
            panic!("its own and two of the other are ahead of the second")
        };
        assert_eq!(
            refused.code(),
            placeformer_core::error::ErrorCode::Overloaded
        );
    }

    proptest! {
        /// However callers come and go, the queue is bounded, nobody holds more than the places
        /// that any caller may fill, and its counts add up.
        #[test]
        fn the_queue_stays_within_its_bounds(
            capacity in 1usize..20,
            steps in prop::collection::vec((0usize..6, any::<bool>()), 1..300),
        ) {
            let admission = admission(capacity);
            let mut tickets: Vec<Ticket> = Vec::new();
            for (name, enters) in steps {
                if enters {
                    let newcomer = !tickets.iter().any(|ticket| ticket.caller == caller(name));
                    let had_room = tickets.len() < 2 * capacity;
                    match admission.admit(&caller(name), Duration::MAX) {
                        Ok(ticket) => tickets.push(ticket),
                        Err(_) => prop_assert!(!(newcomer && had_room)),
                    }
                } else if !tickets.is_empty() {
                    tickets.swap_remove(name % tickets.len());
                }
                let queue = admission.lock();
                prop_assert_eq!(queue.depth, tickets.len());
                prop_assert_eq!(queue.held.values().sum::<usize>(), tickets.len());
                prop_assert!(queue.depth <= 2 * capacity);
                prop_assert!(queue.held.values().all(|held| (1..=capacity).contains(held)));
            }
        }
    }
}

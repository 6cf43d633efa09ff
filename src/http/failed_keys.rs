//! How often one address may present a key that is not known.
//!
//! Keys are random and cannot be guessed. But each attempt costs a hash and a line in the log, and a
//! client that has an old key repeats it for ever. So an address that fails too often is refused
//! before its key is looked at, until the minute is over.

use super::problem::ApiError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use placeformer_core::error::ErrorCode;
use quick_cache::sync::Cache;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Addresses that are remembered. One that is forgotten begins anew.
const MOST_ADDRESSES: usize = 10_000;

/// How long failures are counted together.
const WINDOW: Duration = Duration::from_secs(60);

/// The failures of the addresses that had any of late.
pub struct FailedKeys {
    windows: Cache<IpAddr, Arc<Mutex<Window>>>,
    metrics: Arc<Metrics>,
}

/// The failures of one address.
struct Window {
    began: Instant,
    failures: u32,
}

impl Window {
    /// Time until it is over; none if it is.
    fn left(&self) -> Option<Duration> {
        WINDOW.checked_sub(self.began.elapsed())
    }
}

impl FailedKeys {
    /// No failures yet.
    pub fn new(metrics: Arc<Metrics>) -> Self {
        Self {
            windows: Cache::new(MOST_ADDRESSES),
            metrics,
        }
    }

    /// Lets an address present a key if it has failed less than `most` times within the minute; 0
    /// is no bound.
    ///
    /// # Errors
    /// `rate_limited`, with the rest of the minute to wait.
    pub fn check(&self, address: IpAddr, most: u32) -> Result<(), ApiError> {
        let Some(window) = self.windows.get(&address) else {
            return Ok(());
        };
        let window = lock(&window);
        let (Some(left), false) = (window.left(), most == 0 || window.failures < most) else {
            return Ok(());
        };
        self.metrics.rejected(Rejection::FailedKeys);
        let detail = format!("{most} keys from this address were wrong within a minute");
        Err(ApiError::new(ErrorCode::RateLimited, detail).retry_after(left))
    }

    /// Counts a key that is not known.
    pub fn count(&self, address: IpAddr) {
        let fresh = || {
            Ok::<_, std::convert::Infallible>(Arc::new(Mutex::new(Window {
                began: Instant::now(),
                failures: 0,
            })))
        };
        let Ok(window) = self.windows.get_or_insert_with(&address, fresh);
        let mut window = lock(&window);
        if window.left().is_none() {
            window.began = Instant::now();
            window.failures = 0;
        }
        window.failures = window.failures.saturating_add(1);
    }
}

/// A thread that panics with the lock leaves two numbers, which are as good as any. So a poisoned
/// lock can be used all the same.
fn lock(window: &Mutex<Window>) -> MutexGuard<'_, Window> {
    window.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::Ipv4Addr;

    fn address(number: u32) -> IpAddr {
        IpAddr::V4(Ipv4Addr::from_bits(number))
    }

    fn failed_keys() -> FailedKeys {
        FailedKeys::new(Arc::new(Metrics::new().unwrap()))
    }

    #[test]
    fn an_address_that_fails_too_often_waits_for_the_end_of_the_minute() {
        let failed = failed_keys();
        for _ in 0..3 {
            failed.check(address(1), 3).unwrap();
            failed.count(address(1));
        }
        let refused = failed.check(address(1), 3).unwrap_err();
        assert_eq!(refused.code, ErrorCode::RateLimited);
        assert!(refused.retry_after.unwrap() <= WINDOW);
        failed.check(address(2), 3).unwrap();
        failed.check(address(1), 4).unwrap();
        failed.check(address(1), 0).unwrap();
        let window = failed.windows.get(&address(1)).unwrap();
        // As if the minute were over.
        let Some(began) = Instant::now().checked_sub(WINDOW) else {
            return;
        };
        lock(&window).began = began;
        failed.check(address(1), 3).unwrap();
        failed.count(address(1));
        assert_eq!(lock(&window).failures, 1);
    }

    #[test]
    fn any_number_of_addresses_takes_bounded_memory() {
        let failed = failed_keys();
        for number in 0..3 * MOST_ADDRESSES as u32 {
            failed.count(address(number));
        }
        assert!(failed.windows.len() <= MOST_ADDRESSES);
    }
}

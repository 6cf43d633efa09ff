//! Tries again what failed for a reason that may pass, such as a busy server.
//!
//! The waits double from attempt to attempt and carry jitter, so that many clients that were turned
//! away together do not come back together. A server that says when to come back (`Retry-After`)
//! is not asked earlier than that.

use backon::{BackoffBuilder, ExponentialBuilder};
use std::time::Duration;

/// Whether an error may pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Retry {
    /// The same request would fail again.
    Never,
    /// Another attempt may succeed.
    Later {
        /// How long the server asks to be left alone, if it says so.
        after: Option<Duration>,
    },
}

/// How often to try, and how long to wait in between.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RetryPolicy {
    /// Attempts in all; zero counts as one.
    pub attempts: u32,
    /// The shortest wait before the second attempt.
    pub first_wait: Duration,
    /// The longest wait, also where a server asks for a longer one.
    pub longest_wait: Duration,
}

impl RetryPolicy {
    /// Calls `attempt` until it succeeds, fails for good by `judge`, or has been called often
    /// enough. Blocks the thread in between.
    ///
    /// # Errors
    /// The last attempt's own.
    pub fn run<T, E>(
        &self,
        attempt: impl FnMut() -> Result<T, E>,
        judge: impl Fn(&E) -> Retry,
    ) -> Result<T, E> {
        self.run_sleeping(attempt, judge, std::thread::sleep)
    }

    fn run_sleeping<T, E>(
        &self,
        mut attempt: impl FnMut() -> Result<T, E>,
        judge: impl Fn(&E) -> Retry,
        mut sleep: impl FnMut(Duration),
    ) -> Result<T, E> {
        let mut waits = self.waits();
        loop {
            let error = match attempt() {
                Ok(value) => return Ok(value),
                Err(error) => error,
            };
            let Retry::Later { after } = judge(&error) else {
                return Err(error);
            };
            let Some(wait) = waits.next() else {
                return Err(error);
            };
            let asked = after.unwrap_or(Duration::ZERO);
            sleep(wait.max(asked).min(self.longest_wait));
        }
    }

    /// The waits between the attempts, which end with the last attempt.
    fn waits(&self) -> impl Iterator<Item = Duration> {
        ExponentialBuilder::new()
            .with_jitter()
            .with_min_delay(self.first_wait)
            .with_max_delay(self.longest_wait)
            .with_max_times(self.attempts.saturating_sub(1) as usize)
            .build()
    }
}

/// The wait that a `Retry-After` header asks for in seconds. The header's other form, a date, is
/// not read.
pub fn parse_retry_after(header: &str) -> Option<Duration> {
    header.trim().parse().ok().map(Duration::from_secs)
}

#[cfg(test)]
mod tests {
    use super::*;

    const POLICY: RetryPolicy = RetryPolicy {
        attempts: 4,
        first_wait: Duration::from_millis(200),
        longest_wait: Duration::from_secs(60),
    };

    /// The waits between attempts that all end in `verdict`, and the number of attempts.
    fn waits(policy: RetryPolicy, verdict: Retry) -> (Vec<Duration>, u32) {
        let mut waits = Vec::new();
        let mut attempts = 0;
        let attempt = || {
            attempts += 1;
            Err::<(), _>("busy")
        };
        let result = policy.run_sleeping(attempt, |_| verdict, |wait| waits.push(wait));
        assert_eq!(result, Err("busy"));
        (waits, attempts)
    }

    #[test]
    fn waits_double_and_carry_at_most_their_own_length_of_jitter() {
        let (waits, attempts) = waits(POLICY, Retry::Later { after: None });
        assert_eq!((waits.len(), attempts), (3, 4));
        for (wait, shortest) in waits.iter().zip([200, 400, 800]) {
            let shortest = Duration::from_millis(shortest);
            assert!((shortest..=2 * shortest).contains(wait), "{waits:?}");
        }
    }

    #[test]
    fn a_server_is_not_asked_earlier_than_it_said_within_the_limit() {
        let after = |seconds| Retry::Later {
            after: Some(Duration::from_secs(seconds)),
        };
        assert_eq!(waits(POLICY, after(7)).0, [Duration::from_secs(7); 3]);
        assert_eq!(waits(POLICY, after(3600)).0, [POLICY.longest_wait; 3]);
        let soon = waits(POLICY, after(0)).0;
        assert!(soon[0] >= POLICY.first_wait, "{soon:?}");
    }

    #[test]
    fn what_cannot_pass_is_tried_once() {
        assert_eq!(waits(POLICY, Retry::Never), (Vec::new(), 1));
        let once = RetryPolicy {
            attempts: 0,
            ..POLICY
        };
        assert_eq!(waits(once, Retry::Later { after: None }).1, 1);
    }

    #[test]
    fn a_later_success_is_returned() {
        let mut left = 2;
        let attempt = || {
            if left > 0 {
                left -= 1;
                return Err("busy");
            }
            Ok("done")
        };
        let judge = |_: &&str| Retry::Later { after: None };
        assert_eq!(POLICY.run_sleeping(attempt, judge, |_| {}), Ok("done"));
    }

    #[test]
    fn a_retry_after_header_is_read_in_seconds() {
        assert_eq!(parse_retry_after(" 5 "), Some(Duration::from_secs(5)));
        assert_eq!(parse_retry_after("Wed, 21 Oct 2026 07:28:00 GMT"), None);
    }
}

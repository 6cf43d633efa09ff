//! How many requests a second one caller may send.

use super::config::AuthConfig;
use super::problem::ApiError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use crate::pipeline::Caller;
use governor::clock::{Clock, DefaultClock};
use governor::{DefaultDirectRateLimiter, DefaultKeyedRateLimiter, NotUntil, Quota, RateLimiter};
use placeformer_core::error::ErrorCode;
use std::collections::HashMap;
use std::net::IpAddr;
use std::num::NonZeroU32;
use std::sync::Arc;

/// Addresses that are remembered before those that have been idle are forgotten.
const MAX_ADDRESSES: usize = 10_000;

/// The rates of all callers.
pub struct RateLimits {
    /// By name of key; a key without a bound is missing.
    keys: HashMap<String, Rate>,
    /// For a service without keys; `None` without a bound.
    networks: Option<DefaultKeyedRateLimiter<IpAddr>>,
    metrics: Arc<Metrics>,
}

/// The rate of one caller.
#[derive(Clone)]
struct Rate {
    quota: Quota,
    limiter: Arc<DefaultDirectRateLimiter>,
}

impl Rate {
    fn new(quota: Quota) -> Self {
        Self {
            quota,
            limiter: Arc::new(RateLimiter::direct(quota)),
        }
    }
}

impl RateLimits {
    /// One rate for each key; on a service without keys, one for each address.
    pub fn new(config: &AuthConfig, metrics: Arc<Metrics>) -> Self {
        Self::made(config, metrics, &HashMap::new())
    }

    /// The rates of other settings. Callers whose rate is the same go on with what they have used
    /// up of it.
    pub fn renewed(&self, config: &AuthConfig) -> Self {
        Self::made(config, self.metrics.clone(), &self.keys)
    }

    fn made(config: &AuthConfig, metrics: Arc<Metrics>, old: &HashMap<String, Rate>) -> Self {
        let mut keys = HashMap::new();
        for key in &config.keys {
            let own_rate = key.requests_per_second;
            let per_second = own_rate.unwrap_or(config.requests_per_second);
            if let Some(quota) = quota(per_second, config.burst) {
                let old = old.get(&key.name).filter(|old| old.quota == quota);
                let rate = old.cloned().unwrap_or_else(|| Rate::new(quota));
                keys.insert(key.name.clone(), rate);
            }
        }
        Self {
            keys,
            networks: quota(config.requests_per_second, config.burst).map(RateLimiter::keyed),
            metrics,
        }
    }

    /// Counts one request of `caller`.
    ///
    /// # Errors
    /// `rate_limited` when the caller's rate is used up.
    pub fn check(&self, caller: &Caller) -> Result<(), ApiError> {
        let Some(refusal) = self.refusal(caller) else {
            return Ok(());
        };
        self.metrics.rejected(Rejection::RateLimited);
        let per_second = 1.0 / refusal.quota().replenish_interval().as_secs_f64();
        let detail = format!("at most {} requests a second", per_second.round() as u64);
        let wait = refusal.wait_time_from(DefaultClock::default().now());
        Err(ApiError::new(ErrorCode::RateLimited, detail).retry_after(wait))
    }

    /// Counts one request of `caller`; says until when it is refused, if it is.
    fn refusal(&self, caller: &Caller) -> Option<NotUntil<<DefaultClock as Clock>::Instant>> {
        match caller {
            Caller::Key(name) => self.keys.get(&**name)?.limiter.check().err(),
            Caller::Network(network) => {
                let limits = self.networks.as_ref()?;
                if limits.len() > MAX_ADDRESSES {
                    limits.retain_recent();
                }
                limits.check_key(network).err()
            }
            Caller::Local => None,
        }
    }
}

/// `None` is no bound; a burst of 0 means as many requests as a second allows.
fn quota(per_second: u32, burst: u32) -> Option<Quota> {
    let per_second = NonZeroU32::new(per_second)?;
    let burst = NonZeroU32::new(burst).unwrap_or(per_second);
    Some(Quota::per_second(per_second).allow_burst(burst))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metrics() -> Arc<Metrics> {
        Arc::new(Metrics::new().unwrap())
    }

    #[test]
    fn a_caller_beyond_its_rate_is_told_when_to_come_back() {
        let config = AuthConfig {
            requests_per_second: 2,
            ..Default::default()
        };
        let limits = RateLimits::new(&config, metrics());
        let one = "10.0.0.1".parse().unwrap();
        let other = "10.0.0.2".parse().unwrap();
        assert!(
            limits.check(&Caller::Network(one)).is_ok()
                && limits.check(&Caller::Network(one)).is_ok()
        );
        let refused = limits.check(&Caller::Network(one)).unwrap_err();
        assert_eq!(refused.code, ErrorCode::RateLimited);
        assert!(refused.retry_after.unwrap() <= std::time::Duration::from_secs(1));
        assert!(limits.check(&Caller::Network(other)).is_ok());
    }

    #[test]
    fn settings_read_again_give_nobody_a_new_burst() {
        let key = |rate| super::super::config::ApiKey {
            name: "fleet".into(),
            sha256: "0".repeat(64).into(),
            role: super::super::config::Role::Read,
            requests_per_second: Some(rate),
            maps: None,
        };
        let config = |rate, others| AuthConfig {
            keys: vec![key(rate)],
            requests_per_second: others,
            ..Default::default()
        };
        let fleet = Caller::Key("fleet".into());
        let limits = RateLimits::new(&config(1, 5), metrics());
        assert!(limits.check(&fleet).is_ok() && limits.check(&fleet).is_err());
        let limits = limits.renewed(&config(1, 7));
        assert!(limits.check(&fleet).is_err());
        let limits = limits.renewed(&config(2, 7));
        assert!(limits.check(&fleet).is_ok());
    }
}

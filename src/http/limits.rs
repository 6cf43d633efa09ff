//! How fast one caller may ask, and how many bytes of bodies are held at once.

use super::config::AuthConfig;
use crate::error::ErrorCode;
use crate::http::problem::ApiError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use governor::clock::{Clock, DefaultClock};
use governor::{DefaultDirectRateLimiter, DefaultKeyedRateLimiter, Quota, RateLimiter};
use std::collections::HashMap;
use std::net::IpAddr;
use std::num::NonZeroU32;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Addresses whose pace is remembered before the idle ones are forgotten.
const ADDRESSES_KEPT: usize = 10_000;

/// Paces of all callers.
pub struct RateLimits {
    keys: HashMap<String, DefaultDirectRateLimiter>,
    addresses: Option<DefaultKeyedRateLimiter<IpAddr>>,
    metrics: Arc<Metrics>,
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Caller {
    /// The holder of a key.
    Key(String),
    /// Anyone, on an open service.
    Address(IpAddr),
}

impl RateLimits {
    /// One pace per key; on an open service one per address.
    pub fn new(config: &AuthConfig, metrics: Arc<Metrics>) -> Self {
        let keys = config.keys.iter().filter_map(|key| {
            let pace = key.requests_per_second.unwrap_or(config.requests_per_second);
            Some((key.name.clone(), RateLimiter::direct(quota(pace, config.burst)?)))
        });
        Self {
            keys: keys.collect(),
            addresses: quota(config.requests_per_second, config.burst).map(RateLimiter::keyed),
            metrics,
        }
    }

    /// Counts one request; fails when the caller's rate is used up.
    pub fn check(&self, caller: &Caller) -> Result<(), ApiError> {
        let wait = match caller {
            Caller::Key(name) => self.keys.get(name).and_then(|limit| limit.check().err()),
            Caller::Address(address) => self.addresses.as_ref().and_then(|limits| {
                if limits.len() > ADDRESSES_KEPT {
                    limits.retain_recent();
                }
                limits.check_key(address).err()
            }),
        };
        let Some(wait) = wait else { return Ok(()) };
        self.metrics.rejected(Rejection::RateLimited);
        let detail = format!("at most {} requests a second", wait.quota().replenish_interval_rate());
        Err(ApiError::new(ErrorCode::RateLimited, detail)
            .retry_after(wait.wait_time_from(DefaultClock::default().now())))
    }
}

trait ReplenishRate {
    fn replenish_interval_rate(&self) -> u64;
}

impl ReplenishRate for Quota {
    fn replenish_interval_rate(&self) -> u64 {
        (1.0 / self.replenish_interval().as_secs_f64()).round() as u64
    }
}

fn quota(per_second: u32, burst: u32) -> Option<Quota> {
    let per_second = NonZeroU32::new(per_second)?;
    Some(Quota::per_second(per_second).allow_burst(NonZeroU32::new(burst).unwrap_or(per_second)))
}

/// Bytes of bodies that may be held at once.
pub struct BodyMemory {
    blocks: Arc<Semaphore>,
    metrics: Arc<Metrics>,
}

/// Bytes taken; given back when dropped.
pub struct Held {
    permit: OwnedSemaphorePermit,
    room: usize,
}

impl BodyMemory {
    const BLOCK: usize = 64 << 10;

    /// A budget in bytes.
    pub fn new(bytes: usize, metrics: Arc<Metrics>) -> Self {
        Self { blocks: Arc::new(Semaphore::new(bytes.div_ceil(Self::BLOCK).min(Semaphore::MAX_PERMITS))), metrics }
    }

    /// Starts holding nothing.
    pub fn hold(&self) -> Result<Held, ApiError> {
        Ok(Held { permit: self.take(1)?, room: Self::BLOCK })
    }

    /// Grows `held` to cover `bytes` in all.
    pub fn cover(&self, held: &mut Held, bytes: usize) -> Result<(), ApiError> {
        if bytes > held.room {
            let blocks = (bytes - held.room).div_ceil(Self::BLOCK);
            held.permit.merge(self.take(blocks)?);
            held.room += blocks * Self::BLOCK;
        }
        Ok(())
    }

    fn take(&self, blocks: usize) -> Result<OwnedSemaphorePermit, ApiError> {
        let blocks = u32::try_from(blocks).unwrap_or(u32::MAX);
        self.blocks.clone().try_acquire_many_owned(blocks).map_err(|_| {
            self.metrics.rejected(Rejection::BodyMemory);
            ApiError::new(ErrorCode::Overloaded, "too many bytes of bodies are being received at once")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metrics() -> Arc<Metrics> {
        Arc::new(Metrics::new().unwrap())
    }

    #[test]
    fn a_caller_beyond_its_pace_is_told_when_to_come_back() {
        let config = AuthConfig { requests_per_second: 2, ..Default::default() };
        let limits = RateLimits::new(&config, metrics());
        let (one, other) = ("10.0.0.1".parse().unwrap(), "10.0.0.2".parse().unwrap());
        assert!(limits.check(&Caller::Address(one)).is_ok() && limits.check(&Caller::Address(one)).is_ok());
        let refused = limits.check(&Caller::Address(one)).unwrap_err();
        assert_eq!(refused.code, ErrorCode::RateLimited);
        assert!(refused.retry_after.unwrap() <= std::time::Duration::from_secs(1));
        assert!(limits.check(&Caller::Address(other)).is_ok());
    }

    #[test]
    fn body_memory_is_given_back() {
        let memory = BodyMemory::new(128 << 10, metrics());
        let mut first = memory.hold().unwrap();
        assert!(memory.cover(&mut first, 129 << 10).is_err());
        memory.cover(&mut first, 100 << 10).unwrap();
        assert!(memory.hold().is_err());
        drop(first);
        assert!(memory.hold().is_ok());
    }
}

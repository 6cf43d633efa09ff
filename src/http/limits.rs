//! How fast one caller may ask, and how many bytes of bodies are held at once.

use super::config::AuthConfig;
use crate::http::problem::ApiError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use bytes::Bytes;
use governor::clock::{Clock, DefaultClock};
use governor::{DefaultDirectRateLimiter, DefaultKeyedRateLimiter, Quota, RateLimiter};
use placeformer_core::error::ErrorCode;
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
            let pace = key
                .requests_per_second
                .unwrap_or(config.requests_per_second);
            Some((
                key.name.clone(),
                RateLimiter::direct(quota(pace, config.burst)?),
            ))
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
        let detail = format!(
            "at most {} requests a second",
            wait.quota().replenish_interval_rate()
        );
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
    metrics: Arc<Metrics>,
}

/// Bytes together with what they take of the budget, wherever they go.
struct Charged {
    bytes: Vec<u8>,
    _held: Arc<Held>,
}

impl AsRef<[u8]> for Charged {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

const BLOCK: usize = 64 << 10;

impl BodyMemory {
    /// A budget in bytes.
    pub fn new(bytes: usize, metrics: Arc<Metrics>) -> Self {
        Self {
            blocks: Arc::new(Semaphore::new(
                bytes.div_ceil(BLOCK).min(Semaphore::MAX_PERMITS),
            )),
            metrics,
        }
    }

    /// Starts with room for 64 KiB.
    pub fn hold(&self) -> Result<Held, ApiError> {
        Ok(Held {
            permit: take(&self.blocks, 1, &self.metrics)?,
            metrics: self.metrics.clone(),
        })
    }
}

impl Held {
    /// Makes room for `bytes` in all, by taking more or by giving back.
    pub fn resize(&mut self, bytes: usize) -> Result<(), ApiError> {
        let (have, want) = (self.permit.num_permits(), bytes.div_ceil(BLOCK).max(1));
        if want > have {
            self.permit
                .merge(take(self.permit.semaphore(), want - have, &self.metrics)?);
        } else {
            drop(self.permit.split(have - want));
        }
        Ok(())
    }

    /// A buffer with this room.
    pub fn keep_one(self, bytes: Vec<u8>) -> Bytes {
        Bytes::from_owner(Charged {
            bytes,
            _held: Arc::new(self),
        })
    }

    /// Buffers that share this room until the last of them, and of their clones, is dropped.
    pub fn keep(self, buffers: Vec<Vec<u8>>) -> Vec<Bytes> {
        let held = Arc::new(self);
        buffers
            .into_iter()
            .map(|bytes| {
                Bytes::from_owner(Charged {
                    bytes,
                    _held: held.clone(),
                })
            })
            .collect()
    }
}

fn take(
    blocks: &Arc<Semaphore>,
    count: usize,
    metrics: &Metrics,
) -> Result<OwnedSemaphorePermit, ApiError> {
    let count = u32::try_from(count).unwrap_or(u32::MAX);
    blocks.clone().try_acquire_many_owned(count).map_err(|_| {
        metrics.rejected(Rejection::BodyMemory);
        ApiError::new(
            ErrorCode::Overloaded,
            "too many bytes of bodies are being received at once",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metrics() -> Arc<Metrics> {
        Arc::new(Metrics::new().unwrap())
    }

    #[test]
    fn a_caller_beyond_its_pace_is_told_when_to_come_back() {
        let config = AuthConfig {
            requests_per_second: 2,
            ..Default::default()
        };
        let limits = RateLimits::new(&config, metrics());
        let (one, other) = ("10.0.0.1".parse().unwrap(), "10.0.0.2".parse().unwrap());
        assert!(
            limits.check(&Caller::Address(one)).is_ok()
                && limits.check(&Caller::Address(one)).is_ok()
        );
        let refused = limits.check(&Caller::Address(one)).unwrap_err();
        assert_eq!(refused.code, ErrorCode::RateLimited);
        assert!(refused.retry_after.unwrap() <= std::time::Duration::from_secs(1));
        assert!(limits.check(&Caller::Address(other)).is_ok());
    }

    #[test]
    fn body_memory_is_given_back() {
        let memory = BodyMemory::new(128 << 10, metrics());
        let mut first = memory.hold().unwrap();
        assert!(first.resize(129 << 10).is_err());
        first.resize(100 << 10).unwrap();
        assert!(memory.hold().is_err());
        first.resize(1).unwrap();
        assert!(memory.hold().is_ok());
        first.resize(128 << 10).unwrap();
        drop(first);
        assert!(memory.hold().is_ok());
    }

    #[test]
    fn bytes_are_charged_until_their_last_clone_is_gone() {
        let memory = BodyMemory::new(64 << 10, metrics());
        let images = memory.hold().unwrap().keep(vec![vec![1, 2, 3], vec![4]]);
        let part = images[0].slice(1..2);
        drop(images);
        assert!(memory.hold().is_err());
        drop(part);
        assert!(memory.hold().is_ok());
    }
}

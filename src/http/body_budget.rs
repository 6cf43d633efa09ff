//! One budget for the memory of all request bodies, so that many large uploads at once cannot
//! exhaust the process.
//!
//! Whoever reads a body reserves its memory first and enlarges or reduces the reservation as
//! buffers come and go. What is left at the end is attached to the images themselves, so that it
//! is given back when the pipeline has dropped the last clone of them.

use super::problem::ApiError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// The unit of reservations in bytes; a permit of the semaphore stands for one block.
const BLOCK_BYTES: usize = 64 << 10;

/// The memory that bodies may take together.
pub struct BodyBudget {
    blocks: Arc<Semaphore>,
    metrics: Arc<Metrics>,
}

/// A share of the budget, given back when dropped.
pub struct Reservation {
    permit: OwnedSemaphorePermit,
    metrics: Arc<Metrics>,
}

/// A buffer that keeps its reservation as long as it lives.
struct ReservedBuffer {
    bytes: Vec<u8>,
    /// Shared with the other buffers of the same request.
    _reservation: Arc<Reservation>,
}

impl AsRef<[u8]> for ReservedBuffer {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl BodyBudget {
    /// A budget of `bytes`.
    pub fn new(bytes: usize, metrics: Arc<Metrics>) -> Self {
        let blocks = bytes.div_ceil(BLOCK_BYTES).min(Semaphore::MAX_PERMITS);
        Self {
            blocks: Arc::new(Semaphore::new(blocks)),
            metrics,
        }
    }

    /// Reserves one block, 64 KiB.
    ///
    /// # Errors
    /// `overloaded` if nothing of the budget is left.
    pub fn reserve(&self) -> Result<Reservation, ApiError> {
        Ok(Reservation {
            permit: take_blocks(&self.blocks, 1, &self.metrics)?,
            metrics: self.metrics.clone(),
        })
    }
}

impl Reservation {
    /// Makes this a reservation of `bytes` in all, by taking more or by giving back.
    ///
    /// # Errors
    /// `overloaded` if the budget has not so much left; the reservation stays as it is.
    pub fn resize(&mut self, bytes: usize) -> Result<(), ApiError> {
        let have = self.permit.num_permits();
        let want = bytes.div_ceil(BLOCK_BYTES).max(1);
        if want > have {
            let more = take_blocks(self.permit.semaphore(), want - have, &self.metrics)?;
            self.permit.merge(more);
        } else {
            drop(self.permit.split(have - want));
        }
        Ok(())
    }

    /// Attaches the reservation to one buffer.
    pub fn attach_one(self, bytes: Vec<u8>) -> Bytes {
        Bytes::from_owner(ReservedBuffer {
            bytes,
            _reservation: Arc::new(self),
        })
    }

    /// Attaches the reservation to several buffers, until the last of them, and of their clones,
    /// is dropped.
    pub fn attach(self, buffers: Vec<Vec<u8>>) -> Vec<Bytes> {
        let reservation = Arc::new(self);
        let attach_to = |bytes| {
            Bytes::from_owner(ReservedBuffer {
                bytes,
                _reservation: reservation.clone(),
            })
        };
        buffers.into_iter().map(attach_to).collect()
    }
}

fn take_blocks(
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
    fn reserved_memory_is_given_back() {
        let budget = BodyBudget::new(128 << 10, metrics());
        let mut first = budget.reserve().unwrap();
        assert!(first.resize(129 << 10).is_err());
        first.resize(100 << 10).unwrap();
        assert!(budget.reserve().is_err());
        first.resize(1).unwrap();
        assert!(budget.reserve().is_ok());
        first.resize(128 << 10).unwrap();
        drop(first);
        assert!(budget.reserve().is_ok());
    }

    #[test]
    fn bytes_are_charged_until_their_last_clone_is_gone() {
        let budget = BodyBudget::new(64 << 10, metrics());
        let images = budget
            .reserve()
            .unwrap()
            .attach(vec![vec![1, 2, 3], vec![4]]);
        let part = images[0].slice(1..2);
        drop(images);
        assert!(budget.reserve().is_err());
        drop(part);
        assert!(budget.reserve().is_ok());
    }
}

//! Budgets for memory that clients make the service use: one for the bodies of all requests, one
//! for all answers that their clients have not taken yet. So neither many large uploads nor many
//! listings that nobody reads can exhaust the process.
//!
//! Whoever fills a buffer reserves its memory first and enlarges or reduces the reservation as
//! buffers come and go. What is left at the end is attached to the bytes themselves, so that it is
//! given back when the last clone of them is dropped: of an image by the pipeline, of an answer by
//! the connection that has written it.

use super::problem::ApiError;
use crate::ops::Metrics;
use crate::ops::metrics::Rejection;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// The unit of reservations in bytes; a permit of the semaphore stands for one block.
const BLOCK_BYTES: usize = 64 << 10;

/// The memory that buffers of one kind may take together.
pub struct MemoryBudget {
    blocks: Arc<Semaphore>,
    refusal: Refusal,
}

/// How a budget turns away what it has no room for.
#[derive(Clone)]
struct Refusal {
    kind: BufferKind,
    metrics: Arc<Metrics>,
}

/// What the buffers of a budget hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BufferKind {
    /// Bodies of requests, and the images in them.
    Bodies,
    /// Answers, until they are written to their connections.
    Answers,
}

/// A share of the budget, given back when dropped.
pub struct Reservation {
    permit: OwnedSemaphorePermit,
    refusal: Refusal,
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

impl MemoryBudget {
    /// A budget of `bytes`.
    pub fn new(kind: BufferKind, bytes: usize, metrics: Arc<Metrics>) -> Self {
        let blocks = bytes.div_ceil(BLOCK_BYTES).min(Semaphore::MAX_PERMITS);
        Self {
            blocks: Arc::new(Semaphore::new(blocks)),
            refusal: Refusal { kind, metrics },
        }
    }

    /// Reserves one block, 64 KiB.
    ///
    /// # Errors
    /// `overloaded` if nothing of the budget is left.
    pub fn reserve(&self) -> Result<Reservation, ApiError> {
        Ok(Reservation {
            permit: self.refusal.unless_taken(&self.blocks, 1)?,
            refusal: self.refusal.clone(),
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
            let blocks = self.permit.semaphore();
            let more = self.refusal.unless_taken(blocks, want - have)?;
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

impl Refusal {
    /// Takes so many blocks, or counts and returns the refusal.
    fn unless_taken(
        &self,
        blocks: &Arc<Semaphore>,
        count: usize,
    ) -> Result<OwnedSemaphorePermit, ApiError> {
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        let taken = blocks.clone().try_acquire_many_owned(count);
        taken.map_err(|_| self.error())
    }

    fn error(&self) -> ApiError {
        let (reason, detail) = match self.kind {
            BufferKind::Bodies => (
                Rejection::BodyMemory,
                "too many bytes of bodies are being received at once",
            ),
            BufferKind::Answers => (
                Rejection::AnswerMemory,
                "too many bytes of answers wait for their clients to take them",
            ),
        };
        self.metrics.rejected(reason);
        ApiError::new(ErrorCode::Overloaded, detail)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn budget(bytes: usize) -> MemoryBudget {
        MemoryBudget::new(BufferKind::Bodies, bytes, Arc::new(Metrics::new().unwrap()))
    }

    #[test]
    fn reserved_memory_is_given_back() {
        let budget = budget(128 << 10);
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
        let budget = budget(64 << 10);
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

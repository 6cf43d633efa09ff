//! Bytes to a descriptor: decoding beside, extraction behind the one compute worker.
//!
//! Blocking work cannot be stopped once it has begun, but whoever waits for it may leave at any
//! moment. So every permit, lock and ticket that bounds such work moves into it and is given back
//! when the work itself ends: clients that hang up and come again get no more threads than clients
//! that stay.

use super::admission::Ticket;
use super::blocking::{Panicked, blocking};
use super::{DescriptorSource, PipelineError, Timings};
use crate::ops::{Metrics, Stage};
use bytes::Bytes;
use placeformer_core::types::{Deadline, Descriptor, ImageTensor};
use placeformer_vision::image::ImageConfig;
use std::future::Future;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::{Mutex, OwnedMutexGuard, Semaphore};
use tokio::time::timeout;

/// What a descriptor is for.
#[derive(Debug, Clone, Copy)]
pub(super) enum Purpose {
    /// A query or a match, of no use after its deadline.
    Answer(Deadline),
    /// A reference to be stored; it lets queries go first.
    Ingest,
}

pub(super) struct Extraction {
    source: Arc<dyn DescriptorSource>,
    image: Arc<ImageConfig>,
    /// Decoders at work: one per core, so that a burst does not starve the model.
    decoders: Arc<Semaphore>,
    /// First come, first served; a waiter that is dropped leaves the line.
    worker: Arc<Mutex<()>>,
    /// Held by the one reference that stands in that line; the others wait here, so that a query
    /// never waits for more than one of them.
    ingest: Arc<Mutex<()>>,
    metrics: Arc<Metrics>,
}

/// The right to compute; given back when dropped.
struct Turn {
    _worker: OwnedMutexGuard<()>,
    _ingest: Option<OwnedMutexGuard<()>>,
}

impl Purpose {
    /// Fails once the deadline has passed, naming the stage that it kept from running.
    pub(super) fn not_passed(self, stage: &'static str) -> Result<(), PipelineError> {
        match self {
            Self::Answer(deadline) if deadline.has_passed() => {
                Err(PipelineError::DeadlineExceeded { stage })
            }
            _ => Ok(()),
        }
    }

    /// Waits for `work` until the deadline.
    ///
    /// Cancel safety: as `work`, which is dropped when the deadline passes.
    async fn in_time<T>(
        self,
        stage: &'static str,
        work: impl Future<Output = T>,
    ) -> Result<T, PipelineError> {
        match self {
            Self::Answer(deadline) => timeout(deadline.remaining(), work)
                .await
                .map_err(|_| PipelineError::DeadlineExceeded { stage }),
            Self::Ingest => Ok(work.await),
        }
    }
}

impl Extraction {
    pub(super) fn new(
        source: Arc<dyn DescriptorSource>,
        image: ImageConfig,
        metrics: Arc<Metrics>,
    ) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            source,
            image: Arc::new(image),
            decoders: Arc::new(Semaphore::new(cores)),
            worker: Arc::default(),
            ingest: Arc::default(),
            metrics,
        }
    }

    pub(super) fn source(&self) -> &Arc<dyn DescriptorSource> {
        &self.source
    }

    /// What the model sees in `bytes`. `ticket` is kept until the last work for it has ended.
    ///
    /// Cancel safety: dropped while waiting, nothing is computed; dropped later, what is being
    /// computed is finished under the bounds it began with, and its outcome is lost.
    pub(super) async fn describe(
        &self,
        bytes: Bytes,
        purpose: Purpose,
        ticket: &Arc<Ticket>,
        timings: &mut Timings,
    ) -> Result<Descriptor, PipelineError> {
        let tensor = self.decode(bytes, purpose, ticket, timings).await?;
        let waiting_since = Instant::now();
        let turn = purpose.in_time("extraction", self.turn(purpose)).await?;
        timings.record(&self.metrics, Stage::Queue, waiting_since.elapsed());
        purpose.not_passed("extraction")?;
        let (source, ticket, started) = (self.source.clone(), ticket.clone(), Instant::now());
        let described = blocking(move || {
            let described = source.describe(&[tensor]);
            drop((turn, ticket));
            described
        });
        let described = purpose.in_time("extraction", described).await?;
        timings.record(&self.metrics, Stage::Extract, started.elapsed());
        let mut descriptors = described.map_err(|_| PipelineError::Panicked {
            stage: "extraction",
        })??;
        descriptors.pop().ok_or(PipelineError::Panicked {
            stage: "extraction",
        })
    }

    async fn turn(&self, purpose: Purpose) -> Turn {
        let ingest = match purpose {
            Purpose::Ingest => Some(self.ingest.clone().lock_owned().await),
            Purpose::Answer(_) => None,
        };
        Turn {
            _worker: self.worker.clone().lock_owned().await,
            _ingest: ingest,
        }
    }

    async fn decode(
        &self,
        bytes: Bytes,
        purpose: Purpose,
        ticket: &Arc<Ticket>,
        timings: &mut Timings,
    ) -> Result<ImageTensor, PipelineError> {
        let (source, config) = (self.source.clone(), self.image.clone());
        let decoding = self.beside(ticket, move || {
            let started = Instant::now();
            (source.decode(&bytes, &config), started.elapsed())
        });
        let decoded = purpose.in_time("decoding", decoding).await??;
        let (decoded, took) = decoded.map_err(|_| PipelineError::DecoderPanicked)?;
        timings.record(&self.metrics, Stage::Decode, took);
        Ok(decoded?)
    }

    /// Runs `work` on the bytes of an image, beside the model, on no more threads than there are
    /// cores.
    ///
    /// Cancel safety: dropped before the work began, it never begins; dropped later, it holds its
    /// place and `ticket` until it ends.
    pub(super) async fn beside<T: Send + 'static>(
        &self,
        ticket: &Arc<Ticket>,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<Result<T, Panicked>, PipelineError> {
        // The semaphore is never closed.
        let place = self
            .decoders
            .clone()
            .acquire_owned()
            .await
            .map_err(|_| PipelineError::ShuttingDown)?;
        let ticket = ticket.clone();
        Ok(blocking(move || {
            let done = work();
            drop((place, ticket));
            done
        })
        .await)
    }
}

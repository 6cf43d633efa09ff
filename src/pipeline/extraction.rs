//! From the bytes of an image to its descriptor: decoding on a few threads, extraction on one
//! compute worker. Between the two it is seen whether the image shows anything at all.
//!
//! Blocking work cannot be stopped once it has begun, but the request that waits for it may go away
//! at any moment. So every permit, lock and ticket that bounds such work moves into it and is given
//! back when the work itself ends: clients that hang up and come again get no more threads than
//! clients that stay.
//!
//! Between the blocks of the transformer the worker is lent to a caller that asks seldom
//! ([`super::fair`]). So such a caller does not even wait for the extraction that is under way.

use super::admission::Ticket;
use super::blocking::{Panicked, blocking};
use super::caller::Caller;
use super::fair::{FairPermit, FairSemaphore};
use super::{DescriptorSource, PipelineError, Timings};
use crate::ops::metrics::ImageUse;
use crate::ops::{Metrics, PipelineStage};
use bytes::Bytes;
use placeformer_core::types::{Deadline, Descriptor, ImageTensor};
use placeformer_vision::image::{Detail, ImageConfig, Uninformative};
use std::cell::Cell;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::time::timeout;

/// What errors call the computation of a descriptor.
const EXTRACTION: &str = "extraction";

/// What a descriptor is for.
#[derive(Debug, Clone, Copy)]
pub(super) enum Purpose {
    /// A query or a match, of no use after its deadline.
    Answer(Deadline),
    /// A reference to be stored; it lets queries go first.
    Ingest {
        /// Whether it is stored although it shows nothing by which a place could be known.
        allow_uninformative: bool,
    },
}

/// A descriptor with what is known about its image.
#[derive(Debug)]
pub(super) struct Described {
    pub(super) descriptor: Descriptor,
    /// What the image lacks, if it shows nothing by which a place could be known.
    pub(super) lacks: Option<Uninformative>,
}

/// The model behind its bounds.
pub(super) struct Extraction {
    source: Arc<dyn DescriptorSource>,
    image: Arc<ImageConfig>,
    /// Decoders at work: one per core, so that a burst of images does not starve the model.
    decoders: FairSemaphore,
    /// The one compute worker.
    worker: FairSemaphore,
    /// Held by the one reference that waits for the worker, behind the queries; the others wait
    /// for this, so that a query never waits for more than one of them.
    ingest: FairSemaphore,
    metrics: Arc<Metrics>,
}

/// The right to use the compute worker; given back when dropped.
struct WorkerPermit {
    worker: FairPermit,
    _ingest: Option<FairPermit>,
}

/// What the compute worker made of an image.
struct Extracted {
    descriptor: Result<Descriptor, PipelineError>,
    /// Time in which it was computed.
    computed: Duration,
    /// Time for which the worker was lent to others.
    lent: Duration,
}

impl Purpose {
    /// Fails once the deadline has passed, naming the stage that it kept from running.
    pub(super) fn check_deadline(self, stage: &'static str) -> Result<(), PipelineError> {
        match self {
            Self::Answer(deadline) if deadline.has_passed() => {
                Err(PipelineError::DeadlineExceeded { stage })
            }
            _ => Ok(()),
        }
    }

    /// Waits for `work` until the deadline.
    ///
    /// Cancel safety: that of `work`, which is dropped when the deadline passes.
    async fn within_deadline<T>(
        self,
        stage: &'static str,
        work: impl Future<Output = T>,
    ) -> Result<T, PipelineError> {
        match self {
            Self::Answer(deadline) => timeout(deadline.remaining(), work)
                .await
                .map_err(|_| PipelineError::DeadlineExceeded { stage }),
            Self::Ingest { .. } => Ok(work.await),
        }
    }

    fn image_use(self) -> ImageUse {
        match self {
            Self::Answer(_) => ImageUse::Query,
            Self::Ingest { .. } => ImageUse::Reference,
        }
    }

    /// Refuses a reference that shows no place, before anything is computed for it.
    fn check_information(self, lacks: Option<Uninformative>) -> Result<(), PipelineError> {
        match (self, lacks) {
            (
                Self::Ingest {
                    allow_uninformative: false,
                },
                Some(lacks),
            ) => Err(PipelineError::Uninformative(lacks)),
            _ => Ok(()),
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
            decoders: FairSemaphore::new(cores),
            worker: FairSemaphore::new(1),
            ingest: FairSemaphore::new(1),
            metrics,
        }
    }

    pub(super) fn source(&self) -> &Arc<dyn DescriptorSource> {
        &self.source
    }

    /// The descriptor of the image in `bytes`. `ticket` is kept until the last work for it ends.
    ///
    /// Cancel safety: dropped while waiting, nothing is computed; dropped later, what is being
    /// computed is finished under the bounds it began with, and its outcome is lost.
    pub(super) async fn describe(
        &self,
        bytes: Bytes,
        purpose: Purpose,
        ticket: &Arc<Ticket>,
        timings: &mut Timings,
    ) -> Result<Described, PipelineError> {
        let (tensor, lacks) = self.decode(bytes, purpose, ticket, timings).await?;
        if lacks.is_some() {
            self.metrics.uninformative_image(purpose.image_use());
        }
        purpose.check_information(lacks)?;

        let waiting_since = Instant::now();
        let permit = self.worker_permit(purpose, ticket.caller());
        let permit = purpose.within_deadline(EXTRACTION, permit).await?;
        let waited = waiting_since.elapsed();
        let in_time = purpose.check_deadline(EXTRACTION);
        let extracted = match in_time {
            Ok(()) => {
                let extracting = self.extract(tensor, permit, ticket.clone());
                purpose.within_deadline(EXTRACTION, extracting).await
            }
            Err(late) => Err(late),
        };
        let lent = extracted
            .as_ref()
            .map_or(Duration::ZERO, |extracted| extracted.lent);
        timings.record(&self.metrics, PipelineStage::Queue, waited + lent);
        let extracted = extracted?;
        timings.record(&self.metrics, PipelineStage::Extract, extracted.computed);
        Ok(Described {
            descriptor: extracted.descriptor?,
            lacks,
        })
    }

    /// Bytes to the tensor that the model sees, and what the image lacks.
    async fn decode(
        &self,
        bytes: Bytes,
        purpose: Purpose,
        ticket: &Arc<Ticket>,
        timings: &mut Timings,
    ) -> Result<(ImageTensor, Option<Uninformative>), PipelineError> {
        let source = self.source.clone();
        let config = self.image.clone();
        let decoding = self.on_decoder_thread(ticket, move || {
            let started = Instant::now();
            let decoded = source.decode(&bytes, &config).map(|tensor| {
                let lacks = Detail::of(&tensor).lacks();
                (tensor, lacks)
            });
            (decoded, started.elapsed())
        });
        let decoded = purpose.within_deadline("decoding", decoding).await?;
        let (decoded, took) = decoded.map_err(|_| PipelineError::DecoderPanicked)?;
        timings.record(&self.metrics, PipelineStage::Decode, took);
        Ok(decoded?)
    }

    /// Waits for the compute worker; at most one reference waits for it among the queries.
    async fn worker_permit(&self, purpose: Purpose, caller: &Caller) -> WorkerPermit {
        match purpose {
            Purpose::Ingest { .. } => {
                let ingest = self.ingest.acquire(caller).await;
                WorkerPermit {
                    worker: self.worker.acquire_behind().await,
                    _ingest: Some(ingest),
                }
            }
            Purpose::Answer(_) => WorkerPermit {
                worker: self.worker.acquire(caller).await,
                _ingest: None,
            },
        }
    }

    /// Tensor to descriptor, on the compute worker, which is lent in between.
    async fn extract(
        &self,
        tensor: ImageTensor,
        permit: WorkerPermit,
        ticket: Arc<Ticket>,
    ) -> Extracted {
        let source = self.source.clone();
        let extracting = blocking(move || {
            let started = Instant::now();
            let lent = Cell::new(Duration::ZERO);
            let pause = || lent.set(lent.get() + permit.worker.lend());
            let described = source.describe_with_pauses(&[tensor], &pause);
            drop((permit, ticket));
            (described, started.elapsed(), lent.get())
        });
        let panicked = || PipelineError::Panicked { stage: EXTRACTION };
        let Ok((described, took, lent)) = extracting.await else {
            return Extracted {
                descriptor: Err(panicked()),
                computed: Duration::ZERO,
                lent: Duration::ZERO,
            };
        };
        let descriptor = match described {
            Ok(mut descriptors) => descriptors.pop().ok_or_else(panicked),
            Err(error) => Err(error.into()),
        };
        Extracted {
            descriptor,
            computed: took - lent,
            lent,
        }
    }

    /// Runs `work` on the bytes of an image, on no more threads at once than there are cores.
    ///
    /// Cancel safety: dropped before the work began, it never begins; dropped later, the work keeps
    /// its thread and `ticket` until it ends.
    pub(super) async fn on_decoder_thread<T: Send + 'static>(
        &self,
        ticket: &Arc<Ticket>,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Panicked> {
        let permit = self.decoders.acquire(ticket.caller()).await;
        let ticket = ticket.clone();
        let outcome = blocking(move || {
            let outcome = work();
            drop((permit, ticket));
            outcome
        });
        outcome.await
    }
}

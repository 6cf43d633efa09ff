//! Bytes to a descriptor: decoding beside, extraction behind the one compute worker.

use super::blocking::blocking;
use super::{DescriptorSource, PipelineError, Timings};
use crate::image::{self, ImageConfig};
use crate::ops::{Metrics, Stage};
use crate::types::{Deadline, Descriptor, ImageTensor};
use bytes::Bytes;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::{Mutex, Semaphore};

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
    decoders: Semaphore,
    /// First come, first served; a waiter that is dropped leaves the line.
    worker: Mutex<()>,
    /// Held by the one reference that stands in that line; the others wait here, so that a query never waits for more
    /// than one of them.
    ingest: Mutex<()>,
    metrics: Arc<Metrics>,
}

impl Extraction {
    pub(super) fn new(source: Arc<dyn DescriptorSource>, image: ImageConfig, metrics: Arc<Metrics>) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            source,
            image: Arc::new(image),
            decoders: Semaphore::new(cores),
            worker: Mutex::new(()),
            ingest: Mutex::new(()),
            metrics,
        }
    }

    pub(super) fn source(&self) -> &Arc<dyn DescriptorSource> {
        &self.source
    }

    /// What the model sees in `bytes`.
    ///
    /// Cancel safety: dropped while waiting, nothing is computed.
    pub(super) async fn describe(
        &self,
        bytes: Bytes,
        purpose: Purpose,
        timings: &mut Timings,
    ) -> Result<Descriptor, PipelineError> {
        let tensor = self.decode(bytes, timings).await?;
        let waiting_since = Instant::now();
        let turn_of_ingest = match purpose {
            Purpose::Ingest => Some(self.ingest.lock().await),
            Purpose::Answer(_) => None,
        };
        let turn = self.worker.lock().await;
        timings.record(&self.metrics, Stage::Queue, waiting_since.elapsed());
        if let Purpose::Answer(deadline) = purpose {
            not_passed(deadline, "extraction")?;
        }
        let (source, started) = (self.source.clone(), Instant::now());
        let described = blocking(move || source.describe(&[tensor])).await;
        drop((turn, turn_of_ingest));
        timings.record(&self.metrics, Stage::Extract, started.elapsed());
        let mut descriptors = described.map_err(|_| PipelineError::Panicked { stage: "extraction" })??;
        descriptors.pop().ok_or(PipelineError::Panicked { stage: "extraction" })
    }

    async fn decode(&self, bytes: Bytes, timings: &mut Timings) -> Result<ImageTensor, PipelineError> {
        // The semaphore is never closed.
        let _decoder = self.decoders.acquire().await.map_err(|_| PipelineError::ShuttingDown)?;
        let (config, size, started) = (self.image.clone(), self.source.input_size(), Instant::now());
        let decoded = blocking(move || image::load_tensor(&bytes, &config, size)).await;
        timings.record(&self.metrics, Stage::Decode, started.elapsed());
        Ok(decoded.map_err(|_| PipelineError::DecoderPanicked)??)
    }
}

/// Fails once `deadline` has passed, naming the stage that it kept from running.
pub(super) fn not_passed(deadline: Deadline, stage: &'static str) -> Result<(), PipelineError> {
    if deadline.has_passed() { Err(PipelineError::DeadlineExceeded { stage }) } else { Ok(()) }
}

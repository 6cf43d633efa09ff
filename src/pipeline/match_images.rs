//! Two images, or an image and a reference, matched with the correspondences as evidence.

use super::admission::Ticket;
use super::blocking::blocking;
use super::extraction::Purpose;
use super::{Caller, PipelineError, Service, Timings};
use crate::ops::PipelineStage;
use bytes::Bytes;
use placeformer_core::types::{Deadline, ImageSize, ModelId, PackedPatches, ReferenceId};
use placeformer_vision::rerank::CombinationMatch;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What an image is matched against.
#[derive(Debug, Clone)]
pub enum MatchTarget {
    /// An image, as it was sent.
    Image(Bytes),
    /// A stored reference.
    Reference(ReferenceId),
}

/// Everything about one pair.
#[derive(Debug, Clone)]
pub struct MatchedPair {
    /// Key patches of the query.
    pub query: Arc<PackedPatches>,
    /// Key patches of the reference.
    pub reference: Arc<PackedPatches>,
    /// One entry per configured scale combination.
    pub combinations: Vec<CombinationMatch>,
}

/// A matched pair with how it came about.
#[derive(Debug, Clone)]
pub struct MatchAnswer {
    /// The pair.
    pub matched: MatchedPair,
    /// The size in pixels that positions refer to.
    pub input_size: ImageSize,
    /// Where the time went.
    pub timings: Timings,
    /// What computed it.
    pub model: ModelId,
}

/// What an image is matched against, with a reference's key patches looked up.
enum LoadedTarget {
    Image(Bytes),
    Patches(Arc<PackedPatches>),
}

impl Service {
    /// Matches an image against another one or against a reference.
    ///
    /// Cancel safety: dropped while waiting, nothing further is computed; what is being computed is
    /// finished in its place in the queue.
    ///
    /// # Errors
    /// An image is refused, there is no such reference, its map has another model, the queue is
    /// full, or the time is up.
    pub async fn match_images(
        self: &Arc<Self>,
        caller: &Caller,
        query: Bytes,
        target: MatchTarget,
    ) -> Result<MatchAnswer, PipelineError> {
        let outcome = self.match_in_time(caller, query, target).await;
        self.count_if_late(&outcome);
        outcome
    }

    async fn match_in_time(
        self: &Arc<Self>,
        caller: &Caller,
        query: Bytes,
        target: MatchTarget,
    ) -> Result<MatchAnswer, PipelineError> {
        let time = Duration::from_millis(self.config.deadline_ms);
        let purpose = Purpose::Answer(Deadline::after(time));
        // The store is read before a place in the queue is taken, which others wait for.
        let target = match target {
            MatchTarget::Reference(id) => {
                LoadedTarget::Patches(self.stored_patches(caller, id).await?)
            }
            MatchTarget::Image(bytes) => LoadedTarget::Image(bytes),
        };
        let ticket = Arc::new(self.queries.admit(caller, self.max_wait())?);

        let mut timings = Timings::default();
        let query = self
            .key_patches(query, purpose, &ticket, &mut timings)
            .await?;
        let reference = match target {
            LoadedTarget::Patches(patches) => patches,
            LoadedTarget::Image(bytes) => {
                self.key_patches(bytes, purpose, &ticket, &mut timings)
                    .await?
            }
        };

        let started = Instant::now();
        let matched = self.match_patches(query, reference, ticket).await;
        timings.record(&self.metrics, PipelineStage::Rerank, started.elapsed());
        let source = self.extraction.source();
        Ok(MatchAnswer {
            matched: matched?,
            input_size: source.input_size(),
            timings,
            model: source.model_id().clone(),
        })
    }

    /// The key patches of an image as it was sent.
    async fn key_patches(
        &self,
        image: Bytes,
        purpose: Purpose,
        ticket: &Arc<Ticket>,
        timings: &mut Timings,
    ) -> Result<Arc<PackedPatches>, PipelineError> {
        let describing = self.extraction.describe(image, purpose, ticket, timings);
        Ok(Arc::new(describing.await?.descriptor.patches))
    }

    /// The key patches of a reference, if they can be compared with this server's.
    async fn stored_patches(
        self: &Arc<Self>,
        caller: &Caller,
        id: ReferenceId,
    ) -> Result<Arc<PackedPatches>, PipelineError> {
        let map = self.reference(caller, id).await?.map;
        self.run_limited(&self.store_reads, caller, move |service| {
            let (_, live) = service.existing(&map)?;
            live.check_model(&map, service.extraction.source().model_id())?;
            Ok(service.patches.load(&*service.store, id)?)
        })
        .await
    }

    /// Mutual nearest neighbours and homographies of two sets of key patches (paper III-D, III-E).
    async fn match_patches(
        self: &Arc<Self>,
        query: Arc<PackedPatches>,
        reference: Arc<PackedPatches>,
        ticket: Arc<Ticket>,
    ) -> Result<MatchedPair, PipelineError> {
        let service = self.clone();
        let matched = blocking(move || {
            let combinations = service.reranker.explain(&query, &reference);
            drop(ticket);
            MatchedPair {
                query,
                reference,
                combinations,
            }
        });
        let panicked = |_| PipelineError::Panicked { stage: "matching" };
        matched.await.map_err(panicked)
    }
}

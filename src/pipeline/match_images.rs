//! Two images, or an image and a reference, matched with the evidence kept.

use super::blocking::blocking;
use super::extraction::Purpose;
use super::{PipelineError, Service, Timings};
use crate::ops::Stage;
use bytes::Bytes;
use placeformer_core::types::{Deadline, ImageSize, MapName, ModelId, PackedPatches, ReferenceId};
use placeformer_vision::rerank::CombinationMatch;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The second side of a match.
#[derive(Debug, Clone)]
pub enum MatchSide {
    /// An image, as it was sent.
    Image(Bytes),
    /// A stored reference.
    Reference(ReferenceId),
}

/// The second side, looked up before a place in the queue is taken.
enum Side {
    Image(Bytes),
    Patches(Arc<PackedPatches>),
}

/// Everything about one pair.
#[derive(Debug, Clone)]
pub struct Matched {
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
    pub matched: Matched,
    /// The size that pixel positions refer to.
    pub input_size: ImageSize,
    /// Where the time went.
    pub timings: Timings,
    /// What computed it.
    pub model: ModelId,
}

impl Service {
    /// Matches an image against another one or against a reference.
    ///
    /// Cancel safety: dropped while waiting, nothing further is computed; what is being computed is
    /// finished in its place in the queue.
    pub async fn match_images(
        self: &Arc<Self>,
        query: Bytes,
        other: MatchSide,
    ) -> Result<MatchAnswer, PipelineError> {
        let outcome = self.matched(query, other).await;
        self.count_if_late(&outcome);
        outcome
    }

    async fn matched(
        self: &Arc<Self>,
        query: Bytes,
        other: MatchSide,
    ) -> Result<MatchAnswer, PipelineError> {
        let purpose = Purpose::Answer(Deadline::after(Duration::from_millis(
            self.config.deadline_ms,
        )));
        let other = match other {
            MatchSide::Reference(id) => Side::Patches(self.stored_patches(id).await?),
            MatchSide::Image(bytes) => Side::Image(bytes),
        };
        let ticket = Arc::new(self.queries.enter(self.patience())?);
        let mut timings = Timings::default();
        let query = Arc::new(
            self.extraction
                .describe(query, purpose, &ticket, &mut timings)
                .await?
                .patches,
        );
        let reference = match other {
            Side::Patches(patches) => patches,
            Side::Image(bytes) => Arc::new(
                self.extraction
                    .describe(bytes, purpose, &ticket, &mut timings)
                    .await?
                    .patches,
            ),
        };
        let (service, started) = (self.clone(), Instant::now());
        let explained = blocking(move || {
            let combinations = service.reranker.explain(&query, &reference);
            drop(ticket);
            Matched {
                query,
                reference,
                combinations,
            }
        })
        .await;
        timings.record(&self.metrics, Stage::Rerank, started.elapsed());
        let source = self.extraction.source();
        Ok(MatchAnswer {
            matched: explained.map_err(|_| PipelineError::Panicked { stage: "matching" })?,
            input_size: source.input_size(),
            timings,
            model: source.model_id().clone(),
        })
    }

    async fn stored_patches(
        self: &Arc<Self>,
        id: ReferenceId,
    ) -> Result<Arc<PackedPatches>, PipelineError> {
        let reference = self.reference(id).await?;
        let map: MapName = reference.map;
        self.in_turn(&self.store_reads, move |service| {
            let (_, live) = service.existing(&map)?;
            live.check_model(&map, service.extraction.source().model_id())?;
            Ok(service.patches.load(&*service.store, id)?)
        })
        .await
    }
}

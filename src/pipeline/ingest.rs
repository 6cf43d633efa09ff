//! Image and metadata to a durable, searchable reference.

use super::admission::Ticket;
use super::blocking::blocking;
use super::extraction::Purpose;
use super::{PipelineError, Service, Timings};
use crate::ops::Stage;
use crate::ops::metrics::Rejection;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    ContentHash, InvalidValue, MapName, NewReference, Reference, ReferenceFields,
};
use placeformer_store::Inserted;
use placeformer_vision::search::IndexEntry;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A reference to be taken in.
#[derive(Debug, Clone)]
pub struct IngestRequest {
    /// Its map; created on first use.
    pub map: MapName,
    /// What the map builder says about it.
    pub fields: ReferenceFields,
    /// The photo, as it was sent.
    pub image: Bytes,
}

/// A reference that is durable and can be found.
#[derive(Debug, Clone)]
pub struct IngestAnswer {
    /// The reference.
    pub reference: Reference,
    /// False if the same external id with the same content was there before.
    pub created: bool,
    /// Where the time went.
    pub timings: Timings,
}

impl Service {
    /// Takes in one reference; returns once it is fsynced and in the index.
    ///
    /// Cancel safety: dropped before the commit began, nothing is stored; dropped later, the
    /// reference is stored and indexed all the same, and repeating the request with its external id
    /// finds it.
    pub async fn ingest(
        self: &Arc<Self>,
        request: IngestRequest,
    ) -> Result<IngestAnswer, PipelineError> {
        self.may_store()?;
        self.check_metadata(&request.fields)?;
        let model = self.extraction.source().model_id().clone();
        if let Some(live) = self.maps.live(&request.map) {
            live.check_model(&request.map, &model)?;
        }
        let ticket = Arc::new(self.references.enter(Duration::MAX)?);
        let content_hash = self.hash(request.image.clone(), &ticket).await?;
        if let Some(reference) = self.known(&request, content_hash).await? {
            return Ok(IngestAnswer {
                reference,
                created: false,
                timings: Timings::default(),
            });
        }
        let mut timings = Timings::default();
        let descriptor = self
            .extraction
            .describe(request.image, Purpose::Ingest, &ticket, &mut timings)
            .await?;
        let new = NewReference {
            map: request.map,
            fields: request.fields,
            content_hash,
            model,
            descriptor,
        };
        let (service, started) = (self.clone(), Instant::now());
        let committed = blocking(move || {
            let committed = service.commit(new);
            drop(ticket);
            committed
        })
        .await;
        timings.record(&self.metrics, Stage::Commit, started.elapsed());
        let inserted = committed.map_err(|_| PipelineError::Panicked { stage: "the store" })??;
        let (reference, created) = match inserted {
            Inserted::Created(reference) => (reference, true),
            Inserted::AlreadyThere(reference) => (reference, false),
        };
        Ok(IngestAnswer {
            reference,
            created,
            timings,
        })
    }

    /// Refuses while disk or memory is short. Deleting is never refused.
    pub fn may_store(&self) -> Result<(), PipelineError> {
        if self.health.is_disk_full() {
            self.metrics.rejected(Rejection::DiskFull);
            return Err(PipelineError::DiskFull);
        }
        self.memory
            .check()
            .inspect_err(|_| self.metrics.rejected(Rejection::MemoryPressure))?;
        Ok(())
    }

    /// Bounds the metadata of a reference.
    pub(super) fn check_metadata(&self, fields: &ReferenceFields) -> Result<(), PipelineError> {
        let Some(metadata) = &fields.metadata else {
            return Ok(());
        };
        let length = serde_json::to_vec(metadata).map_or(usize::MAX, |text| text.len());
        let bound = self.config.max_metadata_bytes;
        if length > bound {
            let reason = format!("{length} bytes of JSON are more than the {bound} allowed");
            return Err(InvalidValue::new("metadata", reason).into());
        }
        Ok(())
    }

    async fn hash(&self, image: Bytes, ticket: &Arc<Ticket>) -> Result<ContentHash, PipelineError> {
        let hashed = self
            .extraction
            .beside(ticket, move || ContentHash::of(&image))
            .await?;
        hashed.map_err(|_| PipelineError::Panicked { stage: "hashing" })
    }

    /// The reference that this request repeats, found before anything costly; a conflict if it is
    /// another image.
    async fn known(
        self: &Arc<Self>,
        request: &IngestRequest,
        content_hash: ContentHash,
    ) -> Result<Option<Reference>, PipelineError> {
        let Some(external_id) = request.fields.external_id.clone() else {
            return Ok(None);
        };
        match self
            .find_external(request.map.clone(), external_id.clone())
            .await
        {
            Ok(Some(reference)) if reference.content_hash == content_hash => Ok(Some(reference)),
            Ok(Some(_)) => Err(PipelineError::ExternalIdConflict {
                map: request.map.clone(),
                external_id,
            }),
            Ok(None) => Ok(None),
            // The map is made by this very request; or the record is damaged, and this image may
            // replace it.
            Err(error)
                if matches!(
                    error.code(),
                    ErrorCode::MapNotFound | ErrorCode::CorruptRecord
                ) =>
            {
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    fn commit(&self, mut new: NewReference) -> Result<Inserted, PipelineError> {
        let entry = self.maps.entry(&new.map);
        let _inserting = entry.inserting();
        // The map may have been given another head since the request was let in.
        if let Some(live) = entry.live() {
            live.check_model(&new.map, &new.model)?;
            new.descriptor.global = live.global_of(&new.descriptor).into_owned();
            new.model = live.model.clone();
        }
        let model = new.model.clone();
        let (global, patch_bytes) = (
            new.descriptor.global.clone(),
            new.descriptor.patches.heap_bytes(),
        );
        let inserted = self.store.insert(new).inspect_err(|error| {
            if error.code() == ErrorCode::DiskFull {
                self.health.set_disk_full(true);
                self.metrics.rejected(Rejection::DiskFull);
            }
        });
        // A damaged reference that this one replaces leaves the index before anyone may miss it in
        // the store.
        self.follow_damage();
        let inserted = inserted?;
        if let Inserted::Created(reference) = &inserted {
            self.metrics
                .stored_descriptor(global.len() * size_of::<f32>(), patch_bytes);
            entry.live_or_create(&model).index.insert(IndexEntry {
                id: reference.id,
                global,
                location: reference.fields.location,
                captured_at: reference.fields.captured_at,
            });
        }
        Ok(inserted)
    }
}

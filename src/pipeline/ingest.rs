//! From an image and its metadata to a durable, searchable reference.

use super::admission::Ticket;
use super::blocking::blocking;
use super::extraction::Purpose;
use super::{Caller, PipelineError, Service, Timings};
use crate::ops::PipelineStage;
use crate::ops::metrics::Rejection;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{ContentHash, MapName, NewReference, Reference, ReferenceFields};
use placeformer_store::Inserted;
use placeformer_vision::image::{ExifInfo, MetadataBlock, read_exif};
use placeformer_vision::search::IndexEntry;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A reference to be stored.
#[derive(Debug, Clone)]
pub struct IngestRequest {
    /// Its map; created on first use.
    pub map: MapName,
    /// What the map builder says about it.
    pub fields: ReferenceFields,
    /// The photo, as it was sent.
    pub image: Bytes,
    /// Whether position, height, heading and time are taken from the photo's EXIF and XMP where
    /// `fields` has none.
    pub reads_photo: bool,
    /// Whether it is stored although it shows nothing by which a place could be known.
    pub allow_uninformative: bool,
}

/// Where a field of a reference comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldSource {
    /// The map builder said it with this request.
    Request,
    /// The photo's EXIF.
    Exif,
    /// The photo's XMP.
    Xmp,
    /// The reference was there before, and the field as it is.
    Stored,
}

/// Where the fields of a reference come from; `None` where it has no value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FieldSources {
    /// The location.
    pub location: Option<FieldSource>,
    /// The height.
    pub alt: Option<FieldSource>,
    /// The heading.
    pub heading: Option<FieldSource>,
    /// The time.
    pub captured_at: Option<FieldSource>,
}

impl FieldSources {
    /// The sources of a reference that was there before.
    fn stored(fields: &ReferenceFields) -> Self {
        Self {
            location: fields.location.map(|_| FieldSource::Stored),
            alt: fields.alt.map(|_| FieldSource::Stored),
            heading: fields.heading.map(|_| FieldSource::Stored),
            captured_at: fields.captured_at.map(|_| FieldSource::Stored),
        }
    }

    /// Fills the gaps of what a request says with what the photo says.
    fn complete(fields: &mut ReferenceFields, photo: &ExifInfo) -> Self {
        let sources = photo.sources;
        Self {
            location: fill(&mut fields.location, photo.location, sources.location),
            alt: fill(&mut fields.alt, photo.alt, sources.alt),
            heading: fill(&mut fields.heading, photo.heading, sources.heading),
            captured_at: fill(
                &mut fields.captured_at,
                photo.captured_at,
                sources.captured_at,
            ),
        }
    }
}

/// Takes `photo` where `field` has no value; says where the value comes from.
fn fill<T>(
    field: &mut Option<T>,
    photo: Option<T>,
    block: Option<MetadataBlock>,
) -> Option<FieldSource> {
    if field.is_some() {
        return Some(FieldSource::Request);
    }
    *field = photo;
    block.map(|block| match block {
        MetadataBlock::Exif => FieldSource::Exif,
        MetadataBlock::Xmp => FieldSource::Xmp,
    })
}

/// A reference that is durable and can be found.
#[derive(Debug, Clone)]
pub struct IngestAnswer {
    /// The reference.
    pub reference: Reference,
    /// False if the same external id with the same content was there before.
    pub created: bool,
    /// Where its fields come from.
    pub sources: FieldSources,
    /// Where the time went.
    pub timings: Timings,
}

impl Service {
    /// Stores one reference; returns once it is fsynced and in the index.
    ///
    /// Cancel safety: dropped before the commit began, nothing is stored; dropped later, the
    /// reference is stored and indexed all the same, and repeating the request with its external id
    /// finds it.
    ///
    /// # Errors
    /// Disk, memory or queue are full; the image, the metadata or the map's model do not fit; the
    /// image shows nothing by which a place could be known, unless that is allowed; the external id
    /// names another image; the store fails.
    pub async fn ingest(
        self: &Arc<Self>,
        caller: &Caller,
        request: IngestRequest,
    ) -> Result<IngestAnswer, PipelineError> {
        self.may_store()?;
        self.check_metadata(request.fields.metadata.as_ref())?;
        let model = self.extraction.source().model_id().clone();
        if let Some(live) = self.maps.live(&request.map) {
            live.check_model(&request.map, &model)?;
        }
        let ticket = Arc::new(self.references.admit(caller, Duration::MAX)?);

        let (content_hash, photo) = self.look_at(&request, &ticket).await?;
        if let Some(reference) = self.already_stored(caller, &request, content_hash).await? {
            let sources = FieldSources::stored(&reference.fields);
            return Ok(IngestAnswer {
                reference,
                created: false,
                sources,
                timings: Timings::default(),
            });
        }
        let mut fields = request.fields;
        let sources = FieldSources::complete(&mut fields, &photo);

        let mut timings = Timings::default();
        let purpose = Purpose::Ingest {
            allow_uninformative: request.allow_uninformative,
        };
        let described = self
            .extraction
            .describe(request.image, purpose, &ticket, &mut timings)
            .await?;
        let new = NewReference {
            map: request.map,
            fields,
            content_hash,
            model,
            descriptor: described.descriptor,
        };
        let started = Instant::now();
        let committed = self.commit(new, ticket).await;
        timings.record(&self.metrics, PipelineStage::Commit, started.elapsed());
        let (reference, created, sources) = match committed? {
            Inserted::Created(reference) => (reference, true, sources),
            Inserted::AlreadyThere(reference) => {
                let sources = FieldSources::stored(&reference.fields);
                (reference, false, sources)
            }
        };
        Ok(IngestAnswer {
            reference,
            created,
            sources,
            timings,
        })
    }

    /// The hash of the photo, and what it says about itself, if that is asked for. Both are a walk
    /// over its bytes.
    async fn look_at(
        &self,
        request: &IngestRequest,
        ticket: &Arc<Ticket>,
    ) -> Result<(ContentHash, ExifInfo), PipelineError> {
        let image = request.image.clone();
        let reads_photo = request.reads_photo;
        let work = move || {
            let photo = if reads_photo {
                read_exif(&image)
            } else {
                ExifInfo::default()
            };
            (ContentHash::of(&image), photo)
        };
        let seen = self.extraction.on_decoder_thread(ticket, work).await;
        seen.map_err(|_| PipelineError::Panicked { stage: "hashing" })
    }

    /// The reference that this request repeats, found before anything costly is done. None if there
    /// is none, or if it is not searchable yet.
    ///
    /// # Errors
    /// The external id names another image, or the store fails.
    async fn already_stored(
        self: &Arc<Self>,
        caller: &Caller,
        request: &IngestRequest,
        content_hash: ContentHash,
    ) -> Result<Option<Reference>, PipelineError> {
        let Some(external_id) = request.fields.external_id.clone() else {
            return Ok(None);
        };
        let map = request.map.clone();
        let finding = self.find_external(caller, map.clone(), external_id.clone());
        match finding.await {
            Ok(Some(reference)) if reference.content_hash == content_hash => {
                // One whose commit could not be acknowledged is stored, but not in the index: it is
                // described again, and indexed.
                let live = self.maps.live(&request.map);
                let is_indexed = live.is_some_and(|live| live.index.global(reference.id).is_some());
                Ok(is_indexed.then_some(reference))
            }
            Ok(Some(_)) => Err(PipelineError::ExternalIdConflict { map, external_id }),
            Ok(None) => Ok(None),
            Err(error) => match error.code() {
                // The map does not exist yet: this request creates it.
                ErrorCode::MapNotFound => Ok(None),
                // The stored record is damaged: this image may replace it.
                ErrorCode::CorruptRecord => Ok(None),
                _ => Err(error),
            },
        }
    }

    /// Writes the reference to the store and to the index on a blocking thread.
    async fn commit(
        self: &Arc<Self>,
        new: NewReference,
        ticket: Arc<Ticket>,
    ) -> Result<Inserted, PipelineError> {
        let service = self.clone();
        let committed = blocking(move || {
            let committed = service.commit_now(new);
            service.note_lost_storage(&committed);
            drop(ticket);
            committed
        });
        let panicked = |_| PipelineError::Panicked { stage: "the store" };
        committed.await.map_err(panicked)?
    }

    fn commit_now(&self, mut new: NewReference) -> Result<Inserted, PipelineError> {
        let entry = self.maps.entry(&new.map);
        let _inserting = entry.lock_for_insert();
        // The map may have been given another head since the request was admitted.
        if let Some(live) = entry.live() {
            live.check_model(&new.map, &new.model)?;
            new.descriptor.global = live.global_of(&new.descriptor).into_owned();
            new.model = live.model.clone();
        }
        let model = new.model.clone();
        let global = new.descriptor.global.clone();
        let patch_bytes = new.descriptor.patches.heap_bytes();

        let inserted = self.store.insert(new).inspect_err(|error| {
            if error.code() == ErrorCode::DiskFull {
                self.health.set_disk_full(true);
                self.metrics.rejected(Rejection::DiskFull);
            }
        });
        // If the new reference replaces a damaged one, that one leaves the index before the map's
        // entry is unlocked. A query that found it in the index but not in the store would report
        // it as lost.
        self.follow_damage();
        let inserted = inserted?;

        if let Inserted::Created(_) = &inserted {
            let global_bytes = global.len() * size_of::<f32>();
            self.metrics.stored_descriptor(global_bytes, patch_bytes);
        }
        let (Inserted::Created(reference) | Inserted::AlreadyThere(reference)) = &inserted;
        let live = entry.live_or_create(&model);
        // One that was there may be missing from the index, if its commit was not acknowledged.
        if live.index.global(reference.id).is_none() {
            live.index.insert(IndexEntry {
                id: reference.id,
                global,
                location: reference.fields.location,
                alt: reference.fields.alt,
                heading: reference.fields.heading,
                captured_at: reference.fields.captured_at,
            });
        }
        Ok(inserted)
    }
}

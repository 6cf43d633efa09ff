//! The truth on disk: references, their metadata and descriptors.

use crate::error::ErrorCode;
use crate::types::{MapName, ModelId, NewReference, PackedPatches, Reference, ReferenceFields, ReferenceId};
use time::OffsetDateTime;

/// Why the store could not do as asked.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {}

impl StoreError {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match *self {}
    }
}

/// What became of an insert.
#[derive(Debug, Clone, PartialEq)]
pub enum Inserted {
    /// It is new and durable.
    Created(Reference),
    /// The same external id with the same content was there before.
    AlreadyThere(Reference),
}

/// A map and what it is bound to.
#[derive(Debug, Clone, PartialEq)]
pub struct MapInfo {
    /// Its name.
    pub name: MapName,
    /// The model that made all its descriptors.
    pub model: ModelId,
    /// References in it.
    pub references: u64,
    /// When it was created.
    pub created_at: OffsetDateTime,
}

/// A stored reference as the index needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct GlobalRow {
    /// The reference.
    pub reference: ReferenceId,
    /// Its global descriptor, `[256]`.
    pub global: Vec<f32>,
    /// Its location.
    pub location: Option<crate::types::GeoPoint>,
    /// Its capture time.
    pub captured_at: Option<OffsetDateTime>,
}

/// One page of references, ascending by id.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    /// The references.
    pub references: Vec<Reference>,
    /// Pass as `after` for the next page; absent on the last.
    pub next: Option<ReferenceId>,
}

/// Fields to change; the outer `None` leaves a field as it is, the inner `None` clears it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReferencePatch {
    /// New external id.
    pub external_id: Option<Option<crate::types::ExternalId>>,
    /// New location.
    pub location: Option<Option<crate::types::GeoPoint>>,
    /// New heading.
    pub heading: Option<Option<crate::types::Heading>>,
    /// New capture time.
    pub captured_at: Option<Option<OffsetDateTime>>,
    /// New metadata.
    pub metadata: Option<Option<serde_json::Map<String, serde_json::Value>>>,
}

/// What a check of the whole store found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VerifyReport {
    /// References read.
    pub references: u64,
    /// Damaged ones, with what is wrong; they are quarantined.
    pub damaged: Vec<(ReferenceId, String)>,
    /// What the database engine itself reports.
    pub engine_errors: Vec<String>,
}

/// A durable set of maps. All calls block; callers keep them off the async threads.
///
/// A write returns only after it is fsynced; a reader sees a reference whole or not at all.
pub trait PlaceStore: Send + Sync {
    /// Stores a reference, creating its map on first use.
    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError>;
    /// One reference.
    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError>;
    /// The reference with this external id, if any.
    fn find_external(
        &self,
        map: &MapName,
        external_id: &crate::types::ExternalId,
    ) -> Result<Option<Reference>, StoreError>;
    /// Changes metadata; the descriptor stays.
    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError>;
    /// Deletes one reference and returns what it was.
    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError>;
    /// References of a map (or of all), ascending by id, starting behind `after`.
    fn list(&self, map: Option<&MapName>, after: Option<ReferenceId>, limit: usize) -> Result<Page, StoreError>;
    /// All maps by name.
    fn maps(&self) -> Result<Vec<MapInfo>, StoreError>;
    /// One map.
    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError>;
    /// Deletes a map with everything in it; returns how many references that were.
    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError>;
    /// Metadata of several references; those that vanished meanwhile are left out.
    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError>;
    /// Key patches of one reference, checked against their checksum.
    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError>;
    /// Every global descriptor of a map, to rebuild its index.
    fn scan_globals(&self, map: &MapName, visit: &mut dyn FnMut(GlobalRow)) -> Result<(), StoreError>;
    /// Reads everything, checks every checksum, quarantines what is damaged.
    fn verify(&self) -> Result<VerifyReport, StoreError>;
    /// Bytes on disk, and bytes in the engine's own caches.
    fn footprint(&self) -> Result<(u64, u64), StoreError>;
}

/// Applies a patch to a reference's fields.
pub fn apply_patch(fields: &mut ReferenceFields, patch: ReferencePatch) {
    if let Some(v) = patch.external_id {
        fields.external_id = v;
    }
    if let Some(v) = patch.location {
        fields.location = v;
    }
    if let Some(v) = patch.heading {
        fields.heading = v;
    }
    if let Some(v) = patch.captured_at {
        fields.captured_at = v;
    }
    if let Some(v) = patch.metadata {
        fields.metadata = v;
    }
}

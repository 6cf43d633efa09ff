//! The truth on disk: references, their metadata and descriptors.
//!
//! A place, once acknowledged, must survive anything short of losing the disk; and a damaged disk
//! must be noticed rather than believed. [`PlaceStore`] is what the rest of the crate sees;
//! [`SqliteStore`] keeps it in one database with checksums on every row; `codec.rs` fixes the bytes
//! of key patches; `crash_points.rs` lets tests kill the process between two writes.

pub mod codec;
pub mod crash_points;
mod error;
mod sqlite;

pub use error::{EngineCause, StoreError};
pub use sqlite::SqliteStore;

use placeformer_core::types::{
    Calibration, ExternalId, InvalidValue, MapName, ModelId, NewReference, PackedPatches,
    Reference, ReferenceFields, ReferenceId,
};
use serde::{Deserialize, Serialize};
use std::path::Path;
use time::OffsetDateTime;
use utoipa::ToSchema;

/// Most connections, and most waiting writes: each reader holds files open, each waiting write a
/// descriptor.
const MOST_AT_ONCE: usize = 65_536;

/// Settings of the embedded store. The comments of the fields are printed as the manual of the
/// configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StoreConfig {
    /// Most reading connections open at once; further readers wait.
    pub readers: usize,
    /// Page cache of each connection in KiB. Key patches are read through the system's cache, so
    /// it need not be large.
    pub cache_kib: u32,
    /// Size of a database page in bytes, a power of two from 4096 to 65536. It is fixed when the
    /// database is created.
    pub page_bytes: u32,
    /// Size of the write-ahead log in bytes at which it is folded into the database. Whatever is
    /// set, it is at most a quarter of the reserve that the disk allows (see reserve_bytes).
    pub log_bytes: u64,
    /// Bytes kept free so that deletions succeed on a full disk. Whatever is set, it is at most a
    /// quarter of what the disk has left.
    pub reserve_bytes: u64,
    /// Writes that may wait for the writer; further ones block their caller.
    pub queue: usize,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self {
            readers: 8,
            cache_kib: 2048,
            page_bytes: 16 << 10,
            log_bytes: 16 << 20,
            reserve_bytes: 64 << 20,
            queue: 256,
        }
    }
}

impl StoreConfig {
    /// Refuses what the engine would silently replace by its own idea, or what leaves a store
    /// nobody can use.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let refuse = |field, reason: String| Err(InvalidValue::new(field, reason));
        if !self.page_bytes.is_power_of_two() || !(4096..=65_536).contains(&self.page_bytes) {
            return refuse(
                "store.page_bytes",
                format!(
                    "{} is not a power of two from 4096 to 65536",
                    self.page_bytes
                ),
            );
        }
        for (field, value) in [("store.readers", self.readers), ("store.queue", self.queue)] {
            if !(1..=MOST_AT_ONCE).contains(&value) {
                return refuse(field, format!("{value} is outside 1 to {MOST_AT_ONCE}"));
            }
        }
        if self.cache_kib == 0 || self.cache_kib > i32::MAX as u32 {
            return refuse(
                "store.cache_kib",
                format!("{} is outside 1 to {}", self.cache_kib, i32::MAX),
            );
        }
        Ok(())
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
    /// How far its best answers can be trusted, if that was fitted for this map.
    pub calibration: Option<Calibration>,
}

/// A stored reference as the index needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct GlobalRow {
    /// The reference.
    pub reference: ReferenceId,
    /// Its global descriptor, `[256]`.
    pub global: Vec<f32>,
    /// Its location.
    pub location: Option<placeformer_core::types::GeoPoint>,
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
    pub external_id: Option<Option<ExternalId>>,
    /// New location.
    pub location: Option<Option<placeformer_core::types::GeoPoint>>,
    /// New heading.
    pub heading: Option<Option<placeformer_core::types::Heading>>,
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

/// A reference taken out of service because its stored bytes are damaged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Quarantined {
    /// Which, as far as it can be read.
    pub id: ReferenceId,
    /// What is wrong with it.
    pub reason: String,
}

/// The head that a map is given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewHead {
    /// The map's model from then on.
    pub model: ModelId,
    /// The head's file, to be kept with the map; none for a map that goes with the server's own
    /// head.
    pub file: Option<Vec<u8>>,
}

/// The caller's part in [`PlaceStore::replace_globals`]. A closure that makes one global vector of
/// one pooled vector is one.
pub trait HeadExchange {
    /// The new global vectors of pooled ones (`[dim]` each, unit length to half precision), in
    /// their order. The caller answers for their fitting the new head.
    fn project(&mut self, pooled: &[Vec<f32>]) -> Vec<Vec<f32>>;
    /// Told of every reference that can be served, once its new vector is durable.
    fn converted(&mut self, _row: GlobalRow) {}
    /// All references there are have new vectors. When this returns, those added meanwhile get
    /// theirs and the map changes over; a caller that keeps an index lets no one insert or change
    /// from here on until it has changed over, too.
    fn finishing(&mut self) {}
}

impl<F: FnMut(&[f32]) -> Vec<f32>> HeadExchange for F {
    fn project(&mut self, pooled: &[Vec<f32>]) -> Vec<Vec<f32>> {
        pooled.iter().map(|pooled| self(pooled)).collect()
    }
}

/// Damage that a store has met since it was last asked.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Damage {
    /// Damaged records met for the first time, whichever call met them.
    pub found: u64,
    /// References that are no longer served because of it: quarantined, or replaced by their image
    /// sent again.
    pub withdrawn: Vec<ReferenceId>,
}

/// A durable set of maps. All calls block; callers keep them off the async threads.
///
/// A write returns only after it is fsynced; a reader sees a reference whole or not at all.
pub trait PlaceStore: Send + Sync {
    /// Stores a reference, creating its map on first use.
    ///
    /// Instants are kept to the microsecond in UTC; the returned reference shows them so. The same
    /// external id with the same content finds the reference that is there; if that one is damaged
    /// it is replaced.
    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError>;
    /// Stores several, each with its own outcome, in their order. Not atomic as a whole; shares
    /// syncs of the disk.
    fn insert_many(&self, new: Vec<NewReference>) -> Vec<Result<Inserted, StoreError>> {
        new.into_iter().map(|new| self.insert(new)).collect()
    }
    /// One reference.
    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError>;
    /// The reference with this external id, if any.
    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError>;
    /// Changes metadata; the descriptor stays.
    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError>;
    /// Deletes one reference and returns what it was. Of one whose own row is damaged only
    /// identity, map and model are returned; the other fields are empty.
    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError>;
    /// References of a map (or of all), ascending by id, starting behind `after`.
    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<ReferenceId>,
        limit: usize,
    ) -> Result<Page, StoreError>;
    /// All maps by name.
    fn maps(&self) -> Result<Vec<MapInfo>, StoreError>;
    /// One map.
    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError>;
    /// Deletes a map with everything in it, at once and atomically; returns how many references
    /// that were. Their room is freed in the background.
    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError>;
    /// Metadata of several references; those that vanished meanwhile or are damaged are left out.
    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError>;
    /// Key patches of one reference, checked against their checksum.
    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError>;
    /// Every global descriptor of a map that can be read, to rebuild its index. References whose
    /// descriptor is damaged or lost are quarantined and left out. An error says that others may be
    /// missing, too; those visited are good.
    fn scan_globals(
        &self,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError>;
    /// Gives a map another head: `exchange` makes the new global vectors of the pooled ones.
    /// Atomic: all references change to the new model or none. Reads and writes go on meanwhile;
    /// the map's calibration is cleared.
    fn replace_globals(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError>;
    /// The file of the head that the map keeps for itself, as it was given; none if it goes with
    /// the server's own.
    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError>;
    /// Stores the map's calibration, which must have been fitted for its model, or clears it.
    fn set_calibration(
        &self,
        map: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), StoreError>;
    /// References known to be damaged. They are not served; deleting them or sending their image
    /// again ends it.
    fn quarantined(&self) -> Result<Vec<Quarantined>, StoreError>;
    /// What damage was met since the last call, so that it can be counted and an index follow.
    /// Cheap where there is none.
    fn drain_damage(&self) -> Damage;
    /// Writes a consistent copy of everything to a new file while the store is in use; returns its
    /// size in bytes. Put in a data directory under the database's name ([`SqliteStore::DATABASE`])
    /// it is a store again.
    fn backup(&self, target: &Path) -> Result<u64, StoreError>;
    /// Reads everything, checks every checksum, quarantines what is damaged.
    fn verify(&self) -> Result<VerifyReport, StoreError>;
    /// Bytes on disk, and the most bytes that the engine's own caches can hold with the connections
    /// now open.
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

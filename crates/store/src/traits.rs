//! What a store can do, in three parts: reading, writing, and maintenance.
//!
//! They are three traits so that code can ask for what it uses, and so that a second store, or a
//! stand-in for tests, implements the parts that it has. [`CombinedStore`](crate::CombinedStore)
//! makes one store of parts from several.

use crate::error::StoreError;
use crate::records::{
    Cursor, Damage, Footprint, GlobalRow, Inserted, MapInfo, NewHead, Page, Quarantined,
    ReferencePatch, VerifyReport,
};
use placeformer_core::types::{
    Calibration, ExternalId, MapName, NewReference, PackedPatches, Reference, ReferenceId,
};
use std::path::Path;

/// A durable set of maps that can be read, written and maintained. Every type with the three parts
/// is one.
///
/// All calls block; callers keep them off the async threads.
pub trait PlaceStore: ReadPlaces + WritePlaces + MaintainPlaces {}

impl<S: ReadPlaces + WritePlaces + MaintainPlaces + ?Sized> PlaceStore for S {}

/// Reading maps and references.
///
/// A reader sees a reference whole or not at all. A reference found damaged is quarantined: it is
/// not served any more, and the call that found it fails with [`StoreError::CorruptRecord`] or
/// leaves it out. Every method fails with [`StoreError::Damaged`] or [`StoreError::Engine`] if the
/// database itself cannot be read.
pub trait ReadPlaces: Send + Sync {
    /// One reference.
    ///
    /// # Errors
    /// It does not exist or is damaged.
    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError>;

    /// Metadata of several references. Those that do not exist or are damaged are left out.
    ///
    /// # Errors
    /// The database cannot be read.
    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError>;

    /// The reference with this external id, if any.
    ///
    /// # Errors
    /// It is damaged, or the record of its map is.
    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError>;

    /// The map that a reference is of, also if the reference itself is damaged.
    ///
    /// # Errors
    /// The reference does not exist, or its map's record is damaged.
    fn map_of(&self, id: ReferenceId) -> Result<MapName, StoreError>;

    /// References of a map (or of all maps) in the order they were added, starting behind `after`,
    /// at most `limit`. Damaged ones are left out.
    ///
    /// # Errors
    /// The map does not exist or its record is damaged.
    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<Cursor>,
        limit: usize,
    ) -> Result<Page, StoreError>;

    /// Key patches of one reference, checked against their checksum.
    ///
    /// # Errors
    /// The reference does not exist or is damaged.
    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError>;

    /// All maps by name. Maps with a damaged record are left out.
    ///
    /// # Errors
    /// The database cannot be read.
    fn maps(&self) -> Result<Vec<MapInfo>, StoreError>;

    /// One map.
    ///
    /// # Errors
    /// It does not exist or its record is damaged.
    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError>;

    /// The file of the head that the map keeps for itself, as it was given; none if the map uses
    /// the server's own.
    ///
    /// # Errors
    /// The map does not exist, or the head or the map's record is damaged.
    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError>;

    /// Visits every global descriptor of a map that can be read, so that its index can be rebuilt.
    /// References whose descriptor is damaged or lost are quarantined and left out.
    ///
    /// # Errors
    /// The map does not exist or cannot be read to its end. What was visited until then is good,
    /// but other references may be missing.
    fn scan_globals(
        &self,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError>;
}

/// Writing maps and references.
///
/// A write returns only after it is fsynced. Every method fails with [`StoreError::DiskFull`] if
/// there is no room for it, with [`StoreError::StorageLost`] if the files of the store are gone,
/// exchanged or cannot be written, and with [`StoreError::Closing`] while the store is closing.
/// After [`StoreError::StorageLost`] the write may or may not be there once the storage is back.
pub trait WritePlaces: Send + Sync {
    /// Stores a reference, creating its map on first use.
    ///
    /// Instants are kept to the microsecond in UTC; the returned reference shows them so. The same
    /// external id with the same content finds the existing reference; a damaged one is replaced.
    ///
    /// # Errors
    /// The map is bound to another model, the external id belongs to other content, or the
    /// descriptor breaks a rule of its type.
    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError>;

    /// Stores several, each with its own outcome, in their order. Not atomic as a whole; a store
    /// may let them share syncs of the disk.
    fn insert_many(&self, new: Vec<NewReference>) -> Vec<Result<Inserted, StoreError>> {
        new.into_iter().map(|new| self.insert(new)).collect()
    }

    /// Changes metadata; the descriptor stays.
    ///
    /// # Errors
    /// The reference does not exist or is damaged, or the new external id belongs to another.
    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError>;

    /// Deletes one reference and returns what it was. Of one whose own row is damaged only
    /// identity, map and model are returned; the other fields are empty.
    ///
    /// # Errors
    /// The reference does not exist.
    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError>;

    /// Deletes a map with everything in it, at once and atomically, and returns how many
    /// references it had. Their room on disk is freed in the background.
    ///
    /// # Errors
    /// The map does not exist.
    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError>;

    /// Gives a map another head: `exchange` makes the new global vectors from the pooled ones.
    ///
    /// Atomic: all references change to the new model or none. Reads and writes go on meanwhile.
    /// The map's calibration is cleared.
    ///
    /// # Errors
    /// The map does not exist, is already being given another head, or `exchange` fails.
    fn replace_globals(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError>;

    /// Stores the map's calibration, or clears it.
    ///
    /// # Errors
    /// The map does not exist, or the calibration was fitted for another model than the map's.
    fn set_calibration(
        &self,
        map: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), StoreError>;
}

/// Looking after a store: damage, checks, backups, size.
pub trait MaintainPlaces: Send + Sync {
    /// References known to be damaged. They are not served. Deleting them, or sending their image
    /// again, takes them off the list.
    ///
    /// # Errors
    /// The list cannot be read.
    fn quarantined(&self) -> Result<Vec<Quarantined>, StoreError>;

    /// What damage was found since the last call, so that it can be counted and an index can drop
    /// what is no longer served. Cheap when there is none.
    fn drain_damage(&self) -> Damage;

    /// Reads everything, checks every checksum, quarantines what is damaged.
    ///
    /// # Errors
    /// The check itself could not be made. Damage is no error; it is in the report.
    fn verify(&self) -> Result<VerifyReport, StoreError>;

    /// Writes a consistent copy of everything to a new file while the store is in use, and returns
    /// its size in bytes. Put in a data directory under the database's name
    /// ([`SqliteStore::DATABASE`](crate::SqliteStore::DATABASE)) the copy is a store again.
    ///
    /// # Errors
    /// `target` exists, or cannot be written.
    fn backup(&self, target: &Path) -> Result<u64, StoreError>;

    /// Whether writes would be kept: the files that are open are still those of the store, on a
    /// disk that takes them. Cheap enough to be called every second.
    ///
    /// # Errors
    /// [`StoreError::StorageLost`], with the reason.
    fn check_storage(&self) -> Result<(), StoreError> {
        Ok(())
    }

    /// The room that the store takes on disk and in memory.
    ///
    /// # Errors
    /// It cannot be measured.
    fn footprint(&self) -> Result<Footprint, StoreError>;
}

/// What the caller of [`WritePlaces::replace_globals`] contributes: the projection itself, and
/// whatever must follow the progress. A closure that makes one global vector from one pooled
/// vector is one.
pub trait HeadExchange {
    /// The new global vectors of pooled ones, in their order. A pooled vector is `[dim]` with unit
    /// length to half precision; a global vector is `[256]`. The caller answers for the pooled
    /// vectors being of the kind that the new head expects.
    ///
    /// # Errors
    /// Whatever keeps the caller from making them; the map then keeps its old head.
    fn project(&mut self, pooled: &[Vec<f32>]) -> Result<Vec<Vec<f32>>, StoreError>;

    /// Called for every reference that can be served, once its new vector is durable.
    fn converted(&mut self, _row: GlobalRow) {}

    /// Called once, when every reference that was there has its new vector. When it returns, those
    /// added meanwhile get theirs, and the map changes to the new head.
    ///
    /// A caller that keeps an index stops inserts and changes to the map from here on, until its
    /// index has changed to the new head as well.
    fn finishing(&mut self) {}
}

impl<F: FnMut(&[f32]) -> Vec<f32>> HeadExchange for F {
    fn project(&mut self, pooled: &[Vec<f32>]) -> Result<Vec<Vec<f32>>, StoreError> {
        Ok(pooled.iter().map(|pooled| self(pooled)).collect())
    }
}

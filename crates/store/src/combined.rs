//! One store made of parts from several.
//!
//! A cache in front of a store, a measuring stand-in, or a store split over two services changes
//! one part of what a store does. It implements that part alone, and takes the others from the
//! store around which it is put.

use crate::error::StoreError;
use crate::records::{
    Cursor, Damage, Footprint, GlobalRow, Inserted, MapInfo, NewHead, Page, Quarantined,
    ReferencePatch, VerifyReport,
};
use crate::traits::{HeadExchange, MaintainPlaces, ReadPlaces, WritePlaces};
use placeformer_core::types::{
    Calibration, ExternalId, MapName, NewReference, PackedPatches, Reference, ReferenceId,
};
use std::path::Path;
use std::sync::Arc;

/// A store whose parts may come from different stores. Every call goes to the part that it belongs
/// to.
#[derive(Clone)]
pub struct CombinedStore {
    /// Answers what is read.
    pub reading: Arc<dyn ReadPlaces>,
    /// Takes what is written.
    pub writing: Arc<dyn WritePlaces>,
    /// Checks, copies and measures.
    pub maintenance: Arc<dyn MaintainPlaces>,
}

impl CombinedStore {
    /// All three parts of one store, to be replaced one by one.
    pub fn of<S>(store: Arc<S>) -> Self
    where
        S: ReadPlaces + WritePlaces + MaintainPlaces + 'static,
    {
        Self {
            reading: store.clone(),
            writing: store.clone(),
            maintenance: store,
        }
    }
}

impl ReadPlaces for CombinedStore {
    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        self.reading.get(id)
    }

    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError> {
        self.reading.get_many(ids)
    }

    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        self.reading.find_external(map, external_id)
    }

    fn map_of(&self, id: ReferenceId) -> Result<MapName, StoreError> {
        self.reading.map_of(id)
    }

    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<Cursor>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        self.reading.list(map, after, limit)
    }

    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError> {
        self.reading.patches(id)
    }

    fn maps(&self) -> Result<Vec<MapInfo>, StoreError> {
        self.reading.maps()
    }

    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError> {
        self.reading.map(name)
    }

    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError> {
        self.reading.head(map)
    }

    fn scan_globals(
        &self,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        self.reading.scan_globals(map, visit)
    }
}

impl WritePlaces for CombinedStore {
    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError> {
        self.writing.insert(new)
    }

    fn insert_many(&self, new: Vec<NewReference>) -> Vec<Result<Inserted, StoreError>> {
        self.writing.insert_many(new)
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError> {
        self.writing.update(id, patch)
    }

    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        self.writing.delete(id)
    }

    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError> {
        self.writing.delete_map(name)
    }

    fn replace_globals(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        self.writing.replace_globals(map, head, exchange)
    }

    fn set_calibration(
        &self,
        map: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), StoreError> {
        self.writing.set_calibration(map, calibration)
    }
}

impl MaintainPlaces for CombinedStore {
    fn quarantined(&self) -> Result<Vec<Quarantined>, StoreError> {
        self.maintenance.quarantined()
    }

    fn drain_damage(&self) -> Damage {
        self.maintenance.drain_damage()
    }

    fn verify(&self) -> Result<VerifyReport, StoreError> {
        self.maintenance.verify()
    }

    fn backup(&self, target: &Path) -> Result<u64, StoreError> {
        self.maintenance.backup(target)
    }

    fn check_storage(&self) -> Result<(), StoreError> {
        self.maintenance.check_storage()
    }

    fn footprint(&self) -> Result<Footprint, StoreError> {
        self.maintenance.footprint()
    }
}

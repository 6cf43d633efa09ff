//! A store that shows more references than it holds.
//!
//! To measure queries at a million references without a million photos, a map of real references is
//! filled up with random global vectors. These are far from every query, so the candidates are the
//! real ones; should one be asked for after all, it lends the patches of a real reference.

use super::scenes::index_entry;
use placeformer_core::types::{
    Calibration, ExternalId, MapName, NewReference, PackedPatches, Reference, ReferenceId,
};
use placeformer_store::{
    Damage, GlobalRow, HeadExchange, Inserted, MapInfo, NewHead, Page, PlaceStore, Quarantined,
    ReferencePatch, StoreError, VerifyReport,
};
use rayon::prelude::*;
use std::path::Path;

/// References made up at once while an index is built.
const BATCH: u64 = 16_384;

/// A store and how many references each of its maps pretends to have in addition.
pub struct FilledStore<S> {
    store: S,
    lenders: Vec<ReferenceId>,
    extra: u64,
}

impl<S: PlaceStore> FilledStore<S> {
    /// Fills the maps of `store` up with `extra` references each.
    ///
    /// # Errors
    /// The store's.
    pub fn new(store: S, extra: u64) -> Result<Self, StoreError> {
        let lenders = store
            .list(None, None, 1000)?
            .references
            .into_iter()
            .map(|reference| reference.id)
            .collect();
        Ok(Self {
            store,
            lenders,
            extra,
        })
    }

    /// The reference whose content stands in for `id`, which is itself if it is real.
    fn real(&self, id: ReferenceId) -> ReferenceId {
        let number = u128::from_be_bytes(*id.as_bytes());
        match self.lenders.len() as u128 {
            lenders if lenders > 0 && number < u128::from(self.extra) => {
                self.lenders[(number % lenders) as usize]
            }
            _ => id,
        }
    }
}

impl<S: PlaceStore> PlaceStore for FilledStore<S> {
    fn insert(&self, new: NewReference) -> Result<Inserted, StoreError> {
        self.store.insert(new)
    }

    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        Ok(Reference {
            id,
            ..self.store.get(self.real(id))?
        })
    }

    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        self.store.find_external(map, external_id)
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Result<Reference, StoreError> {
        self.store.update(id, patch)
    }

    fn delete(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        self.store.delete(id)
    }

    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<ReferenceId>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        self.store.list(map, after, limit)
    }

    fn maps(&self) -> Result<Vec<MapInfo>, StoreError> {
        self.store.maps()
    }

    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError> {
        self.store.map(name)
    }

    fn delete_map(&self, name: &MapName) -> Result<u64, StoreError> {
        self.store.delete_map(name)
    }

    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError> {
        ids.iter().map(|&id| self.get(id)).collect()
    }

    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError> {
        self.store.patches(self.real(id))
    }

    fn scan_globals(
        &self,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        for from in (0..self.extra).step_by(BATCH as usize) {
            let batch: Vec<_> = (from..self.extra.min(from + BATCH))
                .into_par_iter()
                .map(index_entry)
                .collect();
            for entry in batch {
                visit(GlobalRow {
                    reference: entry.id,
                    global: entry.global,
                    location: entry.location,
                    captured_at: entry.captured_at,
                });
            }
        }
        self.store.scan_globals(map, visit)
    }

    fn replace_globals(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        self.store.replace_globals(map, head, exchange)
    }

    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError> {
        self.store.head(map)
    }

    fn set_calibration(
        &self,
        map: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), StoreError> {
        self.store.set_calibration(map, calibration)
    }

    fn quarantined(&self) -> Result<Vec<Quarantined>, StoreError> {
        self.store.quarantined()
    }

    fn drain_damage(&self) -> Damage {
        self.store.drain_damage()
    }

    fn backup(&self, target: &Path) -> Result<u64, StoreError> {
        self.store.backup(target)
    }

    fn verify(&self) -> Result<VerifyReport, StoreError> {
        self.store.verify()
    }

    fn footprint(&self) -> Result<(u64, u64), StoreError> {
        self.store.footprint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::scenes::made_up_id;
    use placeformer_core::types::{
        ContentHash, Descriptor, GLOBAL_DIM, ModelId, PatchGrid, PoolingStride, ReferenceFields,
    };
    use placeformer_store::{SqliteStore, StoreConfig};

    fn reference(map: &MapName) -> NewReference {
        let grid = PatchGrid {
            columns: 8,
            rows: 6,
            patch_px: 14,
            stride: PoolingStride::Kernel,
        };
        let patches = PackedPatches {
            grid,
            dim: 4,
            counts: [1, 0, 0],
            index: vec![3],
            attention: vec![half::f16::ONE],
            factor: vec![0.5],
            codes: vec![1, 2, 3, 4],
        };
        let descriptor = Descriptor {
            global: vec![0.0625; GLOBAL_DIM],
            pooled: vec![1.0, 0.0],
            patches,
        };
        NewReference {
            map: map.clone(),
            fields: ReferenceFields::default(),
            content_hash: ContentHash::of(b"photo"),
            model: ModelId::new("model"),
            descriptor,
        }
    }

    #[test]
    fn made_up_references_are_seen_and_lend_real_patches() {
        let directory = tempfile::tempdir().unwrap();
        let store = SqliteStore::open(directory.path(), &StoreConfig::default()).unwrap();
        let map: MapName = "m".parse().unwrap();
        let Inserted::Created(real) = store.insert(reference(&map)).unwrap() else {
            panic!("the store was empty")
        };
        let filled = FilledStore::new(store, 20_000).unwrap();
        let mut seen = Vec::new();
        filled
            .scan_globals(&map, &mut |row| seen.push(row.reference))
            .unwrap();
        assert_eq!((seen.len(), seen[20_000]), (20_001, real.id));
        let made_up = made_up_id(19_999);
        assert_eq!(seen[19_999], made_up);
        assert_eq!(
            filled.patches(made_up).unwrap(),
            filled.patches(real.id).unwrap()
        );
        assert_eq!(filled.get_many(&[made_up]).unwrap()[0].id, made_up);
        assert!(filled.patches(made_up_id(20_000)).is_err());
    }
}

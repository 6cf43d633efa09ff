//! A store that shows more references than it holds.
//!
//! To measure queries at a million references without a million photos, a map of real references is
//! filled up with random global vectors. These are far from every query, so the candidates are the
//! real ones; should one be asked for after all, it lends the patches of a real reference.

use super::scenes::index_entry;
use placeformer_core::types::{ExternalId, MapName, PackedPatches, Reference, ReferenceId};
use placeformer_store::{
    CombinedStore, Cursor, GlobalRow, MapInfo, Page, PlaceStore, ReadPlaces, StoreError,
};
use rayon::prelude::*;
use std::sync::Arc;

/// References made up at once while an index is built.
const BATCH: u64 = 16_384;

/// The reading part of a store, and how many references each of its maps pretends to have in
/// addition.
pub struct FilledStore {
    store: Arc<dyn ReadPlaces>,
    lenders: Vec<ReferenceId>,
    extra: u64,
}

impl FilledStore {
    /// `store` with its maps filled up with `extra` references each. It is written and maintained as
    /// before.
    ///
    /// # Errors
    /// The store's.
    pub fn around<S: PlaceStore + 'static>(
        store: S,
        extra: u64,
    ) -> Result<CombinedStore, StoreError> {
        let whole = CombinedStore::of(Arc::new(store));
        let filled = Self::new(whole.reading.clone(), extra)?;
        Ok(CombinedStore {
            reading: Arc::new(filled),
            ..whole
        })
    }

    fn new(store: Arc<dyn ReadPlaces>, extra: u64) -> Result<Self, StoreError> {
        let page = store.list(None, None, 1000)?;
        let lenders = page
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

impl ReadPlaces for FilledStore {
    fn get(&self, id: ReferenceId) -> Result<Reference, StoreError> {
        Ok(Reference {
            id,
            ..self.store.get(self.real(id))?
        })
    }

    fn get_many(&self, ids: &[ReferenceId]) -> Result<Vec<Reference>, StoreError> {
        ids.iter().map(|&id| self.get(id)).collect()
    }

    fn find_external(
        &self,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        self.store.find_external(map, external_id)
    }

    fn map_of(&self, id: ReferenceId) -> Result<MapName, StoreError> {
        self.store.map_of(self.real(id))
    }

    fn list(
        &self,
        map: Option<&MapName>,
        after: Option<Cursor>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        self.store.list(map, after, limit)
    }

    fn patches(&self, id: ReferenceId) -> Result<PackedPatches, StoreError> {
        self.store.patches(self.real(id))
    }

    fn maps(&self) -> Result<Vec<MapInfo>, StoreError> {
        self.store.maps()
    }

    fn map(&self, name: &MapName) -> Result<MapInfo, StoreError> {
        self.store.map(name)
    }

    fn head(&self, map: &MapName) -> Result<Option<Vec<u8>>, StoreError> {
        self.store.head(map)
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
                    alt: entry.alt,
                    heading: entry.heading,
                    captured_at: entry.captured_at,
                });
            }
        }
        self.store.scan_globals(map, visit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::scenes::made_up_id;
    use placeformer_core::types::{
        ContentHash, Descriptor, GLOBAL_DIM, ModelId, NewReference, PatchGrid, PoolingStride,
        ReferenceFields,
    };
    use placeformer_store::{Inserted, SqliteStore, StoreConfig, WritePlaces};

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
        let filled = FilledStore::around(store, 20_000).unwrap();
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

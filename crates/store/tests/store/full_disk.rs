//! A full disk: new references are refused, everything else goes on.

use crate::places::{self, map, reference};
use crate::small_disk::SmallDisk;
use crate::support::create;
use placeformer_core::types::{MapName, NewReference};
use placeformer_store::{
    Inserted, MaintainPlaces, ReadPlaces, SqliteStore, StoreConfig, StoreError, WritePlaces,
};

/// A reference of the size that real ones have, about 120 kB.
fn large(map: &MapName, seed: u64) -> NewReference {
    NewReference {
        descriptor: places::descriptor(seed, 300, 384),
        ..reference(map, seed)
    }
}

#[test]
fn a_full_disk_refuses_new_references_but_serves_and_deletes() {
    let Some(disk) = SmallDisk::mount() else {
        return;
    };
    let city = map("city");
    let other = map("other");
    let store = SqliteStore::open(disk.path(), &StoreConfig::default()).unwrap();
    for round in 0..3 {
        let mut ids = Vec::new();
        let refused = loop {
            let target = if ids.len() % 2 == 0 { &city } else { &other };
            match store.insert(large(target, ids.len() as u64)) {
                Ok(Inserted::Created(created)) => ids.push(created.id),
                Ok(other) => panic!("{other:?}"),
                Err(error) => break error,
            }
        };
        assert!(matches!(refused, StoreError::DiskFull), "{refused}");
        assert!(
            ids.len() >= 15,
            "only {} references fit in round {round}",
            ids.len()
        );
        let filler = disk.fill();
        for (seed, id) in ids.iter().enumerate() {
            assert_eq!(
                store.patches(*id).unwrap(),
                large(&city, seed as u64).descriptor.patches
            );
        }
        assert!(matches!(
            store.insert(large(&city, 7777)),
            Err(StoreError::DiskFull)
        ));
        for id in ids.iter().take(6) {
            store
                .delete(*id)
                .unwrap_or_else(|error| panic!("round {round}: {error}"));
        }
        assert_eq!(
            store.list(None, None, 1000).unwrap().references.len(),
            ids.len() - 6
        );
        store.delete_map(&city).unwrap();
        std::fs::remove_file(filler).unwrap();
        create(&store, large(&other, 8888));
        store.delete_map(&other).unwrap();
    }
    let report = store.verify().unwrap();
    assert_eq!((report.damaged, report.engine_errors), (vec![], vec![]));
}

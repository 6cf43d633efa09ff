//! The index is a cache of the store: after any history, one rebuilt from the store equals the one kept alive.

#[path = "common/places.rs"]
mod places;

use placeformer::search::{IndexBuilder, IndexEntry, MapIndex};
use placeformer::store::{Inserted, PlaceStore, SqliteStore, StoreConfig};
use placeformer::types::{GLOBAL_DIM, MapName, NewReference, Reference, ReferenceFilter, ReferenceId};
use places::{map, named_reference, reference, unit_vector};
use proptest::prelude::*;

fn open(directory: &std::path::Path) -> SqliteStore {
    SqliteStore::open(directory, &StoreConfig { reserve_bytes: 1 << 20, ..StoreConfig::default() }).unwrap()
}

fn rebuild(store: &SqliteStore, map: &MapName) -> MapIndex {
    let mut entries = IndexBuilder::default();
    if store.map(map).is_ok() {
        store
            .scan_globals(map, &mut |row| {
                let (id, global) = (row.reference, row.global);
                entries.push(IndexEntry { id, global, location: row.location, captured_at: row.captured_at });
            })
            .unwrap();
    }
    entries.finish()
}

fn entry(reference: &Reference, new: &NewReference) -> IndexEntry {
    IndexEntry {
        id: reference.id,
        global: new.descriptor.global.clone(),
        location: reference.fields.location,
        captured_at: reference.fields.captured_at,
    }
}

fn assert_equal(a: &MapIndex, b: &MapIndex) {
    assert_eq!(a.len(), b.len());
    let filters = [
        ReferenceFilter::default(),
        ReferenceFilter {
            captured_after: Some(time::OffsetDateTime::from_unix_timestamp(1_700_000_100).unwrap()),
            ..ReferenceFilter::default()
        },
    ];
    for (seed, filter) in (0..3).flat_map(|seed| filters.iter().map(move |filter| (seed, filter))) {
        let query = unit_vector(seed, GLOBAL_DIM);
        assert_eq!(a.search(&query, a.len() + 1, filter), b.search(&query, a.len() + 1, filter));
    }
}

#[derive(Debug, Clone)]
enum Operation {
    Insert(u64),
    InsertNamed(u64),
    Delete(prop::sample::Index),
    DeleteMap,
    Reopen,
}

fn operation() -> impl Strategy<Value = Operation> {
    prop_oneof![
        12 => (0u64..1000).prop_map(Operation::Insert),
        6 => (0u64..8).prop_map(Operation::InsertNamed),
        6 => any::<prop::sample::Index>().prop_map(Operation::Delete),
        1 => Just(Operation::DeleteMap),
        1 => Just(Operation::Reopen),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn rebuilt_equals_live_after_any_history(operations in prop::collection::vec(operation(), 0..60)) {
        let directory = tempfile::tempdir().unwrap();
        let mut store = open(directory.path());
        let city = map("city");
        let mut live = MapIndex::default();
        let mut ids: Vec<ReferenceId> = Vec::new();
        for operation in operations {
            match operation {
                Operation::Insert(_) | Operation::InsertNamed(_) => {
                    let new = match operation {
                        Operation::InsertNamed(seed) => named_reference(&city, &format!("photo {seed}"), seed),
                        Operation::Insert(seed) => reference(&city, seed),
                        _ => unreachable!(),
                    };
                    if let Inserted::Created(created) = store.insert(new.clone()).unwrap() {
                        live.insert(entry(&created, &new));
                        ids.push(created.id);
                    }
                }
                Operation::Delete(which) if !ids.is_empty() => {
                    let id = ids.swap_remove(which.index(ids.len()));
                    store.delete(id).unwrap();
                    prop_assert!(live.remove(id));
                }
                Operation::Delete(_) => {}
                Operation::DeleteMap => {
                    if store.map(&city).is_ok() {
                        prop_assert_eq!(store.delete_map(&city).unwrap(), ids.len() as u64);
                    }
                    live = MapIndex::default();
                    ids.clear();
                }
                Operation::Reopen => {
                    drop(store);
                    store = open(directory.path());
                }
            }
        }
        assert_equal(&rebuild(&store, &city), &live);
    }
}

#[test]
fn rebuilt_equals_live_across_many_blocks() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path());
    let city = map("city");
    let live = MapIndex::default();
    let new: Vec<NewReference> = (0..9000).map(|seed| reference(&city, seed)).collect();
    let mut ids = Vec::new();
    for (outcome, new) in store.insert_many(new.clone()).into_iter().zip(&new) {
        let Ok(Inserted::Created(created)) = outcome else { panic!("{outcome:?}") };
        live.insert(entry(&created, new));
        ids.push(created.id);
    }
    assert_equal(&rebuild(&store, &city), &live);
    // Several threads, so that their deletions share syncs of the disk.
    let doomed: Vec<ReferenceId> = ids.into_iter().filter(|id| id.seed() % 3 != 0).collect();
    std::thread::scope(|scope| {
        for part in doomed.chunks(doomed.len().div_ceil(32)) {
            let (store, live) = (&store, &live);
            scope.spawn(move || {
                for id in part {
                    store.delete(*id).unwrap();
                    assert!(live.remove(*id));
                }
            });
        }
    });
    assert_equal(&rebuild(&store, &city), &live);
}

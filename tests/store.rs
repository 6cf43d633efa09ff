//! The contract of [`PlaceStore`], held by the embedded store through its public door.

#[path = "common/places.rs"]
mod places;

use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    Calibration, ConfidenceCurve, ConfidenceWeights, GLOBAL_DIM, GeoPoint, Heading, MapName,
    ModelId, NewReference, Reference, ReferenceId, RerankId,
};
use placeformer_store::{
    Inserted, NewHead, PlaceStore, ReferencePatch, SqliteStore, StoreConfig, StoreError,
};
use places::{MODEL, map, named_reference, reference};
use std::collections::{BTreeMap, HashSet};
use tempfile::TempDir;

fn config() -> StoreConfig {
    StoreConfig {
        reserve_bytes: 1 << 20,
        ..StoreConfig::default()
    }
}

fn open(directory: &TempDir) -> SqliteStore {
    SqliteStore::open(directory.path(), &config()).unwrap()
}

fn fresh() -> (TempDir, SqliteStore) {
    let directory = tempfile::tempdir().unwrap();
    let store = open(&directory);
    (directory, store)
}

fn create(store: &SqliteStore, new: NewReference) -> Reference {
    match store.insert(new).unwrap() {
        Inserted::Created(reference) => reference,
        Inserted::AlreadyThere(reference) => panic!("{reference:?} was there before"),
    }
}

/// A calibration for `model`.
fn calibration(model: &str) -> Calibration {
    let curve = |score| ConfidenceCurve {
        weights: ConfidenceWeights {
            bias: -2.5,
            score,
            distance: -1.5,
        },
        threshold: 0.75,
        right: 80,
        wrong: 60,
        without_match: 50,
        precision: 0.99,
        recall: 0.875,
        expected_calibration_error: 0.03125,
    };
    Calibration::new(
        ModelId::new(model),
        RerankId::new("r"),
        "town",
        0.99,
        [curve(1.25), curve(0.0)],
    )
    .unwrap()
}

fn globals(store: &SqliteStore, map: &MapName) -> BTreeMap<ReferenceId, Vec<f32>> {
    let mut rows = BTreeMap::new();
    store
        .scan_globals(map, &mut |row| {
            assert!(rows.insert(row.reference, row.global).is_none())
        })
        .unwrap();
    rows
}

/// A head that a map is to keep.
fn new_head(model: &str) -> NewHead {
    NewHead {
        model: ModelId::new(model),
        file: Some(format!("the head of {model}").into_bytes()),
    }
}

#[test]
fn what_is_stored_is_found_again_also_after_reopening() {
    let (directory, store) = fresh();
    let new = named_reference(&map("city"), "photo 1", 7);
    let created = create(&store, new.clone());
    assert_eq!(
        (&created.fields, created.content_hash, &created.model),
        (&new.fields, new.content_hash, &new.model)
    );
    drop(store);
    let store = open(&directory);
    assert_eq!(store.get(created.id).unwrap(), created);
    assert_eq!(store.patches(created.id).unwrap(), new.descriptor.patches);
    assert_eq!(
        globals(&store, &new.map),
        BTreeMap::from([(created.id, new.descriptor.global.clone())])
    );
    let external = new.fields.external_id.unwrap();
    assert_eq!(
        store.find_external(&new.map, &external).unwrap(),
        Some(created.clone())
    );
    assert_eq!(
        store
            .get_many(&[ReferenceId::generate(), created.id])
            .unwrap(),
        [created]
    );
    let info = store.map(&new.map).unwrap();
    assert_eq!(
        (info.references, info.model.as_str(), store.maps().unwrap()),
        (1, MODEL, vec![info.clone()])
    );
    let report = store.verify().unwrap();
    assert_eq!(
        (report.references, report.damaged, report.engine_errors),
        (1, vec![], vec![])
    );
}

#[test]
fn absent_things_are_named() {
    let (_directory, store) = fresh();
    let (nowhere, nobody) = (map("nowhere"), ReferenceId::generate());
    let codes = [
        store.get(nobody).unwrap_err().code(),
        store.patches(nobody).unwrap_err().code(),
        store.delete(nobody).unwrap_err().code(),
        store
            .update(nobody, ReferencePatch::default())
            .unwrap_err()
            .code(),
    ];
    assert_eq!(codes, [ErrorCode::ReferenceNotFound; 4]);
    let codes = [
        store.map(&nowhere).unwrap_err().code(),
        store.delete_map(&nowhere).unwrap_err().code(),
        store.list(Some(&nowhere), None, 1).unwrap_err().code(),
        store
            .scan_globals(&nowhere, &mut |_| ())
            .unwrap_err()
            .code(),
        store
            .set_calibration(&nowhere, Some(calibration(MODEL)))
            .unwrap_err()
            .code(),
    ];
    assert_eq!(codes, [ErrorCode::MapNotFound; 5]);
    assert!(
        store
            .get(nobody)
            .unwrap_err()
            .to_string()
            .contains(&nobody.to_string())
    );
}

#[test]
fn an_external_id_belongs_to_one_content() {
    let (_directory, store) = fresh();
    let city = map("city");
    let first = create(&store, named_reference(&city, "x", 1));
    assert_eq!(
        store.insert(named_reference(&city, "x", 1)).unwrap(),
        Inserted::AlreadyThere(first.clone())
    );
    match store.insert(named_reference(&city, "x", 2)) {
        Err(StoreError::ExternalIdConflict { existing, .. }) => assert_eq!(existing, first.id),
        other => panic!("{other:?}"),
    }
    create(&store, named_reference(&map("other"), "x", 2));
    assert_eq!(store.map(&city).unwrap().references, 1);
}

#[test]
fn concurrent_creates_of_one_external_id_yield_one_reference() {
    let (_directory, store) = fresh();
    let city = map("city");
    for round in 0..20 {
        let name = format!("photo {round}");
        let outcomes: Vec<_> = std::thread::scope(|scope| {
            let (store, city, name) = (&store, &city, &name);
            let threads: Vec<_> = (0..4)
                .map(|_| {
                    scope.spawn(move || store.insert(named_reference(city, name, round)).unwrap())
                })
                .collect();
            threads
                .into_iter()
                .map(|thread| thread.join().unwrap())
                .collect()
        });
        let created = outcomes
            .iter()
            .filter(|outcome| matches!(outcome, Inserted::Created(_)))
            .count();
        let ids: HashSet<_> = outcomes
            .iter()
            .map(|outcome| match outcome {
                Inserted::Created(reference) | Inserted::AlreadyThere(reference) => reference.id,
            })
            .collect();
        assert_eq!((created, ids.len()), (1, 1));
    }
    assert_eq!(store.map(&city).unwrap().references, 20);
}

#[test]
fn a_map_is_bound_to_one_model() {
    let (_directory, store) = fresh();
    let city = map("city");
    create(&store, reference(&city, 1));
    let other = NewReference {
        model: ModelId::new("another"),
        ..reference(&city, 2)
    };
    match store.insert(other) {
        Err(StoreError::ModelMismatch { bound, given, .. }) => {
            assert_eq!((bound.as_str(), given.as_str()), (MODEL, "another"));
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn descriptors_that_break_their_rules_are_refused() {
    let (_directory, store) = fresh();
    let breakages: [fn(&mut NewReference); 5] = [
        |new| new.descriptor.global[3] = f32::NAN,
        |new| new.descriptor.global.truncate(255),
        |new| new.descriptor.pooled[0] = 1e9,
        |new| new.descriptor.pooled.clear(),
        |new| new.descriptor.patches.counts[0] += 1,
    ];
    for breakage in breakages {
        let mut new = reference(&map("city"), 1);
        breakage(&mut new);
        assert!(matches!(
            store.insert(new),
            Err(StoreError::InvalidDescriptor { .. })
        ));
    }
    assert!(store.maps().unwrap().is_empty());
}

#[test]
fn pages_cover_everything_once_and_in_order() {
    let (_directory, store) = fresh();
    let (a, b) = (map("a"), map("b"));
    let all: Vec<ReferenceId> = (0..25)
        .map(|seed| create(&store, reference(if seed % 3 == 0 { &b } else { &a }, seed)).id)
        .collect();
    for (chosen, expected) in [(None, 25), (Some(&a), 16), (Some(&b), 9)] {
        for limit in [1, 4, 8, 9, 25, 100] {
            let (mut ids, mut after) = (Vec::new(), None);
            loop {
                let page = store.list(chosen, after, limit).unwrap();
                assert!(page.references.len() <= limit);
                ids.extend(page.references.iter().map(|reference| reference.id));
                match page.next {
                    Some(next) => after = Some(next),
                    None => break,
                }
            }
            assert!(
                ids.is_sorted() && ids.len() == expected && ids.iter().all(|id| all.contains(id))
            );
        }
    }
}

#[test]
fn fields_change_and_clear_but_never_take_anothers_external_id() {
    let (_directory, store) = fresh();
    let city = map("city");
    let first = create(&store, named_reference(&city, "first", 1));
    let second = create(&store, named_reference(&city, "second", 2));
    let cleared = ReferencePatch {
        location: Some(None),
        metadata: Some(None),
        ..ReferencePatch::default()
    };
    let changed = store.update(first.id, cleared).unwrap();
    assert_eq!(
        (changed.fields.location, &changed.fields.metadata),
        (None, &None)
    );
    assert_eq!(changed.fields.external_id, first.fields.external_id);
    assert_eq!(store.get(first.id).unwrap(), changed);
    let take = ReferencePatch {
        external_id: Some(second.fields.external_id.clone()),
        ..ReferencePatch::default()
    };
    match store.update(first.id, take) {
        Err(StoreError::ExternalIdConflict { existing, .. }) => assert_eq!(existing, second.id),
        other => panic!("{other:?}"),
    }
    store.verify().unwrap();
    assert_eq!(store.quarantined().unwrap(), []);
}

#[test]
fn numbers_come_back_as_the_bits_their_checksum_covers() {
    let (_directory, store) = fresh();
    let city = map("city");
    let first = create(&store, reference(&city, 1));
    for (lat, lon, heading) in [
        (-0.0, 0.0, -0.0),
        (0.0, -0.0, 360.0),
        (-90.0, 180.0, -1e-300),
        (5e-324, 1e-10, 359.9),
    ] {
        let location = Some(Some(GeoPoint::new(lat, lon).unwrap()));
        let patch = ReferencePatch {
            location,
            heading: Some(Some(Heading::new(heading).unwrap())),
            ..Default::default()
        };
        let changed = store.update(first.id, patch).unwrap();
        assert_eq!(
            store.get(first.id).unwrap(),
            changed,
            "{lat} {lon} {heading}"
        );
    }
    assert_eq!(store.quarantined().unwrap(), []);
}

#[test]
fn deletion_removes_every_part() {
    let (_directory, store) = fresh();
    let city = map("city");
    let kept = create(&store, reference(&city, 1));
    let gone = create(&store, named_reference(&city, "gone", 2));
    assert_eq!(store.delete(gone.id).unwrap(), gone);
    assert!(matches!(
        store.get(gone.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert!(matches!(
        store.patches(gone.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert_eq!(
        globals(&store, &city).into_keys().collect::<Vec<_>>(),
        [kept.id]
    );
    assert_eq!(store.map(&city).unwrap().references, 1);
    let again = create(&store, named_reference(&city, "gone", 3));
    assert_ne!(again.id, gone.id);
    assert_eq!(store.verify().unwrap().engine_errors, [] as [String; 0]);
}

#[test]
fn a_deleted_map_vanishes_at_once_and_its_room_is_used_again() {
    let (directory, store) = fresh();
    let (city, other) = (map("city"), map("other"));
    let new: Vec<_> = (0..300).map(|seed| reference(&city, seed)).collect();
    let created: Vec<_> = store
        .insert_many(new)
        .into_iter()
        .map(Result::unwrap)
        .collect();
    let Inserted::Created(first) = &created[0] else {
        panic!("{:?}", created[0])
    };
    create(&store, reference(&other, 1));
    assert_eq!(store.delete_map(&city).unwrap(), 300);
    assert!(matches!(
        store.get(first.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert!(matches!(
        store.delete(first.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert!(matches!(
        store.map(&city),
        Err(StoreError::MapNotFound { .. })
    ));
    // The name is free at once, also for another model.
    create(
        &store,
        NewReference {
            model: ModelId::new("another"),
            ..reference(&city, 5)
        },
    );
    drop(store);
    let store = open(&directory);
    assert_eq!(store.list(None, None, 1000).unwrap().references.len(), 2);
    let before = store.footprint().unwrap().0;
    let again: Vec<_> = (0..200)
        .map(|seed| reference(&other, 1000 + seed))
        .collect();
    assert!(store.insert_many(again).iter().all(Result::is_ok));
    drop(store);
    let store = open(&directory);
    assert!(
        store.footprint().unwrap().0 <= before + (1 << 20),
        "the freed room is not used again"
    );
    assert_eq!(store.verify().unwrap().engine_errors, [] as [String; 0]);
}

#[test]
fn readers_see_references_whole_while_writers_write() {
    let (_directory, store) = fresh();
    let city = map("city");
    create(&store, reference(&city, 0));
    std::thread::scope(|scope| {
        let writers: Vec<_> = (0..3u64)
            .map(|writer| {
                let (store, city) = (&store, &city);
                scope.spawn(move || {
                    for step in 0..40 {
                        let created = create(store, reference(city, writer * 1000 + step + 1));
                        if step % 3 == 0 {
                            store.delete(created.id).unwrap();
                        }
                    }
                })
            })
            .collect();
        while writers.iter().any(|writer| !writer.is_finished()) {
            for row in globals(&store, &city) {
                match store.patches(row.0) {
                    Ok(_) | Err(StoreError::ReferenceNotFound { .. }) => {}
                    Err(error) => panic!("{error}"),
                }
            }
        }
    });
    assert_eq!(store.quarantined().unwrap(), []);
    assert_eq!(store.map(&city).unwrap().references, 1 + 3 * 26);
    assert_eq!(store.verify().unwrap().references, 1 + 3 * 26);
}

#[test]
fn another_head_replaces_all_vectors_or_none_while_the_map_grows() {
    let (_directory, store) = fresh();
    let city = map("city");
    let new: Vec<_> = (0..700).map(|seed| reference(&city, seed)).collect();
    assert!(store.insert_many(new).iter().all(Result::is_ok));
    store
        .set_calibration(&city, Some(calibration(MODEL)))
        .unwrap();
    let old = globals(&store, &city);
    let wrong = store.replace_globals(&city, new_head("wrong"), &mut |_: &[f32]| vec![0.0; 7]);
    assert!(matches!(wrong, Err(StoreError::InvalidDescriptor { .. })));
    assert_eq!(
        (
            globals(&store, &city),
            store.map(&city).unwrap().model.as_str()
        ),
        (old, MODEL)
    );
    assert_eq!(store.head(&city).unwrap(), None);

    let mut calls = 0;
    let mut compute = |pooled: &[f32]| {
        calls += 1;
        if calls == 10 {
            create(&store, reference(&city, 9000));
            let first = store.list(Some(&city), None, 1).unwrap().references[0].id;
            store.delete(first).unwrap();
            assert!(matches!(
                store.replace_globals(&city, new_head("third"), &mut |_: &[f32]| Vec::new()),
                Err(StoreError::ReheadInProgress { .. })
            ));
        }
        pooled[..GLOBAL_DIM].to_vec()
    };
    store
        .replace_globals(&city, new_head("new"), &mut compute)
        .unwrap();
    let info = store.map(&city).unwrap();
    assert_eq!((info.model.as_str(), info.references), ("new", 700));
    assert_eq!(info.calibration, None);
    let now = globals(&store, &city);
    assert_eq!(now.len(), 700);
    let added = places::descriptor(9000, 20, 16).pooled;
    assert!(
        now.values()
            .any(|global| global.iter().zip(&added).all(|(a, b)| (a - b).abs() < 1e-3))
    );
    assert!(matches!(
        store.insert(reference(&city, 9001)),
        Err(StoreError::ModelMismatch { .. })
    ));
    let report = store.verify().unwrap();
    assert_eq!((report.damaged, report.engine_errors), (vec![], vec![]));
}

#[test]
fn a_map_keeps_its_head_until_it_gets_another_or_goes() {
    let (directory, store) = fresh();
    let (city, other) = (map("city"), map("other"));
    create(&store, reference(&city, 1));
    create(&store, reference(&other, 1));
    let mut project = |pooled: &[f32]| pooled[..GLOBAL_DIM].to_vec();
    store
        .replace_globals(&city, new_head("new"), &mut project)
        .unwrap();
    assert_eq!(
        (store.head(&city).unwrap(), store.head(&other).unwrap()),
        (new_head("new").file, None)
    );
    drop(store);
    let store = open(&directory);
    assert_eq!(store.head(&city).unwrap(), new_head("new").file);
    store
        .replace_globals(&city, new_head("newer"), &mut project)
        .unwrap();
    assert_eq!(store.head(&city).unwrap(), new_head("newer").file);
    let servers = NewHead {
        model: ModelId::new(MODEL),
        file: None,
    };
    store.replace_globals(&city, servers, &mut project).unwrap();
    assert_eq!(
        (
            store.head(&city).unwrap(),
            store.map(&city).unwrap().model.as_str()
        ),
        (None, MODEL)
    );
    store
        .replace_globals(&city, new_head("last"), &mut project)
        .unwrap();
    store.delete_map(&city).unwrap();
    assert!(matches!(
        store.head(&city),
        Err(StoreError::MapNotFound { .. })
    ));
    // What is retired is removed in the background.
    let database = directory.path().join("placeformer.db");
    let heads = || {
        let connection = rusqlite::Connection::open(&database).unwrap();
        connection
            .query_row("SELECT count(*) FROM map_head", [], |row| {
                row.get::<_, i64>(0)
            })
            .unwrap()
    };
    for _ in 0..500 {
        if heads() == 0 {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
    panic!("{} heads are left", heads());
}

#[test]
fn a_calibration_is_kept_with_its_map_and_only_if_it_is_of_its_model() {
    let (directory, store) = fresh();
    let (city, other) = (map("city"), map("other"));
    create(&store, reference(&city, 1));
    create(&store, reference(&other, 1));
    let kept = |store: &SqliteStore, map: &MapName| store.map(map).unwrap().calibration;
    assert_eq!(kept(&store, &city), None);
    store
        .set_calibration(&city, Some(calibration(MODEL)))
        .unwrap();
    match store.set_calibration(&city, Some(calibration("another"))) {
        Err(error @ StoreError::CalibrationMismatch { .. }) => {
            assert_eq!(error.code(), ErrorCode::CalibrationMismatch);
            assert!(
                error.to_string().contains(MODEL) && error.to_string().contains("another"),
                "{error}"
            );
        }
        other => panic!("{other:?}"),
    }
    drop(store);
    let store = open(&directory);
    assert_eq!(
        (kept(&store, &city), kept(&store, &other)),
        (Some(calibration(MODEL)), None)
    );
    assert_eq!(
        store.maps().unwrap()[0].calibration,
        Some(calibration(MODEL))
    );
    store.set_calibration(&city, None).unwrap();
    assert_eq!(kept(&store, &city), None);
    // Clearing what is not there is no fault.
    store.set_calibration(&city, None).unwrap();
}

#[test]
fn a_calibration_changed_on_the_disk_is_noticed() {
    let (directory, store) = fresh();
    let city = map("city");
    create(&store, reference(&city, 1));
    store
        .set_calibration(&city, Some(calibration(MODEL)))
        .unwrap();
    drop(store);
    let path = directory.path().join("placeformer.db");
    let change = |sql: &str| {
        rusqlite::Connection::open(&path)
            .unwrap()
            .execute(sql, [])
            .unwrap()
    };
    change("UPDATE map SET calibration = replace(calibration, '0.75', '0.05')");
    let store = open(&directory);
    assert!(matches!(
        store.map(&city),
        Err(StoreError::CorruptMap { .. })
    ));
    drop(store);
    change("UPDATE map SET calibration = replace(calibration, '0.05', '0.75')");
    let store = open(&directory);
    assert_eq!(
        store.map(&city).unwrap().calibration,
        Some(calibration(MODEL))
    );
}

#[test]
fn a_backup_is_a_store_of_that_moment() {
    let (directory, store) = fresh();
    let city = map("city");
    let first = create(&store, reference(&city, 1));
    let elsewhere = tempfile::tempdir().unwrap();
    let target = elsewhere.path().join("placeformer.db");
    let bytes = store.backup(&target).unwrap();
    assert_eq!(target.metadata().unwrap().len(), bytes);
    let second = create(&store, reference(&city, 2));
    assert!(matches!(
        store.backup(&target),
        Err(StoreError::BackupExists { .. })
    ));
    let copy = open(&elsewhere);
    assert_eq!(copy.get(first.id).unwrap(), first);
    assert!(matches!(
        copy.get(second.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert_eq!(copy.verify().unwrap().references, 1);
    assert!(!elsewhere.path().join("placeformer.db.partial").exists());
    drop(directory);
}

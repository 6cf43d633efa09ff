//! Maps: their model, their head, their calibration, and their end.

use crate::places::{self, MODEL, map, reference};
use crate::support::{calibration, create, database, fresh, globals, new_head, open};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{GLOBAL_DIM, MapName, ModelId, NewReference};
use placeformer_store::{
    Inserted, MaintainPlaces, NewHead, ReadPlaces, SqliteStore, StoreError, WritePlaces,
};

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
fn a_deleted_map_vanishes_at_once_and_its_room_is_used_again() {
    let (directory, store) = fresh();
    let city = map("city");
    let other = map("other");
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
    let store = open(directory.path());
    assert_eq!(store.list(None, None, 1000).unwrap().references.len(), 2);
    let before = store.footprint().unwrap().disk_bytes;
    let again: Vec<_> = (0..200)
        .map(|seed| reference(&other, 1000 + seed))
        .collect();
    assert!(store.insert_many(again).iter().all(Result::is_ok));
    drop(store);
    let store = open(directory.path());
    assert!(
        store.footprint().unwrap().disk_bytes <= before + (1 << 20),
        "the freed room is not used again"
    );
    assert_eq!(store.verify().unwrap().engine_errors, [] as [String; 0]);
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
    let city = map("city");
    let other = map("other");
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
    let store = open(directory.path());
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
    let database = database(directory.path());
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
    let city = map("city");
    let other = map("other");
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
    let store = open(directory.path());
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

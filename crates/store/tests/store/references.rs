//! Storing, finding, changing and deleting references.

use crate::places::{MODEL, map, named_reference, reference};
use crate::support::{calibration, create, database, fresh, globals, open};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{GeoPoint, Heading, NewReference, ReferenceId};
use placeformer_store::{
    Inserted, MaintainPlaces, ReadPlaces, ReferencePatch, StoreError, WritePlaces,
};
use std::collections::{BTreeMap, HashSet};

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
    let store = open(directory.path());
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
    let nowhere = map("nowhere");
    let nobody = ReferenceId::generate();
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
            let store = &store;
            let city = &city;
            let name = &name;
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
    let a = map("a");
    let b = map("b");
    let all: Vec<ReferenceId> = (0..25)
        .map(|seed| create(&store, reference(if seed % 3 == 0 { &b } else { &a }, seed)).id)
        .collect();
    for (chosen, expected) in [(None, 25), (Some(&a), 16), (Some(&b), 9)] {
        for limit in [1, 4, 8, 9, 25, 100] {
            let mut ids = Vec::new();
            let mut after = None;
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
fn readers_see_references_whole_while_writers_write() {
    let (_directory, store) = fresh();
    let city = map("city");
    create(&store, reference(&city, 0));
    std::thread::scope(|scope| {
        let writers: Vec<_> = (0..3u64)
            .map(|writer| {
                let store = &store;
                let city = &city;
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
fn a_backup_is_a_store_of_that_moment() {
    let (directory, store) = fresh();
    let city = map("city");
    let first = create(&store, reference(&city, 1));
    let elsewhere = tempfile::tempdir().unwrap();
    let target = database(elsewhere.path());
    let bytes = store.backup(&target).unwrap();
    assert_eq!(target.metadata().unwrap().len(), bytes);
    let second = create(&store, reference(&city, 2));
    assert!(matches!(
        store.backup(&target),
        Err(StoreError::BackupExists { .. })
    ));
    let copy = open(elsewhere.path());
    assert_eq!(copy.get(first.id).unwrap(), first);
    assert!(matches!(
        copy.get(second.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert_eq!(copy.verify().unwrap().references, 1);
    assert!(!elsewhere.path().join("placeformer.db.partial").exists());
    drop(directory);
}

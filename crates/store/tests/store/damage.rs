//! Damaged bytes: noticed, kept out of every answer, and healed.

use crate::places::{MODEL, map, named_reference, reference};
use crate::support::{calibration, config, create, database, fresh, open};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{GLOBAL_DIM, MapName, ModelId, NewReference, Reference};
use placeformer_store::{
    MaintainPlaces, NewHead, ReadPlaces, ReferencePatch, SqliteStore, StoreError, WritePlaces,
    codec,
};
use rand::{RngExt, SeedableRng};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

/// The head that a map keeps.
const HEAD: &[u8] = b"stands for the head that the map keeps";

/// Flips one bit in the middle of the only place where the closed database holds `bytes`.
fn flip(directory: &Path, bytes: &[u8]) {
    let mut content = fs::read(database(directory)).unwrap();
    let places: Vec<usize> = content
        .windows(bytes.len())
        .enumerate()
        .filter(|(_, window)| *window == bytes)
        .map(|(at, _)| at)
        .collect();
    assert_eq!(
        places.len(),
        1,
        "the bytes to damage are not there exactly once"
    );
    content[places[0] + bytes.len() / 2] ^= 0x10;
    fs::write(database(directory), content).unwrap();
}

/// A store of five references, the third of which has a damaged part.
struct Damaged {
    directory: TempDir,
    /// What was stored, in order.
    new: Vec<NewReference>,
    created: Vec<Reference>,
}

const VICTIM: usize = 2;

/// Stores five references, closes the store, and flips a bit in the part of one of them.
fn damaged(city: &MapName, part: &str) -> Damaged {
    let directory = tempfile::tempdir().unwrap();
    let new: Vec<_> = (0..5)
        .map(|seed| named_reference(city, &format!("photo {seed}"), seed))
        .collect();
    let store = open(directory.path());
    let created: Vec<_> = new.iter().map(|new| create(&store, new.clone())).collect();
    drop(store);
    let victim = &new[VICTIM];
    let descriptor = &victim.descriptor;
    let bytes = match part {
        "patches" => codec::encode(&descriptor.patches).unwrap()[60..100].to_vec(),
        "global" => codec::encode_f32(&descriptor.global)[..64].to_vec(),
        "pooled" => codec::encode_f16(&descriptor.pooled)[..64].to_vec(),
        "row" => victim.content_hash.0.to_vec(),
        other => panic!("there is no part {other}"),
    };
    flip(directory.path(), &bytes);
    Damaged {
        directory,
        new,
        created,
    }
}

#[test]
fn a_damaged_part_is_noticed_quarantined_and_healed_by_sending_the_image_again() {
    let city = map("city");
    for part in ["patches", "global", "pooled", "row"] {
        let damaged = damaged(&city, part);
        let victim = damaged.created[VICTIM].id;
        let store = open(damaged.directory.path());
        check_noticed(&store, &city, &damaged.created, part);
        // Known from now on, also to the next process, and out of every answer.
        drop(store);
        let store = open(damaged.directory.path());
        check_withdrawn(&store, &city, &damaged.created, part);
        let healed = create(&store, damaged.new[VICTIM].clone());
        assert_eq!(
            store.patches(healed.id).unwrap(),
            damaged.new[VICTIM].descriptor.patches,
            "{part}"
        );
        assert!(
            matches!(store.get(victim), Err(StoreError::ReferenceNotFound { .. })),
            "{part}"
        );
        assert_eq!(store.quarantined().unwrap(), [], "{part}");
        assert_eq!(store.map(&city).unwrap().references, 5, "{part}");
        assert_eq!(store.verify().unwrap().damaged, [], "{part}");
    }
}

/// The calls that read the damaged part find it, and those that do not go on.
fn check_noticed(store: &SqliteStore, city: &MapName, created: &[Reference], part: &str) {
    let victim = created[VICTIM].id;
    let mut served = Vec::new();
    store
        .scan_globals(city, &mut |row| served.push(row.reference))
        .unwrap();
    for reference in created {
        let is_expected = reference.id != victim || matches!(part, "patches" | "pooled");
        assert_eq!(served.contains(&reference.id), is_expected, "{part}");
    }
    match part {
        "patches" => assert!(matches!(
            store.patches(victim),
            Err(StoreError::CorruptRecord { .. })
        )),
        "row" => assert!(matches!(
            store.get(victim),
            Err(StoreError::CorruptRecord { .. })
        )),
        _ => {}
    }
    let report = store.verify().unwrap();
    assert_eq!((report.references, report.damaged.len()), (5, 1), "{part}");
    assert_eq!(report.damaged[0].0, victim, "{part}");
    assert_eq!(report.engine_errors, [] as [String; 0], "{part}");
}

/// The damaged reference is out of every answer, and the others are as they were.
fn check_withdrawn(store: &SqliteStore, city: &MapName, created: &[Reference], part: &str) {
    let victim = created[VICTIM].id;
    assert_eq!(store.quarantined().unwrap()[0].id, victim, "{part}");
    assert!(
        matches!(store.get(victim), Err(StoreError::CorruptRecord { .. })),
        "{part}"
    );
    assert_eq!(store.map(city).unwrap().references, 4, "{part}");
    let listed = store.list(Some(city), None, 10).unwrap().references;
    assert_eq!(listed.len(), 4, "{part}");
    for reference in created.iter().filter(|reference| reference.id != victim) {
        assert_eq!(store.get(reference.id).unwrap(), *reference, "{part}");
    }
}

#[test]
fn a_change_of_a_damaged_reference_is_a_corrupt_record_and_quarantines_it() {
    let city = map("city");
    let damaged = damaged(&city, "row");
    let victim = damaged.created[VICTIM].id;
    let store = open(damaged.directory.path());
    let error = store.update(victim, ReferencePatch::default()).unwrap_err();
    assert!(
        matches!(error, StoreError::CorruptRecord { id, .. } if id == victim),
        "{error}"
    );
    assert_eq!(error.code(), ErrorCode::CorruptRecord);
    assert_eq!(store.quarantined().unwrap()[0].id, victim);
    let found = store.drain_damage();
    assert_eq!((found.found, found.withdrawn), (1, vec![victim]));
    // The others can still be changed.
    let patch = ReferencePatch {
        metadata: Some(None),
        ..ReferencePatch::default()
    };
    let changed = store.update(damaged.created[0].id, patch).unwrap();
    assert_eq!(changed.fields.metadata, None);
}

#[test]
fn a_damaged_head_is_noticed_and_healed_by_giving_it_again() {
    let city = map("city");
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path());
    let created = create(&store, reference(&city, 1));
    let head = || NewHead {
        model: ModelId::new("new"),
        file: Some(HEAD.to_vec()),
    };
    let mut project = |pooled: &[f32]| pooled[..GLOBAL_DIM].to_vec();
    store.replace_globals(&city, head(), &mut project).unwrap();
    drop(store);
    flip(directory.path(), HEAD);
    let store = open(directory.path());
    assert!(matches!(
        store.head(&city),
        Err(StoreError::CorruptHead { .. })
    ));
    let report = store.verify().unwrap();
    assert_eq!((report.damaged.len(), report.engine_errors.len()), (0, 1));
    assert!(
        report.engine_errors[0].contains("city"),
        "{:?}",
        report.engine_errors
    );
    assert_eq!(store.get(created.id).unwrap().model.as_str(), "new");
    store.replace_globals(&city, head(), &mut project).unwrap();
    assert_eq!(store.head(&city).unwrap().as_deref(), Some(HEAD));
    assert_eq!(store.verify().unwrap().engine_errors, Vec::<String>::new());
}

#[test]
fn a_damaged_reference_can_be_deleted() {
    let city = map("city");
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path());
    let new = reference(&city, 1);
    let kept = create(&store, reference(&city, 2));
    let created = create(&store, new.clone());
    drop(store);
    flip(directory.path(), &new.content_hash.0);
    let store = open(directory.path());
    assert!(matches!(
        store.get(created.id),
        Err(StoreError::CorruptRecord { .. })
    ));
    assert_eq!(store.delete(created.id).unwrap().id, created.id);
    assert!(matches!(
        store.get(created.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert_eq!(
        (
            store.quarantined().unwrap(),
            store.map(&city).unwrap().references
        ),
        (vec![], 1)
    );
    assert_eq!(store.get(kept.id).unwrap(), kept);
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
    let path = database(directory.path());
    let change = |sql: &str| {
        rusqlite::Connection::open(&path)
            .unwrap()
            .execute(sql, [])
            .unwrap()
    };
    change("UPDATE map SET calibration = replace(calibration, '0.75', '0.05')");
    let store = open(directory.path());
    assert!(matches!(
        store.map(&city),
        Err(StoreError::CorruptMap { .. })
    ));
    drop(store);
    change("UPDATE map SET calibration = replace(calibration, '0.05', '0.75')");
    let store = open(directory.path());
    assert_eq!(
        store.map(&city).unwrap().calibration,
        Some(calibration(MODEL))
    );
}

/// What a store with one flipped bit did when it was read.
#[derive(Debug, PartialEq, Eq)]
enum Reading {
    /// It could not be opened.
    Refused,
    /// Every answer was there and right.
    Sound,
    /// Something could not be read, and verify says what is damaged.
    FoundDamaged,
}

/// Reads everything that `stored` says must be there. Whatever is answered must be right.
fn read_all(directory: &Path, stored: &[(Reference, NewReference)], what: &str) -> Reading {
    let Ok(store) = SqliteStore::open(directory, &config()) else {
        return Reading::Refused;
    };
    let mut is_complete = true;
    for (reference, new) in stored {
        match store.get(reference.id) {
            Ok(found) => assert_eq!(&found, reference, "{what}"),
            Err(_) => is_complete = false,
        }
        match store.patches(reference.id) {
            Ok(patches) => assert_eq!(patches, new.descriptor.patches, "{what}"),
            Err(_) => is_complete = false,
        }
    }
    let mut vectors = 0;
    let scanned = store.scan_globals(&map("city"), &mut |row| {
        let (_, new) = stored
            .iter()
            .find(|(reference, _)| reference.id == row.reference)
            .unwrap();
        assert_eq!(row.global, new.descriptor.global, "{what}");
        vectors += 1;
    });
    if is_complete && scanned.is_ok() && vectors == stored.len() {
        return Reading::Sound;
    }
    let is_noticed = match store.verify() {
        Ok(report) => !report.damaged.is_empty() || !report.engine_errors.is_empty(),
        Err(_) => true,
    };
    assert!(
        is_noticed,
        "{what} hides a reference and verify finds nothing"
    );
    Reading::FoundDamaged
}

#[test]
fn a_bit_flipped_anywhere_never_changes_an_answer_unnoticed() {
    let pristine = tempfile::tempdir().unwrap();
    let store = open(pristine.path());
    let stored: Vec<_> = (0..12)
        .map(|seed| {
            let new = named_reference(&map("city"), &format!("photo {seed}"), seed);
            (create(&store, new.clone()), new)
        })
        .collect();
    drop(store);
    let content = fs::read(database(pristine.path())).unwrap();
    // Only bytes that are used: a flip in an empty part of a page says nothing.
    let filled: Vec<usize> = (0..content.len()).filter(|&at| content[at] != 0).collect();
    let seed = 20_240_817;
    println!("seed {seed}");
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut refused = 0;
    let mut found = 0;
    for round in 0..120 {
        let directory = tempfile::tempdir().unwrap();
        let at = filled[random.random_range(0..filled.len())];
        let bit = random.random_range(0..8);
        let mut damaged = content.clone();
        damaged[at] ^= 1 << bit;
        fs::write(database(directory.path()), damaged).unwrap();
        let what = format!("round {round}: bit {bit} of byte {at}");
        match read_all(directory.path(), &stored, &what) {
            Reading::Refused => refused += 1,
            Reading::FoundDamaged => found += 1,
            Reading::Sound => {}
        }
    }
    println!("{refused} refused at opening, {found} found damaged");
    assert!(found > 40, "the flips hit nothing: {found}");
}

//! The store when things go wrong: killed between two writes, a full disk, flipped bits, a second
//! process.

#[path = "common/places.rs"]
mod places;
#[path = "common/small_disk.rs"]
mod small_disk;

use placeformer_core::types::{GLOBAL_DIM, MapName, ModelId, NewReference, Reference, ReferenceId};
use placeformer_store::{
    Inserted, NewHead, PlaceStore, SqliteStore, StoreConfig, StoreError, codec, crash_points,
};
use places::{MODEL, map, named_reference, reference};
use rand::{RngExt, SeedableRng};
use small_disk::SmallDisk;
use std::io::Write;
use std::path::Path;
use std::process::Command;

fn config() -> StoreConfig {
    StoreConfig {
        reserve_bytes: 1 << 20,
        ..StoreConfig::default()
    }
}

fn open(directory: &Path) -> SqliteStore {
    SqliteStore::open(directory, &config()).unwrap()
}

fn create(store: &SqliteStore, new: NewReference) -> Reference {
    match store.insert(new).unwrap() {
        Inserted::Created(reference) => reference,
        Inserted::AlreadyThere(reference) => panic!("{reference:?} was there before"),
    }
}

// ---------------------------------------------------------------- killed between two writes

const DIRECTORY: &str = "PLACEFORMER_TEST_DIRECTORY";

fn say(line: &str) {
    // Past the test harness, which captures what `println!` prints.
    std::io::stdout()
        .write_all(format!("{line}\n").as_bytes())
        .unwrap();
}

/// The head that the map gets.
const HEAD: &[u8] = b"stands for the head that the map keeps";

/// Not a test of its own: what the process does that the test below kills.
#[test]
fn child_that_writes_until_it_is_killed() {
    let Some(directory) = std::env::var_os(DIRECTORY) else {
        return;
    };
    let store = open(Path::new(&directory));
    std::thread::scope(|scope| {
        for writer in 0..4u64 {
            let store = &store;
            scope.spawn(move || {
                for step in 0..12 {
                    let seed = writer * 100 + step;
                    let created = create(
                        store,
                        named_reference(&map("lasting"), &format!("photo {seed}"), seed),
                    );
                    say(&format!("\nstored {} {seed}", created.id));
                    create(store, reference(&map("doomed"), 1000 + seed));
                }
            });
        }
    });
    say("\nrehead");
    let head = NewHead {
        model: ModelId::new("new"),
        file: Some(HEAD.to_vec()),
    };
    store
        .replace_globals(&map("lasting"), head, &mut |pooled: &[f32]| {
            pooled[..GLOBAL_DIM].to_vec()
        })
        .unwrap();
    say("\nreheaded");
    store.delete_map(&map("doomed")).unwrap();
    say("\ndeleted");
}

#[test]
fn nothing_acknowledged_is_lost_and_nothing_is_half_there_wherever_the_process_dies() {
    for &point in crash_points::ALL {
        for nth in [1, 2, 5] {
            let directory = tempfile::tempdir().unwrap();
            let output = Command::new(std::env::current_exe().unwrap())
                .args([
                    "--exact",
                    "child_that_writes_until_it_is_killed",
                    "--nocapture",
                ])
                .env(DIRECTORY, directory.path())
                .env(crash_points::VARIABLE, format!("{point}:{nth}"))
                .output()
                .unwrap();
            let said = String::from_utf8_lossy(&output.stdout).into_owned();
            if nth == 1 {
                assert!(!output.status.success(), "{point} is never reached: {said}");
            }
            check_what_is_left(directory.path(), &said, &format!("{point}:{nth}"));
        }
    }
}

fn check_what_is_left(directory: &Path, said: &str, point: &str) {
    let store = open(directory);
    for line in said.lines().filter_map(|line| line.strip_prefix("stored ")) {
        let (id, seed) = line.split_once(' ').unwrap();
        let (id, seed): (ReferenceId, u64) = (id.parse().unwrap(), seed.parse().unwrap());
        let new = named_reference(&map("lasting"), &format!("photo {seed}"), seed);
        let there = store
            .get(id)
            .unwrap_or_else(|error| panic!("{point}: {error}"));
        assert_eq!(
            (there.fields, there.content_hash),
            (new.fields, new.content_hash),
            "{point}"
        );
        assert_eq!(
            store.patches(id).unwrap(),
            new.descriptor.patches,
            "{point}"
        );
    }
    let reheaded = said.contains("reheaded");
    if let Ok(info) = store.map(&map("lasting")) {
        let mut vectors = 0;
        store
            .scan_globals(&info.name, &mut |_| vectors += 1)
            .unwrap();
        assert_eq!(vectors, info.references, "{point}");
        assert!(
            info.model.as_str() == "new" || info.model.as_str() == MODEL && !reheaded,
            "{point}: {}",
            info.model
        );
        // The head comes with the vectors that it made, whole, or neither does.
        let head = (info.model.as_str() == "new").then(|| HEAD.to_vec());
        assert_eq!(store.head(&info.name).unwrap(), head, "{point}");
    }
    assert!(
        !said.contains("\ndeleted") || store.map(&map("doomed")).is_err(),
        "{point}"
    );
    for reference in store.list(None, None, 10_000).unwrap().references {
        store
            .patches(reference.id)
            .unwrap_or_else(|error| panic!("{point}: {error}"));
    }
    let report = store.verify().unwrap();
    assert_eq!(
        (report.damaged, report.engine_errors),
        (vec![], vec![]),
        "{point}"
    );
    // And it still takes writes.
    let model = store
        .map(&map("lasting"))
        .map_or(ModelId::new(MODEL), |info| info.model);
    create(
        &store,
        NewReference {
            model,
            ..reference(&map("lasting"), 99_999)
        },
    );
}

// ---------------------------------------------------------------- a full disk

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
    let (city, other) = (map("city"), map("other"));
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

// ---------------------------------------------------------------- flipped bits

fn database(directory: &Path) -> std::path::PathBuf {
    directory.join("placeformer.db")
}

/// Flips one bit in the middle of the only place where the closed database holds `bytes`.
fn flip(directory: &Path, bytes: &[u8]) {
    let mut content = std::fs::read(database(directory)).unwrap();
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
    std::fs::write(database(directory), content).unwrap();
}

#[test]
fn a_damaged_part_is_noticed_quarantined_and_healed_by_sending_the_image_again() {
    let city = map("city");
    let new: Vec<_> = (0..5)
        .map(|seed| named_reference(&city, &format!("photo {seed}"), seed))
        .collect();
    let victim = &new[2];
    let parts: [(&str, Vec<u8>); 4] = [
        (
            "patches",
            codec::encode(&victim.descriptor.patches).unwrap()[60..100].to_vec(),
        ),
        (
            "global",
            codec::encode_f32(&victim.descriptor.global)[..64].to_vec(),
        ),
        (
            "pooled",
            codec::encode_f16(&victim.descriptor.pooled)[..64].to_vec(),
        ),
        ("row", victim.content_hash.0.to_vec()),
    ];
    for (part, bytes) in parts {
        let directory = tempfile::tempdir().unwrap();
        let store = open(directory.path());
        let created: Vec<_> = new.iter().map(|new| create(&store, new.clone())).collect();
        drop(store);
        flip(directory.path(), &bytes);
        let store = open(directory.path());
        let mut served = Vec::new();
        store
            .scan_globals(&city, &mut |row| served.push(row.reference))
            .unwrap();
        assert!(
            created
                .iter()
                .filter(|c| c.id != created[2].id)
                .all(|c| served.contains(&c.id)),
            "{part}"
        );
        assert_eq!(
            served.contains(&created[2].id),
            matches!(part, "patches" | "pooled"),
            "{part}"
        );
        match part {
            "patches" => assert!(matches!(
                store.patches(created[2].id),
                Err(StoreError::Corrupt { .. })
            )),
            "row" => assert!(matches!(
                store.get(created[2].id),
                Err(StoreError::Corrupt { .. })
            )),
            _ => {}
        }
        let report = store.verify().unwrap();
        assert_eq!((report.references, report.damaged.len()), (5, 1), "{part}");
        assert_eq!(
            (report.damaged[0].0, report.engine_errors),
            (created[2].id, vec![]),
            "{part}"
        );
        // Known from now on, also to the next process, and out of every answer.
        drop(store);
        let store = open(directory.path());
        assert_eq!(store.quarantined().unwrap()[0].id, created[2].id, "{part}");
        assert!(
            matches!(store.get(created[2].id), Err(StoreError::Corrupt { .. })),
            "{part}"
        );
        assert_eq!(store.map(&city).unwrap().references, 4, "{part}");
        let listed = store.list(Some(&city), None, 10).unwrap().references;
        assert_eq!(listed.len(), 4, "{part}");
        for other in [0, 1, 3, 4] {
            assert_eq!(
                store.get(created[other].id).unwrap(),
                created[other],
                "{part}"
            );
        }
        let healed = create(&store, victim.clone());
        assert_eq!(
            store.patches(healed.id).unwrap(),
            victim.descriptor.patches,
            "{part}"
        );
        assert!(
            matches!(
                store.get(created[2].id),
                Err(StoreError::ReferenceNotFound { .. })
            ),
            "{part}"
        );
        assert_eq!(
            (
                store.quarantined().unwrap(),
                store.map(&city).unwrap().references
            ),
            (vec![], 5),
            "{part}"
        );
        assert_eq!(store.verify().unwrap().damaged, [], "{part}");
    }
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
    let (new, kept) = (reference(&city, 1), create(&store, reference(&city, 2)));
    let created = create(&store, new.clone());
    drop(store);
    flip(directory.path(), &new.content_hash.0);
    let store = open(directory.path());
    assert!(matches!(
        store.get(created.id),
        Err(StoreError::Corrupt { .. })
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
fn a_bit_flipped_anywhere_never_changes_an_answer_unnoticed() {
    let city = map("city");
    let pristine = tempfile::tempdir().unwrap();
    let store = open(pristine.path());
    let stored: Vec<_> = (0..12)
        .map(|seed| {
            let new = named_reference(&city, &format!("photo {seed}"), seed);
            (create(&store, new.clone()), new)
        })
        .collect();
    drop(store);
    let content = std::fs::read(database(pristine.path())).unwrap();
    // Only where there is something: a flip in an empty part of a page says nothing.
    let filled: Vec<usize> = (0..content.len()).filter(|&at| content[at] != 0).collect();
    let seed = 20_240_817;
    println!("seed {seed}");
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let (mut refused, mut found) = (0, 0);
    for round in 0..120 {
        let directory = tempfile::tempdir().unwrap();
        let (at, bit) = (
            filled[random.random_range(0..filled.len())],
            random.random_range(0..8),
        );
        let mut damaged = content.clone();
        damaged[at] ^= 1 << bit;
        std::fs::write(database(directory.path()), damaged).unwrap();
        let Ok(store) = SqliteStore::open(directory.path(), &config()) else {
            refused += 1;
            continue;
        };
        let mut unserved = 0;
        for (reference, new) in &stored {
            let what = format!("round {round}: bit {bit} of byte {at}");
            match store.get(reference.id) {
                Ok(there) => assert_eq!(&there, reference, "{what}"),
                Err(_) => unserved += 1,
            }
            match store.patches(reference.id) {
                Ok(patches) => assert_eq!(patches, new.descriptor.patches, "{what}"),
                Err(_) => unserved += 1,
            }
        }
        let mut vectors = 0;
        let scanned = store.scan_globals(&city, &mut |row| {
            let (_, new) = stored
                .iter()
                .find(|(reference, _)| reference.id == row.reference)
                .unwrap();
            assert_eq!(
                row.global, new.descriptor.global,
                "round {round}: bit {bit} of byte {at}"
            );
            vectors += 1;
        });
        if unserved > 0 || scanned.is_err() || vectors < stored.len() {
            found += 1;
            let noticed = store.verify().map_or(true, |report| {
                !report.damaged.is_empty() || !report.engine_errors.is_empty()
            });
            assert!(
                noticed,
                "round {round}: bit {bit} of byte {at} hides a reference and verify finds nothing"
            );
        }
    }
    println!("{refused} refused at opening, {found} found damaged");
    assert!(found > 40, "the flips hit nothing: {found}");
}

// ---------------------------------------------------------------- a second process, a newer
// release

#[test]
fn a_second_opening_is_refused_and_says_who_holds_the_directory() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path());
    match SqliteStore::open(directory.path(), &config()) {
        Err(error @ StoreError::Locked { .. }) => {
            assert!(
                error
                    .to_string()
                    .contains(&format!("process {}", std::process::id())),
                "{error}"
            );
        }
        other => panic!("{:?}", other.err()),
    }
    drop(store);
    open(directory.path());
}

#[test]
fn a_database_of_a_newer_release_is_refused_untouched() {
    let directory = tempfile::tempdir().unwrap();
    drop(open(directory.path()));
    let connection = rusqlite::Connection::open(database(directory.path())).unwrap();
    connection
        .execute(
            "INSERT INTO schema_migration (version, name, checksum) VALUES (99, 'x', 0)",
            [],
        )
        .unwrap();
    connection.close().unwrap();
    let error = SqliteStore::open(directory.path(), &config())
        .err()
        .unwrap();
    assert!(
        matches!(error, StoreError::SchemaTooNew { found: 99, .. }),
        "{error}"
    );
}

//! Commits that vanish from the disk while no process has the store open: either everything that
//! was acknowledged is there, or the store says that it is not.

#[cfg(feature = "crash-points")]
use crate::killed::{Child, check_acknowledged};
use crate::places::{map, named_reference};
use crate::support::{create, database};
use placeformer_core::files::with_suffix;
use placeformer_store::{
    LostTail, MaintainPlaces, ReadPlaces, SqliteStore, StoreConfig, StoreError, WritePlaces,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const MARK: &str = "commit-mark";

/// A log that is long enough for all that these tests write, so that none of it is folded.
fn config() -> StoreConfig {
    StoreConfig {
        reserve_bytes: 16 << 20,
        ..StoreConfig::default()
    }
}

fn open(directory: &Path) -> SqliteStore {
    SqliteStore::open(directory, &config()).unwrap()
}

fn fresh() -> (TempDir, SqliteStore) {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path());
    (directory, store)
}

fn log(directory: &Path) -> PathBuf {
    with_suffix(&database(directory), "-wal")
}

/// What a killed process leaves: a copy of the files of a store that is open.
fn killed_with(references: u64) -> TempDir {
    let (directory, store) = fresh();
    for seed in 0..references {
        create(
            &store,
            named_reference(&map("city"), &seed.to_string(), seed),
        );
    }
    copy_of(directory.path())
}

fn copy_of(directory: &Path) -> TempDir {
    let copy = tempfile::tempdir().unwrap();
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        // The index of the log is rebuilt, as it is after a power cut.
        if !path.to_string_lossy().ends_with("-shm") {
            fs::copy(&path, copy.path().join(path.file_name().unwrap())).unwrap();
        }
    }
    copy
}

fn refusal(directory: &Path) -> StoreError {
    match SqliteStore::open(directory, &config()) {
        Err(error) => error,
        Ok(_) => panic!("the store opened"),
    }
}

fn truncate(path: &Path, bytes: u64) {
    let file = OpenOptions::new().write(true).open(path).unwrap();
    file.set_len(bytes).unwrap();
}

#[test]
fn a_copy_of_the_whole_directory_opens_with_everything() {
    let copy = killed_with(5);
    let store = open(copy.path());
    assert_eq!(store.map(&map("city")).unwrap().references, 5);
    assert_eq!(store.verify().unwrap().engine_errors, [""; 0]);
}

#[test]
fn a_deleted_log_is_noticed_and_named() {
    let copy = killed_with(5);
    fs::remove_file(log(copy.path())).unwrap();
    let before = fs::read(database(copy.path())).unwrap();
    for _ in 0..2 {
        match refusal(copy.path()) {
            error @ StoreError::LostCommits {
                lost: 5,
                marked: 5,
                references: 5,
                ..
            } => assert!(error.to_string().contains("--accept-lost-tail"), "{error}"),
            other => panic!("{other:?}"),
        }
        // What is refused stays as it is.
        assert_eq!(fs::read(database(copy.path())).unwrap(), before);
    }
}

#[test]
fn what_is_lost_can_be_given_up_and_its_numbers_are_not_used_again() {
    let copy = killed_with(5);
    fs::remove_file(log(copy.path())).unwrap();
    let store = SqliteStore::open_with(copy.path(), &config(), LostTail::Accept).unwrap();
    assert!(store.map(&map("city")).is_err());
    create(&store, named_reference(&map("city"), "new", 77));
    drop(store);
    let store = open(copy.path());
    assert_eq!(store.map(&map("city")).unwrap().references, 1);
    assert_eq!(store.verify().unwrap().engine_errors, [""; 0]);
    drop(store);
    let next: i64 = rusqlite::Connection::open(database(copy.path()))
        .unwrap()
        .query_row(
            "SELECT next FROM sequence WHERE name = 'reference'",
            [],
            |row| row.get(0),
        )
        .unwrap();
    assert_eq!(next, 7, "five numbers are lost and one is taken");
}

#[test]
fn a_log_cut_anywhere_loses_nothing_unnoticed() {
    let seed = 20_261_128;
    println!("seed {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let pristine = killed_with(6);
    let length = fs::metadata(log(pristine.path())).unwrap().len();
    let mut cuts: Vec<u64> = (0..24).map(|_| random.random_range(0..length)).collect();
    cuts.extend([0, 1, 32, length - 1]);
    for cut in cuts {
        let copy = copy_of(pristine.path());
        truncate(&log(copy.path()), cut);
        assert!(
            matches!(refusal(copy.path()), StoreError::LostCommits { .. }),
            "cut at {cut} of {length}"
        );
        // Given up, the rest is whole.
        let store = SqliteStore::open_with(copy.path(), &config(), LostTail::Accept).unwrap();
        let report = store.verify().unwrap();
        assert_eq!(
            (report.damaged, report.engine_errors),
            (vec![], vec![]),
            "{cut}"
        );
    }
}

#[test]
fn an_older_database_in_its_place_is_noticed() {
    let (directory, store) = fresh();
    create(&store, named_reference(&map("city"), "0", 0));
    let older = copy_of(directory.path());
    create(&store, named_reference(&map("city"), "1", 1));
    let newer = copy_of(directory.path());
    for name in ["placeformer.db", "placeformer.db-wal"] {
        fs::copy(older.path().join(name), newer.path().join(name)).unwrap();
    }
    let error = refusal(newer.path());
    assert!(
        matches!(error, StoreError::LostCommits { lost: 1, .. }),
        "{error}"
    );
}

#[test]
fn a_deleted_database_is_not_made_anew_in_silence() {
    let copy = killed_with(2);
    fs::remove_file(log(copy.path())).unwrap();
    fs::remove_file(database(copy.path())).unwrap();
    assert!(matches!(
        refusal(copy.path()),
        StoreError::LostCommits { lost: 2, .. }
    ));
    assert!(!database(copy.path()).exists());
}

#[test]
fn a_mark_that_is_gone_damaged_or_of_another_store_is_named() {
    let gone = killed_with(2);
    fs::remove_file(gone.path().join(MARK)).unwrap();
    let damaged = killed_with(2);
    truncate(&damaged.path().join(MARK), 20);
    let other = killed_with(2);
    let stranger = killed_with(1);
    fs::copy(stranger.path().join(MARK), other.path().join(MARK)).unwrap();
    for (copy, expected) in [
        (gone, "is missing"),
        (damaged, "is damaged"),
        (other, "another store"),
    ] {
        let error = refusal(copy.path());
        assert!(
            matches!(error, StoreError::NoCommitMark { .. }),
            "{error:?}"
        );
        assert!(error.to_string().contains(expected), "{error}");
        let store = SqliteStore::open_with(copy.path(), &config(), LostTail::Accept).unwrap();
        assert_eq!(store.map(&map("city")).unwrap().references, 2);
        create(&store, named_reference(&map("city"), "more", 9));
        drop(store);
        open(copy.path());
    }
}

#[test]
fn a_store_of_a_release_without_marks_opens_and_gets_one() {
    let copy = killed_with(3);
    drop(open(copy.path()));
    let connection = rusqlite::Connection::open(database(copy.path())).unwrap();
    connection
        .execute_batch(
            "DELETE FROM sequence WHERE name IN ('commit', 'store', 'closed');
             DELETE FROM schema_migration WHERE version = 3",
        )
        .unwrap();
    connection.close().unwrap();
    fs::remove_file(copy.path().join(MARK)).unwrap();
    let store = open(copy.path());
    assert_eq!(store.map(&map("city")).unwrap().references, 3);
    create(&store, named_reference(&map("city"), "new", 9));
    let killed = copy_of(copy.path());
    drop(store);
    fs::remove_file(log(killed.path())).unwrap();
    assert!(matches!(
        refusal(killed.path()),
        StoreError::LostCommits { lost: 1, .. }
    ));
}

#[test]
fn a_backup_takes_the_place_of_a_newer_store() {
    let (directory, store) = fresh();
    create(&store, named_reference(&map("city"), "0", 0));
    let backups = tempfile::tempdir().unwrap();
    let backup = backups.path().join("backup");
    store.backup(&backup).unwrap();
    create(&store, named_reference(&map("city"), "1", 1));
    let killed = copy_of(directory.path());
    drop(store);

    // Beside the log of the newer database it would be changed by that log.
    fs::copy(&backup, database(killed.path())).unwrap();
    let error = refusal(killed.path());
    assert!(matches!(error, StoreError::ForeignLog { .. }), "{error}");
    fs::remove_file(log(killed.path())).unwrap();
    let store = open(killed.path());
    assert_eq!(store.map(&map("city")).unwrap().references, 1);
    create(&store, named_reference(&map("city"), "2", 2));
    drop(store);
    open(killed.path());

    // In a directory of its own it needs nothing else.
    let restored = tempfile::tempdir().unwrap();
    fs::copy(&backup, database(restored.path())).unwrap();
    assert_eq!(
        open(restored.path()).map(&map("city")).unwrap().references,
        1
    );
}

#[test]
fn no_backup_is_made_of_a_store_that_has_lost_commits() {
    let copy = killed_with(4);
    fs::remove_file(log(copy.path())).unwrap();
    let backups = tempfile::tempdir().unwrap();
    let target = backups.path().join("backup");
    let error = SqliteStore::backup_of(copy.path(), &config(), &target).unwrap_err();
    assert!(matches!(error, StoreError::LostCommits { .. }), "{error}");
    assert_eq!(fs::read_dir(backups.path()).unwrap().count(), 0);
    // Of a store that was killed and is whole, one is.
    let whole = killed_with(4);
    SqliteStore::backup_of(whole.path(), &config(), &target).unwrap();
    let restored = tempfile::tempdir().unwrap();
    fs::copy(&target, database(restored.path())).unwrap();
    assert_eq!(
        open(restored.path()).map(&map("city")).unwrap().references,
        4
    );
}

#[test]
fn a_closed_store_needs_no_log() {
    let (directory, store) = fresh();
    create(&store, named_reference(&map("city"), "0", 0));
    store.delete_map(&map("city")).unwrap();
    drop(store);
    let log = log(directory.path());
    if log.exists() {
        fs::remove_file(log).unwrap();
    }
    open(directory.path());
}

#[test]
fn the_database_of_a_closed_store_is_whole_by_itself_and_that_of_an_open_one_is_not() {
    let (directory, store) = fresh();
    create(&store, named_reference(&map("city"), "0", 0));
    create(&store, named_reference(&map("city"), "1", 1));
    drop(store);
    let alone = tempfile::tempdir().unwrap();
    fs::copy(database(directory.path()), database(alone.path())).unwrap();
    let store = open(alone.path());
    assert_eq!(store.map(&map("city")).unwrap().references, 2);
    create(&store, named_reference(&map("city"), "2", 2));
    let killed = copy_of(alone.path());
    drop(store);
    // Even without a mark and without a log it does not pass for a closed one.
    fs::remove_file(log(killed.path())).unwrap();
    fs::remove_file(killed.path().join(MARK)).unwrap();
    let error = refusal(killed.path());
    assert!(matches!(error, StoreError::NoCommitMark { .. }), "{error}");
}

#[test]
#[cfg(feature = "crash-points")]
fn wherever_the_process_dies_a_cut_log_is_told_or_costs_nothing() {
    let seed = 20_261_129;
    println!("seed {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut told, mut whole) = (0, 0);
    for &point in placeformer_store::crash_points::ALL {
        let directory = tempfile::tempdir().unwrap();
        let armed = format!("{point}:{}", random.random_range(1..4));
        let printed = Child::run(directory.path(), &armed);
        let length = fs::metadata(log(directory.path())).map_or(0, |log| log.len());
        for cut in [
            None,
            Some(0),
            Some(random.random_range(0..=length)),
            Some(length),
        ] {
            let copy = copy_of(directory.path());
            match cut {
                _ if length == 0 => {}
                None => fs::remove_file(log(copy.path())).unwrap(),
                Some(bytes) => truncate(&log(copy.path()), bytes),
            }
            match SqliteStore::open(copy.path(), &config()) {
                Ok(store) => {
                    check_acknowledged(&store, &printed, &armed);
                    whole += 1;
                }
                Err(StoreError::LostCommits { .. } | StoreError::NoCommitMark { .. }) => {
                    assert_ne!(cut, Some(length), "{armed}: nothing was cut");
                    told += 1;
                }
                Err(other) => panic!("{armed}, cut to {cut:?} of {length}: {other}"),
            }
        }
    }
    assert!(told > 0 && whole > 0, "told {told}, whole {whole}");
}

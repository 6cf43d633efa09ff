//! Opening a store that another process uses, or that a newer release wrote.

use crate::places::{map, reference};
use crate::support::{config, create, database, open};
use placeformer_store::{MaintainPlaces, SqliteStore, StoreError};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

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

/// The usual umask lets others read what a program makes, so that the modes show whose work they
/// are.
#[test]
fn only_owner_and_group_can_read_what_the_store_makes() {
    let folder = tempfile::tempdir().unwrap();
    let directory = folder.path().join("data");
    let backup = folder.path().join("copy.db");
    let store = open(&directory);
    create(&store, reference(&map("city"), 1));
    store.backup(&backup).unwrap();
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o7777;
    assert_eq!(mode(&directory), 0o750);
    let mut names = Vec::new();
    for entry in std::fs::read_dir(&directory).unwrap() {
        let path = entry.unwrap().path();
        assert_eq!(mode(&path), 0o640, "{}", path.display());
        names.push(path.file_name().unwrap().to_string_lossy().into_owned());
    }
    for expected in [
        "placeformer.db",
        "placeformer.db-wal",
        "placeformer.db-shm",
        "reserve",
    ] {
        assert!(
            names.iter().any(|name| name == expected),
            "{expected} is not in {names:?}"
        );
    }
    assert_eq!(mode(&backup), 0o640);
}

//! Opening a store that another process uses, or that a newer release wrote.

use crate::support::{config, database, open};
use placeformer_store::{SqliteStore, StoreError};

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

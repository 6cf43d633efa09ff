use super::*;
use crate::config::StoreConfig;
use crate::sqlite::SqliteStore;
use crate::{Inserted, MaintainPlaces, ReadPlaces, WritePlaces};
use placeformer_core::types::{
    Descriptor, GLOBAL_DIM, NewReference, PackedPatches, PatchGrid, PoolingStride,
};
use tempfile::TempDir;

/// A reference without any fields.
pub(in crate::sqlite) fn new_reference() -> NewReference {
    let patches = PackedPatches {
        grid: PatchGrid {
            columns: 8,
            rows: 6,
            patch_px: 14,
            stride: PoolingStride::Kernel,
        },
        dim: 4,
        counts: [1, 0, 0],
        index: vec![3],
        attention: vec![half::f16::ONE],
        factor: vec![0.5],
        codes: vec![1, 2, 3, 4],
    };
    NewReference {
        map: "city".parse().unwrap(),
        fields: ReferenceFields::default(),
        content_hash: ContentHash::of(b"photo"),
        model: ModelId::new("model"),
        descriptor: Descriptor {
            global: vec![0.0625; GLOBAL_DIM],
            pooled: vec![1.0, 0.0],
            patches,
        },
    }
}

/// A closed store with one reference.
fn store_with_one() -> (TempDir, ReferenceId) {
    let directory = tempfile::tempdir().unwrap();
    let store = SqliteStore::open(directory.path(), &config()).unwrap();
    let Inserted::Created(reference) = store.insert(new_reference()).unwrap() else {
        panic!("the store was empty");
    };
    (directory, reference.id)
}

pub(in crate::sqlite) fn config() -> StoreConfig {
    StoreConfig {
        reserve_bytes: 1 << 20,
        ..StoreConfig::default()
    }
}

pub(in crate::sqlite) fn connect(directory: &TempDir) -> Connection {
    Connection::open(directory.path().join(SqliteStore::DATABASE)).unwrap()
}

#[test]
fn an_update_of_a_row_that_fails_its_checksum_is_a_corrupt_record() {
    let (directory, id) = store_with_one();
    let connection = connect(&directory);
    connection
        .execute("UPDATE reference SET lat = 1.0, lon = 2.0", [])
        .unwrap();
    let error = update(&connection, id, ReferencePatch::default()).unwrap_err();
    assert!(
        matches!(error, StoreError::CorruptRecord { id: named, .. } if named == id),
        "{error}"
    );
}

#[test]
fn an_update_of_a_row_with_an_impossible_value_is_a_corrupt_record() {
    let (directory, id) = store_with_one();
    let connection = connect(&directory);
    let number = locate(&connection, id).unwrap().number;
    // Written with the checksum of its content, as a defective release might.
    let mut row = read_by_number(&connection, number, |columns, row| columns.read(row))
        .unwrap()
        .unwrap();
    row.lat = Some(500.0);
    row.lon = Some(0.0);
    row.write(&connection).unwrap();
    let error = update(&connection, id, ReferencePatch::default()).unwrap_err();
    assert!(
        matches!(error, StoreError::CorruptRecord { id: named, .. } if named == id),
        "{error}"
    );
}

#[test]
fn a_conflict_names_the_reference_that_has_the_external_id() {
    let (directory, id) = store_with_one();
    let store = SqliteStore::open(directory.path(), &config()).unwrap();
    let mut named = new_reference();
    named.fields.external_id = Some("x".parse().unwrap());
    let Inserted::Created(owner) = store.insert(named).unwrap() else {
        panic!("the external id was free");
    };
    drop(store);
    let connection = connect(&directory);
    // The owner's own row is damaged, and is named all the same.
    connection
        .execute(
            "UPDATE reference SET heading = 1.0 WHERE external_id = 'x'",
            [],
        )
        .unwrap();
    let patch = ReferencePatch {
        external_id: Some(owner.fields.external_id),
        ..ReferencePatch::default()
    };
    match update(&connection, id, patch) {
        Err(StoreError::ExternalIdConflict { existing, .. }) => assert_eq!(existing, owner.id),
        other => panic!("{other:?}"),
    }
}

/// Changes the row of a reference in a closed store, as another release would have written it.
pub(in crate::sqlite) fn rewrite(
    directory: &TempDir,
    id: ReferenceId,
    change: impl FnOnce(&mut ReferenceRow),
) {
    let connection = connect(directory);
    let number = locate(&connection, id).unwrap().number;
    let row = read_by_number(&connection, number, |columns, row| columns.read(row));
    let mut row = row.unwrap().unwrap();
    change(&mut row);
    connection
        .execute(
            "UPDATE reference SET id = ?1, captured_at = ?2, metadata = ?3, checksum = ?4
             WHERE number = ?5",
            (
                row.id.as_slice(),
                row.captured_at,
                &row.metadata,
                row.checksum(),
                number,
            ),
        )
        .unwrap();
}

#[test]
fn a_time_that_an_earlier_release_stored_beyond_the_years_is_read_as_the_nearest() {
    let (directory, id) = store_with_one();
    // 0000-01-01T00:00:00+23:59, in UTC.
    let beyond = Timestamp::EARLIEST.unix_micros() - (23 * 60 + 59) * 60 * 1_000_000;
    rewrite(&directory, id, |row| row.captured_at = Some(beyond));
    let store = SqliteStore::open(directory.path(), &config()).unwrap();
    let city = "city".parse().unwrap();
    let expected = Some(Timestamp::EARLIEST);
    assert_eq!(store.get(id).unwrap().fields.captured_at, expected);
    let listed = store.list(Some(&city), None, 10).unwrap().references;
    assert_eq!(listed[0].fields.captured_at, expected);
    let mut scanned = Vec::new();
    store
        .scan_globals(&city, &mut |row| scanned.push(row.captured_at))
        .unwrap();
    assert_eq!(scanned, [expected]);
    assert_eq!(store.verify().unwrap().damaged, []);
    let changed = store.update(id, ReferencePatch::default()).unwrap();
    assert_eq!(changed.fields.captured_at, expected);
    assert_eq!(store.quarantined().unwrap(), []);
}

#[test]
fn metadata_that_an_earlier_release_stored_is_still_read() {
    let (directory, id) = store_with_one();
    let deep = format!("{{\"a\":{}1{}}}", "[".repeat(120), "]".repeat(120));
    rewrite(&directory, id, |row| row.metadata = Some(deep.clone()));
    let store = SqliteStore::open(directory.path(), &config()).unwrap();
    assert_eq!(
        store.get(id).unwrap().fields.metadata.unwrap().as_str(),
        deep
    );
}

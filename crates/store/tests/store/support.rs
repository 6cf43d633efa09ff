//! What every test of the store starts from.

use placeformer_core::types::{
    Calibration, ConfidenceCurve, ConfidenceWeights, MapName, ModelId, NewReference, Reference,
    ReferenceId, RerankId,
};
use placeformer_store::{Inserted, NewHead, ReadPlaces, SqliteStore, StoreConfig, WritePlaces};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A store with a small reserve, so that it opens fast.
pub fn config() -> StoreConfig {
    StoreConfig {
        reserve_bytes: 1 << 20,
        ..StoreConfig::default()
    }
}

/// Opens the store in a directory.
pub fn open(directory: &Path) -> SqliteStore {
    SqliteStore::open(directory, &config()).unwrap()
}

/// A new store in a directory of its own.
pub fn fresh() -> (TempDir, SqliteStore) {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path());
    (directory, store)
}

/// The path of a store's database.
pub fn database(directory: &Path) -> PathBuf {
    directory.join(SqliteStore::DATABASE)
}

/// Stores a reference that must be new.
pub fn create(store: &SqliteStore, new: NewReference) -> Reference {
    match store.insert(new).unwrap() {
        Inserted::Created(reference) => reference,
        Inserted::AlreadyThere(reference) => panic!("{reference:?} was there before"),
    }
}

/// A calibration for `model`.
pub fn calibration(model: &str) -> Calibration {
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

/// Every global vector of a map, each of which must be visited once.
pub fn globals(store: &SqliteStore, map: &MapName) -> BTreeMap<ReferenceId, Vec<f32>> {
    let mut rows = BTreeMap::new();
    store
        .scan_globals(map, &mut |row| {
            assert!(rows.insert(row.reference, row.global).is_none())
        })
        .unwrap();
    rows
}

/// A head that a map is to keep.
pub fn new_head(model: &str) -> NewHead {
    NewHead {
        model: ModelId::new(model),
        file: Some(format!("the head of {model}").into_bytes()),
    }
}

//! Where a downloaded weights file came from, and which SHA-256 it must have.
//!
//! The record of `<file>` is the JSON file `<file>.json` next to it. Weights that a user brings
//! have no record; of those only the names and shapes of the tensors are checked.

use super::error::ExtractError;
use placeformer_core::files::{hash_file, with_suffix, write_atomically};
use serde::{Deserialize, Serialize};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Origin and hash of a weights file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Record {
    /// Name of the preset that the weights belong to.
    pub preset: String,
    /// Where the weights were downloaded, and how they were converted.
    pub source: String,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
    /// Length of the file in bytes.
    pub bytes: u64,
}

impl Record {
    /// The record's path for the weights at `weights`.
    pub fn path(weights: &Path) -> PathBuf {
        with_suffix(weights, ".json")
    }

    /// The record of `weights`, if there is one.
    ///
    /// # Errors
    /// A record that is there but cannot be read or understood.
    pub fn load(weights: &Path) -> Result<Option<Self>, ExtractError> {
        let path = Self::path(weights);
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(ExtractError::io(path)(error)),
        };
        match serde_json::from_slice(&bytes) {
            Ok(record) => Ok(Some(record)),
            Err(error) => Err(ExtractError::BadFile {
                path,
                reason: format!("not a record of weights: {error}"),
            }),
        }
    }

    /// Writes the record of `weights`. The file appears complete or not at all.
    ///
    /// # Errors
    /// [`ExtractError::Io`] if it cannot be written.
    pub fn save(&self, weights: &Path) -> Result<(), ExtractError> {
        let path = Self::path(weights);
        let json = serde_json::to_vec_pretty(self);
        let bytes = json.map_err(|error| ExtractError::BadFile {
            path: path.clone(),
            reason: error.to_string(),
        })?;
        write_atomically(&path, &bytes).map_err(ExtractError::io(path))
    }
}

/// Checks the bytes of `weights` against their record, and returns it; `None` if there is no record
/// to check against.
///
/// # Errors
/// [`ExtractError::HashMismatch`] if the bytes are not those that were downloaded; otherwise files
/// that cannot be read.
pub fn verify(weights: &Path) -> Result<Option<Record>, ExtractError> {
    let Some(record) = Record::load(weights)? else {
        return Ok(None);
    };
    let actual = hash_file(weights).map_err(ExtractError::io(weights))?;
    if actual != record.sha256 {
        return Err(ExtractError::HashMismatch {
            path: weights.to_owned(),
            expected: record.sha256,
            actual,
        });
    }
    Ok(Some(record))
}

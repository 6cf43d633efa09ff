//! What is known about a fetched weights file: where it came from and the SHA-256 it must have.
//!
//! Kept beside the file as `<file>.json`. Weights that someone brings along have none and are
//! checked by names and shapes only.

use super::error::ExtractError;
use placeformer_core::files::{hash_file, with_suffix, write_atomically};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Where a weights file came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Record {
    /// Preset whose weights they are.
    pub preset: String,
    /// Where they were fetched, and how they were converted.
    pub source: String,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
    /// Length of the file.
    pub bytes: u64,
}

impl Record {
    /// The record's path for the weights at `weights`.
    pub fn path(weights: &Path) -> PathBuf {
        with_suffix(weights, ".json")
    }

    /// The record of `weights`, if there is one.
    pub fn load(weights: &Path) -> Result<Option<Self>, ExtractError> {
        let path = Self::path(weights);
        match std::fs::read(&path) {
            Ok(bytes) => match serde_json::from_slice(&bytes) {
                Ok(record) => Ok(Some(record)),
                Err(e) => Err(ExtractError::BadFile {
                    path,
                    reason: format!("not a record of weights: {e}"),
                }),
            },
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(ExtractError::io(path)(e)),
        }
    }

    /// Writes the record beside `weights`, atomically.
    pub fn save(&self, weights: &Path) -> Result<(), ExtractError> {
        let path = Self::path(weights);
        let bytes = serde_json::to_vec_pretty(self).map_err(|e| ExtractError::BadFile {
            path: path.clone(),
            reason: e.to_string(),
        })?;
        write_atomically(&path, &bytes).map_err(ExtractError::io(path))
    }
}

/// Refuses weights whose bytes are not those of their record.
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

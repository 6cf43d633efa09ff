//! What reading any row takes: its errors, its checksum, and the types that the engine lacks.

use super::engine::{damage, failed};
use crate::error::StoreError;
use placeformer_core::types::{ReferenceId, Timestamp};
use rusqlite::{Row, RowIndex};

/// Why a row could not be read.
#[derive(Debug)]
pub(super) enum RowError {
    /// Its content is not what was written; says what is wrong.
    Damaged(String),
    /// The engine failed for another reason.
    Engine(rusqlite::Error),
}

impl From<rusqlite::Error> for RowError {
    fn from(error: rusqlite::Error) -> Self {
        match damage(&error) {
            Some(reason) => Self::Damaged(reason),
            None => Self::Engine(error),
        }
    }
}

impl RowError {
    /// Damage, described by the error of the type that refused the value.
    pub(super) fn damaged(error: impl std::fmt::Display) -> Self {
        Self::Damaged(error.to_string())
    }

    /// The error of an operation on reference `id` that was doing `context`.
    pub(super) fn of_reference(self, id: ReferenceId, context: &'static str) -> StoreError {
        match self {
            Self::Damaged(reason) => StoreError::CorruptRecord { id, reason },
            Self::Engine(error) => failed(context)(error),
        }
    }
}

/// Compares the checksum in a row with that of the columns read.
pub(super) fn verify(stored: i64, found: i64) -> Result<(), RowError> {
    if stored == found {
        return Ok(());
    }
    let reason = format!("row checksum {found:08x} where {stored:08x} was stored");
    Err(RowError::Damaged(reason))
}

/// A blob column without copying it.
pub(super) fn blob<'r>(row: &'r Row<'_>, column: impl RowIndex) -> Result<&'r [u8], RowError> {
    row.get_ref(column)?.as_blob().map_err(RowError::damaged)
}

/// The identity in column `id` of a row that may be unreadable otherwise; all zeros if even that
/// is lost.
pub(super) fn id_or_zeros(id: rusqlite::Result<[u8; 16]>) -> ReferenceId {
    ReferenceId::from_bytes(id.unwrap_or([0; 16]))
}

/// An instant out of a column of microseconds since 1970.
pub(super) fn from_micros(micros: i64) -> Result<Timestamp, RowError> {
    Timestamp::from_stored_micros(micros)
        .ok_or_else(|| RowError::Damaged(format!("{micros} is not a time")))
}

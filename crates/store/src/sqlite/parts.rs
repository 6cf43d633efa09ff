//! The parts of a descriptor, and a map's head: their checksums, and reading them.
//!
//! A part's checksum covers the number of its reference, and a global vector's also its version,
//! so that neither a part of another reference nor an outdated one can pass for it.

use super::checksum::RowChecksum;
use super::keys::{ReferenceNumber, Version};
use super::row::{RowError, verify};
use crate::codec;
use placeformer_core::types::{ModelId, PackedPatches};
use rusqlite::{Connection, named_params};

/// Checksum of a global vector's row.
fn global_checksum(version: Version, number: ReferenceNumber, vector: &[u8]) -> i64 {
    RowChecksum::of("global_vector")
        .integer(version.value())
        .integer(number.value())
        .bytes(vector)
        .finish()
}

/// Verifies and reads a global vector.
pub(super) fn read_global(
    version: Version,
    number: ReferenceNumber,
    vector: &[u8],
    checksum: i64,
) -> Result<Vec<f32>, RowError> {
    verify(checksum, global_checksum(version, number, vector))?;
    codec::decode_f32(vector)
        .ok_or_else(|| RowError::Damaged("the global vector holds no numbers".into()))
}

/// Writes a global vector of some version.
pub(super) fn write_global(
    connection: &Connection,
    version: Version,
    number: ReferenceNumber,
    vector: &[u8],
) -> rusqlite::Result<()> {
    let mut statement = connection.prepare_cached(
        "INSERT INTO global_vector (version, number, vector, checksum)
         VALUES (:version, :number, :vector, :checksum)",
    )?;
    statement.execute(named_params! {
        ":version": version,
        ":number": number,
        ":vector": vector,
        ":checksum": global_checksum(version, number, vector),
    })?;
    Ok(())
}

/// Checksum of a pooled vector's row.
fn pooled_checksum(number: ReferenceNumber, vector: &[u8]) -> i64 {
    RowChecksum::of("pooled_vector")
        .integer(number.value())
        .bytes(vector)
        .finish()
}

/// Verifies and reads a pooled vector.
pub(super) fn read_pooled(
    number: ReferenceNumber,
    vector: &[u8],
    checksum: i64,
) -> Result<Vec<f32>, RowError> {
    verify(checksum, pooled_checksum(number, vector))?;
    codec::decode_f16(vector)
        .ok_or_else(|| RowError::Damaged("the pooled vector holds no numbers".into()))
}

/// Writes a pooled vector.
pub(super) fn write_pooled(
    connection: &Connection,
    number: ReferenceNumber,
    vector: &[u8],
) -> rusqlite::Result<()> {
    let mut statement = connection.prepare_cached(
        "INSERT INTO pooled_vector (number, vector, checksum)
         VALUES (:number, :vector, :checksum)",
    )?;
    statement.execute(named_params! {
        ":number": number,
        ":vector": vector,
        ":checksum": pooled_checksum(number, vector),
    })?;
    Ok(())
}

/// Checksum of a patches row. The blob verifies itself; this binds its own checksum to the row's
/// number.
fn patches_checksum(number: ReferenceNumber, blob: &[u8]) -> i64 {
    let of_blob = codec::trailing_checksum(blob).unwrap_or_default();
    RowChecksum::of("patches")
        .integer(number.value())
        .integer(i64::from(of_blob))
        .finish()
}

/// Verifies and reads key patches.
pub(super) fn read_patches(
    number: ReferenceNumber,
    blob: &[u8],
    checksum: i64,
) -> Result<PackedPatches, RowError> {
    verify(checksum, patches_checksum(number, blob))?;
    codec::decode(blob).map_err(|error| RowError::Damaged(format!("key patches: {error}")))
}

/// Writes key patches.
pub(super) fn write_patches(
    connection: &Connection,
    number: ReferenceNumber,
    blob: &[u8],
) -> rusqlite::Result<()> {
    let mut statement = connection.prepare_cached(
        "INSERT INTO patches (number, checksum, blob) VALUES (:number, :checksum, :blob)",
    )?;
    statement.execute(named_params! {
        ":number": number,
        ":checksum": patches_checksum(number, blob),
        ":blob": blob,
    })?;
    Ok(())
}

/// Checksum of a head that the map of `model` keeps.
pub(super) fn head_checksum(version: Version, model: &ModelId, file: &[u8]) -> i64 {
    RowChecksum::of("map_head")
        .integer(version.value())
        .bytes(model.as_str().as_bytes())
        .bytes(file)
        .finish()
}

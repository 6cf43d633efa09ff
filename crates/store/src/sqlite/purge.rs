//! Removing what is deleted, a bounded batch at a time.
//!
//! Deleting a map or exchanging its head is one small, atomic commit that makes the old rows
//! invisible. The rows themselves are removed afterwards, in batches between other writes, also
//! after a restart. So a map of millions vanishes at once and no write waits for its removal.

use super::engine::failed;
use super::keys::{MapNumber, ReferenceNumber, Version};
use super::remove::remove_parts;
use crate::crash_points;
use crate::error::StoreError;
use rusqlite::{Connection, OptionalExtension, named_params};

/// References removed in one transaction; each frees a patch blob of some ten pages.
const BATCH_REFERENCES: i64 = 64;

/// Vectors of a retired version removed in one transaction.
const BATCH_VECTORS: i64 = 2000;

/// Whether anything waits to be removed.
pub(super) fn is_pending(connection: &Connection) -> Result<bool, StoreError> {
    let sql = "SELECT EXISTS (SELECT 1 FROM map WHERE name IS NULL)
                   OR EXISTS (SELECT 1 FROM retired_version) AS pending";
    connection
        .query_row(sql, [], |row| row.get("pending"))
        .map_err(failed("looking for deleted data"))
}

/// Removes one batch; false once there was nothing left to remove.
pub(super) fn batch(connection: &Connection) -> Result<bool, StoreError> {
    let remove = || -> rusqlite::Result<bool> {
        let transaction = connection.unchecked_transaction()?;
        let removed = purge_map(&transaction)? || purge_version(&transaction)?;
        crash_points::reach(crash_points::MID_PURGE);
        transaction.commit()?;
        Ok(removed)
    };
    remove().map_err(failed("removing deleted data"))
}

/// A map that is deleted and whose rows still lie on disk.
struct DeletedMap {
    number: MapNumber,
    version: Version,
    pending_version: Option<Version>,
}

/// Removes references of a deleted map, or the map itself once it has none; false if no map is
/// deleted.
fn purge_map(connection: &Connection) -> rusqlite::Result<bool> {
    let sql = "SELECT number, version, pending_version FROM map WHERE name IS NULL LIMIT 1";
    let map = connection.query_row(sql, [], |row| {
        Ok(DeletedMap {
            number: row.get("number")?,
            version: row.get("version")?,
            pending_version: row.get("pending_version")?,
        })
    });
    let Some(map) = map.optional()? else {
        return Ok(false);
    };
    let numbers = some_numbers(connection, map.number)?;
    for &number in &numbers {
        remove_parts(connection, number)?;
    }
    if numbers.is_empty() {
        retire(connection, map.version)?;
        if let Some(version) = map.pending_version {
            retire(connection, version)?;
        }
        connection.execute("DELETE FROM map WHERE number = ?1", [map.number])?;
    }
    Ok(true)
}

/// Numbers of the references of a map, no more than make a batch.
fn some_numbers(connection: &Connection, map: MapNumber) -> rusqlite::Result<Vec<ReferenceNumber>> {
    let mut statement =
        connection.prepare_cached("SELECT number FROM reference WHERE map = :map LIMIT :limit")?;
    let parameters = named_params! { ":map": map, ":limit": BATCH_REFERENCES };
    let numbers = statement.query_map(parameters, |row| row.get("number"))?;
    numbers.collect()
}

/// Removes vectors of a retired version, or its head once it has none; false if no version is
/// retired.
fn purge_version(connection: &Connection) -> rusqlite::Result<bool> {
    let sql = "SELECT version FROM retired_version LIMIT 1";
    let version: Option<Version> = connection
        .query_row(sql, [], |row| row.get("version"))
        .optional()?;
    let Some(version) = version else {
        return Ok(false);
    };
    let removed = connection.execute(
        "DELETE FROM global_vector WHERE version = :version AND number IN
             (SELECT number FROM global_vector WHERE version = :version LIMIT :limit)",
        named_params! { ":version": version, ":limit": BATCH_VECTORS },
    )?;
    if removed == 0 {
        connection.execute("DELETE FROM map_head WHERE version = ?1", [version])?;
        connection.execute("DELETE FROM retired_version WHERE version = ?1", [version])?;
    }
    Ok(true)
}

/// Marks a version's vectors for removal.
pub(super) fn retire(connection: &Connection, version: Version) -> rusqlite::Result<()> {
    let sql = "INSERT OR IGNORE INTO retired_version (version) VALUES (?1)";
    connection.execute(sql, [version])?;
    Ok(())
}

/// Retires vectors of head exchanges that a crash or failure cut short.
pub(super) fn abandon_unfinished_heads(connection: &Connection) -> Result<(), StoreError> {
    let abandon = || -> rusqlite::Result<()> {
        let transaction = connection.unchecked_transaction()?;
        transaction.execute_batch(
            "INSERT OR IGNORE INTO retired_version
                 SELECT pending_version FROM map
                 WHERE pending_version IS NOT NULL AND name IS NOT NULL;
             UPDATE map SET pending_version = NULL
                 WHERE pending_version IS NOT NULL AND name IS NOT NULL",
        )?;
        transaction.commit()
    };
    abandon().map_err(failed("abandoning an unfinished head"))
}

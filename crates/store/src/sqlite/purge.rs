//! Removing what is deleted, a bounded batch at a time.
//!
//! Deleting a map or exchanging its head is one small, atomic commit that makes the old rows
//! invisible; the rows themselves go afterwards, in batches between other writes, also after a
//! restart. So a map of millions vanishes at once and nobody waits behind its removal.

use super::engine::failed;
use crate::{StoreError, crash_points};
use rusqlite::{Connection, OptionalExtension, params};

/// References removed in one transaction; each frees a patch blob of some ten pages.
const BATCH_REFERENCES: i64 = 64;

/// Vectors of a retired version removed in one transaction.
const BATCH_VECTORS: i64 = 2000;

/// Whether anything waits to be removed.
pub(super) fn is_pending(connection: &Connection) -> Result<bool, StoreError> {
    let sql = "SELECT EXISTS (SELECT 1 FROM map WHERE name IS NULL) OR EXISTS (SELECT 1 FROM retired_version)";
    connection
        .query_row(sql, [], |row| row.get(0))
        .map_err(failed("looking for deleted data"))
}

/// Removes one batch; true while more is left.
pub(super) fn batch(connection: &Connection) -> Result<bool, StoreError> {
    let removing = failed("removing deleted data");
    let transaction = connection.unchecked_transaction().map_err(&removing)?;
    let worked = purge_map(&transaction)
        .and_then(|some| Ok(some || purge_version(&transaction)?))
        .map_err(&removing)?;
    crash_points::reach(crash_points::MID_PURGE);
    transaction.commit().map_err(&removing)?;
    Ok(worked)
}

fn purge_map(connection: &Connection) -> rusqlite::Result<bool> {
    let deleted: Option<(i64, i64, Option<i64>)> = connection
        .query_row(
            "SELECT number, version, pending_version FROM map WHERE name IS NULL LIMIT 1",
            [],
            |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)),
        )
        .optional()?;
    let Some((map, version, pending)) = deleted else {
        return Ok(false);
    };
    let numbers: Vec<i64> = connection
        .prepare_cached("SELECT number FROM reference WHERE map = ?1 LIMIT ?2")?
        .query_map([map, BATCH_REFERENCES], |row| row.get(0))?
        .collect::<Result<_, _>>()?;
    for number in &numbers {
        remove_parts(connection, *number)?;
    }
    if numbers.is_empty() {
        for version in [Some(version), pending].into_iter().flatten() {
            retire(connection, version)?;
        }
        connection.execute("DELETE FROM map WHERE number = ?1", [map])?;
    }
    Ok(true)
}

fn purge_version(connection: &Connection) -> rusqlite::Result<bool> {
    let version: Option<i64> = connection
        .query_row("SELECT version FROM retired_version LIMIT 1", [], |row| {
            row.get(0)
        })
        .optional()?;
    let Some(version) = version else {
        return Ok(false);
    };
    let removed = connection.execute(
        "DELETE FROM global_vector WHERE version = ?1 AND number IN
         (SELECT number FROM global_vector WHERE version = ?1 LIMIT ?2)",
        params![version, BATCH_VECTORS],
    )?;
    if removed == 0 {
        connection.execute("DELETE FROM map_head WHERE version = ?1", [version])?;
        connection.execute("DELETE FROM retired_version WHERE version = ?1", [version])?;
    }
    Ok(true)
}

/// Marks a version's vectors for removal.
pub(super) fn retire(connection: &Connection, version: i64) -> rusqlite::Result<()> {
    connection
        .execute(
            "INSERT OR IGNORE INTO retired_version (version) VALUES (?1)",
            [version],
        )
        .map(|_| ())
}

/// Removes a reference's row and all that hangs on it except its global vectors.
pub(super) fn remove_parts(connection: &Connection, number: i64) -> rusqlite::Result<()> {
    for sql in [
        "DELETE FROM patches WHERE number = ?1",
        "DELETE FROM pooled_vector WHERE number = ?1",
        "DELETE FROM quarantine WHERE number = ?1",
        "DELETE FROM reference WHERE number = ?1",
    ] {
        connection.prepare_cached(sql)?.execute([number])?;
    }
    Ok(())
}

/// Retires vectors of head exchanges that a crash or failure cut short.
pub(super) fn abandon_unfinished_heads(connection: &Connection) -> Result<(), StoreError> {
    let sql = "INSERT OR IGNORE INTO retired_version SELECT pending_version FROM map
               WHERE pending_version IS NOT NULL AND name IS NOT NULL;
               UPDATE map SET pending_version = NULL WHERE pending_version IS NOT NULL AND name IS NOT NULL";
    let abandoning = failed("abandoning an unfinished head");
    let transaction = connection.unchecked_transaction().map_err(&abandoning)?;
    transaction.execute_batch(sql).map_err(&abandoning)?;
    transaction.commit().map_err(&abandoning)
}

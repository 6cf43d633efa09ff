//! Numbers that are never used twice, so that what is left of a deleted row cannot pass for a part
//! of a new one.

use super::keys::{ReferenceNumber, Version};
use rusqlite::Connection;
use rusqlite::types::FromSql;

/// Takes the next number for a reference.
pub(super) fn next_reference(connection: &Connection) -> rusqlite::Result<ReferenceNumber> {
    next(connection, "reference")
}

/// Takes the next version of global vectors.
pub(super) fn next_version(connection: &Connection) -> rusqlite::Result<Version> {
    next(connection, "version")
}

fn next<T: FromSql>(connection: &Connection, name: &str) -> rusqlite::Result<T> {
    connection
        .prepare_cached(
            "UPDATE sequence SET next = next + 1 WHERE name = ?1 RETURNING next - 1 AS taken",
        )?
        .query_row([name], |row| row.get("taken"))
}

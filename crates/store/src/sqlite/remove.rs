//! Removing a reference from its map, inside the writer's transaction.

use super::keys::{MapNumber, ReferenceNumber};
use super::map_row::MapRow;
use rusqlite::{Connection, named_params};

/// Removes a reference with all its parts and takes it out of the map's count.
pub(super) fn remove(
    connection: &Connection,
    map: &MapRow,
    number: ReferenceNumber,
) -> rusqlite::Result<()> {
    let versions = [Some(map.version), map.pending_version];
    for version in versions.into_iter().flatten() {
        connection
            .prepare_cached(
                "DELETE FROM global_vector WHERE version = :version AND number = :number",
            )?
            .execute(named_params! { ":version": version, ":number": number })?;
    }
    remove_parts(connection, number)?;
    count(connection, map.number, -1)
}

/// Removes a reference's row and all that refers to it, except its global vectors.
pub(super) fn remove_parts(
    connection: &Connection,
    number: ReferenceNumber,
) -> rusqlite::Result<()> {
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

/// Changes the count of references in a map's record.
pub(super) fn count(connection: &Connection, map: MapNumber, change: i64) -> rusqlite::Result<()> {
    connection
        .prepare_cached(
            "UPDATE map SET reference_count = reference_count + :change WHERE number = :map",
        )?
        .execute(named_params! { ":change": change, ":map": map })?;
    Ok(())
}

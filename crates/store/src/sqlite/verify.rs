//! Reads everything and checks every checksum: what `placeformer verify` runs.

use super::database::Database;
use super::engine::{damage, failed};
use super::keys::{MapNumber, ReferenceNumber};
use super::map_row::MapRow;
use super::parts::{read_global, read_patches, read_pooled};
use super::quarantine::DamagedReference;
use super::reference_row::{ReferenceColumns, exists, read_by_number};
use super::replace_head::read_head;
use super::row::{RowError, blob};
use crate::error::StoreError;
use crate::records::VerifyReport;
use placeformer_core::types::ReferenceId;
use rusqlite::{Connection, named_params};

/// Most messages taken from the engine's own check.
const ENGINE_MESSAGES: i64 = 100;

/// What was found of a reference.
enum Checked {
    Sound,
    /// Deleted since the references were listed.
    Deleted,
}

impl Database {
    /// Checks every map, then lets the engine check its own structures.
    pub(super) fn verify(&self, connection: &Connection) -> Result<VerifyReport, StoreError> {
        let mut report = VerifyReport::default();
        let maps = MapRow::all(connection)?;
        for name in &maps.damaged {
            let message = format!("the record of map {name} is damaged");
            report.engine_errors.push(message);
        }
        for map in &maps.sound {
            match read_head(connection, map) {
                Ok(_) => {}
                Err(error @ StoreError::CorruptHead { .. }) => {
                    report.engine_errors.push(error.to_string());
                }
                Err(error) => return Err(error),
            }
            match self.verify_map(connection, map, &mut report) {
                Ok(()) => {}
                // If the engine cannot read one map to its end, the others are still worth
                // checking.
                Err(
                    error @ (StoreError::Engine { .. }
                    | StoreError::StorageLost { .. }
                    | StoreError::Damaged { .. }),
                ) => {
                    let message = format!("map {}: {error}", map.name);
                    report.engine_errors.push(message);
                }
                Err(error) => return Err(error),
            }
        }
        report.engine_errors.extend(engine_check(connection)?);
        Ok(report)
    }

    fn verify_map(
        &self,
        connection: &Connection,
        map: &MapRow,
        report: &mut VerifyReport,
    ) -> Result<(), StoreError> {
        let listed =
            list(connection, map.number).map_err(failed("listing references to verify"))?;
        for &(number, id) in &listed {
            match verify_reference(connection, map, number, id) {
                Ok(Checked::Deleted) => continue,
                Ok(Checked::Sound) => {
                    if let Some(reason) = self.quarantine.reason(number) {
                        report.damaged.push((id, reason));
                    }
                }
                Err(RowError::Damaged(reason)) => {
                    report.damaged.push((id, reason.clone()));
                    self.put_in_quarantine(DamagedReference {
                        number,
                        map: map.number,
                        id,
                        reason,
                    });
                }
                Err(RowError::Engine(error)) => {
                    return Err(failed("verifying a reference")(error));
                }
            }
            report.references += 1;
        }
        if listed.len() as i64 != map.reference_count {
            // Writers go on meanwhile, so a difference counts only if it is still there when both
            // numbers are read from one snapshot.
            let message = count_mismatch(connection, map).map_err(failed("counting references"))?;
            report.engine_errors.extend(message);
        }
        Ok(())
    }
}

/// What is wrong with the count in a map's record, if anything.
fn count_mismatch(connection: &Connection, map: &MapRow) -> rusqlite::Result<Option<String>> {
    let sql = "SELECT (SELECT count(*) FROM reference WHERE map = ?1) AS counted, reference_count
               FROM map WHERE number = ?1";
    let (counted, recorded): (i64, i64) = connection.query_row(sql, [map.number], |row| {
        Ok((row.get("counted")?, row.get("reference_count")?))
    })?;
    if counted == recorded {
        return Ok(None);
    }
    let name = &map.name;
    Ok(Some(format!(
        "map {name} has {counted} references, its record says {recorded}"
    )))
}

/// Numbers and identities of a map's references, out of its index.
fn list(
    connection: &Connection,
    map: MapNumber,
) -> rusqlite::Result<Vec<(ReferenceNumber, ReferenceId)>> {
    let sql = "SELECT number, id FROM reference INDEXED BY reference_by_map WHERE map = ?1";
    let mut statement = connection.prepare_cached(sql)?;
    let rows = statement.query_map([map], |row| {
        let id = ReferenceId::from_bytes(row.get("id")?);
        Ok((row.get("number")?, id))
    })?;
    rows.collect()
}

/// Reads a reference and its parts, and checks each against its checksum.
fn verify_reference(
    connection: &Connection,
    map: &MapRow,
    number: ReferenceNumber,
    id: ReferenceId,
) -> Result<Checked, RowError> {
    let Some(row) = read_by_number(connection, number, ReferenceColumns::read)? else {
        return Ok(Checked::Deleted);
    };
    if row.id() != id || row.map != map.number {
        return Err(RowError::Damaged(
            "its row and its index entry differ".into(),
        ));
    }
    row.into_reference(map.name.clone(), map.model.clone())?;
    let are_whole = verify_pooled(connection, number)?
        && verify_patches(connection, number)?
        && verify_global(connection, number)?;
    if are_whole {
        return Ok(Checked::Sound);
    }
    // A part is not there: it is lost, or the reference was deleted after its row was read.
    if exists(connection, number)? {
        Err(RowError::Damaged("a part of it is missing".into()))
    } else {
        Ok(Checked::Deleted)
    }
}

/// Checks the pooled vector; false if there is none.
fn verify_pooled(connection: &Connection, number: ReferenceNumber) -> Result<bool, RowError> {
    let sql = "SELECT vector, checksum FROM pooled_vector WHERE number = ?1";
    let mut statement = connection.prepare_cached(sql)?;
    let mut rows = statement.query([number])?;
    let Some(row) = rows.next()? else {
        return Ok(false);
    };
    read_pooled(number, blob(row, "vector")?, row.get("checksum")?)?;
    Ok(true)
}

/// Checks the key patches; false if there are none.
fn verify_patches(connection: &Connection, number: ReferenceNumber) -> Result<bool, RowError> {
    let sql = "SELECT blob, checksum FROM patches WHERE number = ?1";
    let mut statement = connection.prepare_cached(sql)?;
    let mut rows = statement.query([number])?;
    let Some(row) = rows.next()? else {
        return Ok(false);
    };
    read_patches(number, blob(row, "blob")?, row.get("checksum")?)?;
    Ok(true)
}

/// Checks the global vector; false if there is none.
fn verify_global(connection: &Connection, number: ReferenceNumber) -> Result<bool, RowError> {
    // The map's version may have changed since the map was read, so it is looked up afresh.
    let sql = "SELECT vector, checksum, version FROM global_vector
               WHERE number = :number AND version =
                   (SELECT m.version FROM reference r JOIN map m ON m.number = r.map
                    WHERE r.number = :number)";
    let mut statement = connection.prepare_cached(sql)?;
    let mut rows = statement.query(named_params! { ":number": number })?;
    let Some(row) = rows.next()? else {
        return Ok(false);
    };
    let version = row.get("version")?;
    read_global(version, number, blob(row, "vector")?, row.get("checksum")?)?;
    Ok(true)
}

/// What the engine finds wrong with its own structures.
fn engine_check(connection: &Connection) -> Result<Vec<String>, StoreError> {
    let mut messages = Vec::new();
    let mut ask = |sql: &str, column: &str| -> rusqlite::Result<()> {
        let mut statement = connection.prepare(sql)?;
        let mut rows = statement.query([])?;
        while let Some(row) = rows.next()? {
            messages.push(row.get::<_, String>(column)?);
        }
        Ok(())
    };
    let integrity = format!("PRAGMA integrity_check({ENGINE_MESSAGES})");
    let orphans = "SELECT 'a row of ' || \"table\" || ' belongs to no reference' AS message
                   FROM pragma_foreign_key_check";
    let outcome = ask(&integrity, "integrity_check").and_then(|()| ask(orphans, "message"));
    if let Err(error) = outcome {
        match damage(&error) {
            Some(reason) => messages.push(reason),
            None => return Err(failed("checking its integrity")(error)),
        }
    }
    messages.retain(|message| message != "ok");
    Ok(messages)
}

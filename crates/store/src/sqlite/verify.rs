//! Reads everything and checks every checksum: what `placeformer verify` runs.

use super::engine::{damage, failed};
use super::rows::{self, MapRow, REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceRow, RowError};
use super::{SqliteStore, read, rehead};
use crate::{StoreError, VerifyReport};
use placeformer_core::types::ReferenceId;
use rusqlite::{Connection, OptionalExtension};

/// Most messages taken from the engine's own check.
const ENGINE_MESSAGES: i64 = 100;

impl SqliteStore {
    pub(super) fn verify_all(&self, connection: &Connection) -> Result<VerifyReport, StoreError> {
        let mut report = VerifyReport::default();
        let (maps, damaged_maps) = MapRow::all(connection)?;
        report.engine_errors.extend(
            damaged_maps
                .iter()
                .map(|name| format!("the record of map {name} is damaged")),
        );
        for map in &maps {
            match rehead::read_head(connection, map) {
                Err(error @ StoreError::CorruptHead { .. }) => {
                    report.engine_errors.push(error.to_string())
                }
                outcome => outcome.map(drop)?,
            }
            match self.verify_map(connection, map, &mut report) {
                // Where the engine itself gives up on a map, the others are still worth checking.
                Err(error @ (StoreError::Engine { .. } | StoreError::Damaged { .. })) => report
                    .engine_errors
                    .push(format!("map {}: {error}", map.name)),
                outcome => outcome?,
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
        let numbers = numbers_behind(connection, map.number)?;
        for &(number, id) in &numbers {
            report.references += 1;
            let outcome = verify_reference(connection, map, number, id);
            match outcome {
                Ok(()) => {
                    if let Some(reason) = self.quarantine.reason(number) {
                        report.damaged.push((id, reason));
                    }
                }
                Err(RowError::Damaged(reason)) => {
                    self.put_in_quarantine(number, map.number, id, &reason);
                    report.damaged.push((id, reason));
                }
                // Deleted since the numbers were listed.
                Err(RowError::Engine(rusqlite::Error::QueryReturnedNoRows)) => {
                    report.references -= 1
                }
                Err(RowError::Engine(error)) => return Err(failed("verifying a reference")(error)),
            }
        }
        if numbers.len() as i64 != map.reference_count {
            // Writers go on meanwhile; only a difference that a second look confirms is one.
            let (now, counted) =
                counts(connection, map.number).map_err(failed("counting references"))?;
            if now != counted {
                let message = format!(
                    "map {} has {now} references, its record says {counted}",
                    map.name
                );
                report.engine_errors.push(message);
            }
        }
        Ok(())
    }
}

fn counts(connection: &Connection, map: i64) -> rusqlite::Result<(i64, i64)> {
    let sql = "SELECT (SELECT count(*) FROM reference WHERE map = ?1), reference_count FROM map WHERE number = ?1";
    connection.query_row(sql, [map], |row| Ok((row.get(0)?, row.get(1)?)))
}

/// Numbers and identities of a map's references, out of its index.
fn numbers_behind(
    connection: &Connection,
    map: i64,
) -> Result<Vec<(i64, ReferenceId)>, StoreError> {
    let listing = failed("listing references to verify");
    let sql = "SELECT number, id FROM reference INDEXED BY reference_by_map WHERE map = ?1";
    let mut statement = connection.prepare_cached(sql).map_err(&listing)?;
    let rows = statement
        .query_map([map], |row| {
            Ok((row.get(0)?, ReferenceId::from_bytes(row.get(1)?)))
        })
        .map_err(&listing)?;
    rows.collect::<Result<_, _>>().map_err(&listing)
}

fn verify_reference(
    connection: &Connection,
    map: &MapRow,
    number: i64,
    id: ReferenceId,
) -> Result<(), RowError> {
    let sql = format!("SELECT {REFERENCE_COLUMNS} FROM {REFERENCE_SOURCE} WHERE r.number = ?1");
    let mut statement = connection.prepare_cached(&sql)?;
    let row = statement.query_row([number], |row| Ok(ReferenceRow::read(row)))??;
    if row.id() != id || row.map != map.number {
        return Err(RowError::Damaged(
            "its row and its index entry differ".into(),
        ));
    }
    row.reference(map.name.clone(), map.model.clone())?;
    part(
        connection,
        "SELECT vector, checksum FROM pooled_vector WHERE number = ?1",
        number,
        |vector, checksum| rows::read_pooled(number, vector, checksum).map(|_| ()),
    )?;
    part(
        connection,
        "SELECT blob, checksum FROM patches WHERE number = ?1",
        number,
        |blob, checksum| rows::read_patches(number, blob, checksum).map(|_| ()),
    )?;
    // The version may have changed since the map was read, so it is looked up afresh.
    let sql = "SELECT g.vector, g.checksum, g.version FROM global_vector g
               WHERE g.number = ?1 AND g.version = (SELECT m.version FROM reference r JOIN map m ON m.number = r.map
                                                    WHERE r.number = ?1)";
    let mut statement = connection.prepare_cached(sql)?;
    let mut found = statement.query([number])?;
    let row = found
        .next()?
        .ok_or_else(|| RowError::Damaged("its global vector is missing".into()))?;
    rows::read_global(row.get(2)?, number, read::blob(row, 0)?, row.get(1)?).map(|_| ())
}

fn part(
    connection: &Connection,
    sql: &str,
    number: i64,
    check: impl FnOnce(&[u8], i64) -> Result<(), RowError>,
) -> Result<(), RowError> {
    let mut statement = connection.prepare_cached(sql)?;
    let mut found = statement.query([number])?;
    match found.next()? {
        Some(row) => check(read::blob(row, 0)?, row.get(1)?),
        None => {
            let mut still_there =
                connection.prepare_cached("SELECT 1 FROM reference WHERE number = ?1")?;
            still_there
                .query_row([number], |_| Ok(()))
                .optional()?
                .ok_or(rusqlite::Error::QueryReturnedNoRows)?;
            Err(RowError::Damaged("a part of it is missing".into()))
        }
    }
}

/// What the engine finds wrong with its own structures.
fn engine_check(connection: &Connection) -> Result<Vec<String>, StoreError> {
    let mut messages = Vec::new();
    let mut ask = |sql: &str| -> rusqlite::Result<()> {
        let mut statement = connection.prepare(sql)?;
        let mut rows = statement.query([])?;
        while let Some(row) = rows.next()? {
            messages.push(row.get::<_, String>(0)?);
        }
        Ok(())
    };
    let outcome = ask(&format!("PRAGMA integrity_check({ENGINE_MESSAGES})")).and_then(|()| {
        ask("SELECT 'a row of ' || \"table\" || ' belongs to no reference' FROM pragma_foreign_key_check")
    });
    if let Err(error) = outcome {
        messages.push(damage(&error).ok_or_else(|| failed("checking its integrity")(error))?);
    }
    messages.retain(|message| message != "ok");
    Ok(messages)
}

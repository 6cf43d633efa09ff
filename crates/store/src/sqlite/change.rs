//! Changing and deleting what is stored, inside the writer's transaction.

use super::engine::failed;
use super::insert::{number_of_external, remove, write_row};
use super::rows::{self, MapRow, REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceRow, RowError};
use crate::{ReferencePatch, StoreError, apply_patch};
use placeformer_core::types::{
    Calibration, ContentHash, MapName, ModelId, Reference, ReferenceFields, ReferenceId,
};
use rusqlite::{Connection, params};
use time::OffsetDateTime;

/// Changes a reference's fields; its descriptor stays.
pub(super) fn update(
    connection: &Connection,
    id: ReferenceId,
    patch: ReferencePatch,
) -> Result<Reference, StoreError> {
    let updating = failed("changing a reference");
    let (number, map) = rows::locate(connection, id)?;
    let read = || -> Result<Option<(ReferenceRow, Reference)>, RowError> {
        let sql = format!("SELECT {REFERENCE_COLUMNS} FROM {REFERENCE_SOURCE} WHERE r.number = ?1");
        let mut statement = connection.prepare_cached(&sql)?;
        let mut found = statement.query([number])?;
        let Some(row) = found.next()? else {
            return Ok(None);
        };
        Ok(Some((ReferenceRow::read(row)?, rows::read_reference(row)?)))
    };
    let (mut row, mut reference) = match read() {
        Ok(Some(found)) => found,
        Ok(None) => return Err(StoreError::ReferenceNotFound { id }),
        Err(RowError::Damaged(reason)) => return Err(StoreError::Corrupt { id, reason }),
        Err(RowError::Engine(error)) => return Err(updating(error)),
    };
    apply_patch(&mut reference.fields, patch);
    if let Some(external_id) = &reference.fields.external_id
        && let Some(holder) = number_of_external(connection, map, external_id).map_err(&updating)?
        && holder != number
    {
        let existing = rows::reference_by_number(connection, holder)
            .ok()
            .flatten()
            .map_or(id, |holder| holder.id);
        let (map, external_id) = (reference.map, external_id.clone());
        return Err(StoreError::ExternalIdConflict {
            map,
            external_id,
            existing,
        });
    }
    row.set_fields(&reference.fields);
    write_row(connection, &row).map_err(&updating)?;
    let (map, model) = (reference.map, reference.model);
    row.reference(map, model).map_err(|error| match error {
        RowError::Damaged(reason) => StoreError::InvalidDescriptor { reason },
        RowError::Engine(error) => updating(error),
    })
}

/// Deletes a reference, damaged or not, and returns what it was as far as it can be read.
pub(super) fn delete(
    connection: &Connection,
    id: ReferenceId,
) -> Result<(i64, Reference), StoreError> {
    let deleting = failed("deleting a reference");
    let (number, map_number) = rows::locate(connection, id)?;
    let name: String = connection
        .prepare_cached("SELECT name FROM map WHERE number = ?1")
        .and_then(|mut statement| statement.query_row([map_number], |row| row.get(0)))
        .map_err(&deleting)?;
    let name: MapName = name
        .parse()
        .map_err(|_| StoreError::CorruptMap { map: name })?;
    let map = MapRow::require(connection, &name)?;
    let reference = match rows::reference_by_number(connection, number) {
        Ok(Some(reference)) => reference,
        Ok(None) => return Err(StoreError::ReferenceNotFound { id }),
        Err(RowError::Damaged(_)) => unreadable(id, name, map.model.clone()),
        Err(RowError::Engine(error)) => return Err(deleting(error)),
    };
    remove(connection, &map, number).map_err(&deleting)?;
    Ok((number, reference))
}

/// Stands for a reference whose own row is damaged.
fn unreadable(id: ReferenceId, map: MapName, model: ModelId) -> Reference {
    let (fields, content_hash) = (ReferenceFields::default(), ContentHash([0; 32]));
    Reference {
        id,
        map,
        fields,
        content_hash,
        model,
        created_at: OffsetDateTime::UNIX_EPOCH,
    }
}

/// Makes a map and everything in it invisible; returns its number and how many references it had.
pub(super) fn delete_map(
    connection: &Connection,
    name: &MapName,
) -> Result<(i64, u64), StoreError> {
    let sql = "UPDATE map SET name = NULL WHERE name = ?1 RETURNING number, reference_count";
    let mut statement = connection
        .prepare_cached(sql)
        .map_err(failed("deleting a map"))?;
    let mut rows = statement
        .query([name.as_str()])
        .map_err(failed("deleting a map"))?;
    let row = rows.next().map_err(failed("deleting a map"))?;
    let row = row.ok_or_else(|| StoreError::MapNotFound { map: name.clone() })?;
    let deleted: (i64, i64) = row
        .get(0)
        .and_then(|number| Ok((number, row.get(1)?)))
        .map_err(failed("deleting a map"))?;
    // A statement with RETURNING is complete only when it has been stepped to its end.
    while rows.next().map_err(failed("deleting a map"))?.is_some() {}
    Ok((deleted.0, deleted.1.max(0) as u64))
}

/// Stores a map's calibration, or clears it.
pub(super) fn set_calibration(
    connection: &Connection,
    name: &MapName,
    calibration: Option<&Calibration>,
) -> Result<(), StoreError> {
    let mut map = MapRow::require(connection, name)?;
    // Checked where the map's model cannot change meanwhile.
    if let Some(given) = calibration
        .map(Calibration::model)
        .filter(|given| **given != map.model)
    {
        return Err(StoreError::CalibrationMismatch {
            map: name.clone(),
            bound: map.model,
            given: given.clone(),
        });
    }
    // A struct of strings and finite numbers always serialises.
    map.calibration = calibration.and_then(|calibration| serde_json::to_string(calibration).ok());
    map.save(connection)
}

/// Records a damaged reference.
pub(super) fn quarantine(
    connection: &Connection,
    number: i64,
    map: i64,
    id: ReferenceId,
    reason: &str,
) -> Result<(), StoreError> {
    connection
        .execute(
            "INSERT OR IGNORE INTO quarantine (number, id, map, reason, detected_at) VALUES (?1, ?2, ?3, ?4, ?5)",
            params![number, id.as_bytes().as_slice(), map, reason, rows::to_micros(OffsetDateTime::now_utc())],
        )
        .map(|_| ())
        .map_err(failed("recording a damaged reference"))
}

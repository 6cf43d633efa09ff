//! Changing and deleting what is stored, inside the writer's transaction.

use super::engine::failed;
use super::keys::{MapNumber, ReferenceNumber};
use super::map_row::MapRow;
use super::reference_row::{
    ReferenceRow, id_of, locate, map_of, number_of_external, read_by_number, reference_by_number,
};
use super::remove::remove;
use super::row::RowError;
use crate::error::StoreError;
use crate::records::ReferencePatch;
use placeformer_core::types::{
    Calibration, ContentHash, MapName, ModelId, Reference, ReferenceFields, ReferenceId, Timestamp,
};
use rusqlite::Connection;

/// Changes a reference's fields; its descriptor stays.
pub(super) fn update(
    connection: &Connection,
    id: ReferenceId,
    patch: ReferencePatch,
) -> Result<Reference, StoreError> {
    let updating = "changing a reference";
    let located = locate(connection, id)?;
    let found = read_by_number(connection, located.number, |columns, row| {
        Ok((columns.read(row)?, columns.read_reference(row)?))
    });
    let found = found.map_err(|error| error.of_reference(id, updating))?;
    let Some((mut row, mut reference)) = found else {
        return Err(StoreError::ReferenceNotFound { id });
    };
    patch.apply(&mut reference.fields);
    refuse_conflict(connection, &row, &reference)?;
    row.set_fields(&reference.fields);
    row.write(connection).map_err(failed(updating))?;
    // Read back from the row, so that the answer shows the values as they are stored.
    row.into_reference(reference.map, reference.model)
        .map_err(|error| error.of_reference(id, updating))
}

/// An error if the external id of `changed` belongs to another reference than the one in `row`.
fn refuse_conflict(
    connection: &Connection,
    row: &ReferenceRow,
    changed: &Reference,
) -> Result<(), StoreError> {
    let Some(external_id) = &changed.fields.external_id else {
        return Ok(());
    };
    let owner = number_of_external(connection, row.map, external_id)
        .map_err(failed("looking up an external id"))?;
    match owner {
        Some(number) if number != row.number => Err(StoreError::ExternalIdConflict {
            map: changed.map.clone(),
            external_id: external_id.clone(),
            existing: id_of(connection, number),
        }),
        _ => Ok(()),
    }
}

/// A reference that was deleted: its number, and what it was.
pub(super) struct Deleted {
    pub number: ReferenceNumber,
    pub reference: Reference,
}

/// Deletes a reference, damaged or not, and returns what it was as far as it can be read.
pub(super) fn delete(connection: &Connection, id: ReferenceId) -> Result<Deleted, StoreError> {
    let failed = failed("deleting a reference");
    let located = locate(connection, id)?;
    let name = map_of(connection, id)?;
    let map = MapRow::require(connection, &name)?;
    let reference = match reference_by_number(connection, located.number) {
        Ok(Some(reference)) => reference,
        Ok(None) => return Err(StoreError::ReferenceNotFound { id }),
        Err(RowError::Damaged(_)) => unreadable(id, name, map.model.clone()),
        Err(RowError::Engine(error)) => return Err(failed(error)),
    };
    remove(connection, &map, located.number).map_err(&failed)?;
    Ok(Deleted {
        number: located.number,
        reference,
    })
}

/// Stands for a reference whose own row is damaged.
fn unreadable(id: ReferenceId, map: MapName, model: ModelId) -> Reference {
    Reference {
        id,
        map,
        fields: ReferenceFields::default(),
        content_hash: ContentHash([0; 32]),
        model,
        created_at: Timestamp::EARLIEST,
    }
}

/// A map that was deleted: its number, and how many references it had.
pub(super) struct DeletedMap {
    pub number: MapNumber,
    pub references: u64,
}

/// Makes a map and everything in it invisible.
pub(super) fn delete_map(
    connection: &Connection,
    name: &MapName,
) -> Result<DeletedMap, StoreError> {
    let delete = || -> rusqlite::Result<Option<DeletedMap>> {
        let mut statement = connection.prepare_cached(
            "UPDATE map SET name = NULL WHERE name = ?1 RETURNING number, reference_count",
        )?;
        let mut rows = statement.query([name.as_str()])?;
        let Some(row) = rows.next()? else {
            return Ok(None);
        };
        let references: i64 = row.get("reference_count")?;
        let deleted = DeletedMap {
            number: row.get("number")?,
            references: references.max(0) as u64,
        };
        // A statement with RETURNING has done its work only when it has been stepped to its end.
        while rows.next()?.is_some() {}
        Ok(Some(deleted))
    };
    match delete().map_err(failed("deleting a map"))? {
        Some(deleted) => Ok(deleted),
        None => Err(StoreError::MapNotFound { map: name.clone() }),
    }
}

/// Stores a map's calibration, or clears it.
pub(super) fn set_calibration(
    connection: &Connection,
    name: &MapName,
    calibration: Option<&Calibration>,
) -> Result<(), StoreError> {
    let mut map = MapRow::require(connection, name)?;
    // The model is compared here, inside the transaction, where it cannot change meanwhile.
    if let Some(calibration) = calibration
        && *calibration.model() != map.model
    {
        return Err(StoreError::CalibrationMismatch {
            map: name.clone(),
            bound: map.model,
            given: calibration.model().clone(),
        });
    }
    // A struct of strings and finite numbers always serialises.
    map.calibration = calibration.and_then(|calibration| serde_json::to_string(calibration).ok());
    map.save(connection)
}

#[cfg(test)]
pub(super) mod tests;

//! Storing a reference: its map on first use, its row, and the three parts of its descriptor, in
//! one transaction.
//!
//! All inserts pass through the one writer, so that of two callers with one external id exactly
//! one creates it.

use super::engine::failed;
use super::keys::ReferenceNumber;
use super::map_row::MapRow;
use super::parts::{write_global, write_patches, write_pooled};
use super::quarantine;
use super::reference_row::{ReferenceRow, id_of, number_of_external, reference_by_number};
use super::remove::{count, remove};
use super::row::RowError;
use super::sequence::{next_reference, next_version};
use crate::error::StoreError;
use crate::records::Inserted;
use crate::{codec, crash_points};
use placeformer_core::types::{
    ContentHash, ExternalId, GLOBAL_DIM, MapName, ModelId, NewReference, Reference,
    ReferenceFields, ReferenceId, Timestamp,
};
use rusqlite::Connection;

/// Bytes that a reference takes in addition to its descriptor, about.
const ROW_BYTES: usize = 1024;

/// A reference as bytes, made on the caller's thread so that the writer only writes.
pub(super) struct Prepared {
    map: MapName,
    model: ModelId,
    fields: ReferenceFields,
    content_hash: ContentHash,
    global: Vec<u8>,
    pooled: Vec<u8>,
    patches: Vec<u8>,
}

impl Prepared {
    /// Checks and encodes.
    pub(super) fn new(new: NewReference) -> Result<Self, StoreError> {
        let descriptor = new.descriptor;
        check_global(&descriptor.global)?;
        let patches = codec::encode(&descriptor.patches);
        let patches = patches.map_err(|error| StoreError::InvalidDescriptor {
            reason: error.to_string(),
        })?;
        Ok(Self {
            map: new.map,
            model: new.model,
            fields: new.fields,
            content_hash: new.content_hash,
            global: codec::encode_f32(&descriptor.global),
            pooled: encode_pooled(&descriptor.pooled)?,
            patches,
        })
    }

    /// Bytes it adds to the store, about.
    pub(super) fn bytes(&self) -> usize {
        self.global.len() + self.pooled.len() + self.patches.len() + ROW_BYTES
    }
}

fn encode_pooled(pooled: &[f32]) -> Result<Vec<u8>, StoreError> {
    let bytes = codec::encode_f16(pooled);
    if pooled.is_empty() || codec::decode_f16(&bytes).is_none() {
        let reason = "the pooled vector is empty or does not fit half precision".to_owned();
        return Err(StoreError::InvalidDescriptor { reason });
    }
    Ok(bytes)
}

/// Refuses a global vector of another length or with values that are not numbers.
pub(super) fn check_global(global: &[f32]) -> Result<(), StoreError> {
    let reason = if global.len() != GLOBAL_DIM {
        format!(
            "the global vector has {} values instead of {GLOBAL_DIM}",
            global.len()
        )
    } else if !global.iter().all(|value| value.is_finite()) {
        "the global vector holds a value that is not a finite number".to_owned()
    } else {
        return Ok(());
    };
    Err(StoreError::InvalidDescriptor { reason })
}

/// What became of an insert, and the damaged reference that it took the place of.
pub(super) struct Outcome {
    pub inserted: Inserted,
    pub replaced: Option<Replaced>,
}

/// A damaged reference that made way for its image sent again.
#[derive(Debug, Clone, Copy)]
pub(super) struct Replaced {
    pub number: ReferenceNumber,
    /// As far as it can be read.
    pub id: ReferenceId,
}

/// Stores `new` inside the writer's transaction.
pub(super) fn insert(connection: &Connection, new: &Prepared) -> Result<Outcome, StoreError> {
    let map = map_for(connection, new)?;
    let mut replaced = None;
    if let Some(external_id) = &new.fields.external_id {
        match existing(connection, &map, external_id, new.content_hash)? {
            Existing::None => {}
            Existing::SameContent(reference) => {
                return Ok(Outcome {
                    inserted: Inserted::AlreadyThere(*reference),
                    replaced: None,
                });
            }
            Existing::Removed(damaged) => replaced = Some(damaged),
        }
    }
    let row = write(connection, new, &map).map_err(failed("writing a reference"))?;
    let reference = row
        .into_reference(new.map.clone(), new.model.clone())
        .map_err(|error| match error {
            // The row comes from the caller's values and has not been on disk.
            RowError::Damaged(reason) => StoreError::InvalidDescriptor { reason },
            RowError::Engine(error) => failed("writing a reference")(error),
        })?;
    Ok(Outcome {
        inserted: Inserted::Created(reference),
        replaced,
    })
}

/// The map that `new` goes to, created if there is none of its name.
fn map_for(connection: &Connection, new: &Prepared) -> Result<MapRow, StoreError> {
    match MapRow::find(connection, &new.map)? {
        Some(map) if map.model == new.model => Ok(map),
        Some(map) => Err(StoreError::ModelMismatch {
            map: new.map.clone(),
            bound: map.model,
            given: new.model.clone(),
        }),
        None => create_map(connection, &new.map, &new.model).map_err(failed("creating a map")),
    }
}

fn create_map(
    connection: &Connection,
    name: &MapName,
    model: &ModelId,
) -> rusqlite::Result<MapRow> {
    let version = next_version(connection)?;
    let sql = "SELECT coalesce(max(number), 0) + 1 AS next FROM map";
    let number = connection.query_row(sql, [], |row| row.get("next"))?;
    let map = MapRow {
        number,
        name: name.clone(),
        model: model.clone(),
        version,
        pending_version: None,
        reference_count: 0,
        calibration: None,
        created_at: Timestamp::now(),
    };
    map.insert(connection)?;
    Ok(map)
}

/// The reference that has an external id already.
enum Existing {
    None,
    SameContent(Box<Reference>),
    /// It was damaged and is removed, because sending its image again is how a map is repaired.
    Removed(Replaced),
}

/// Looks up the reference with an external id; an error if its content is another.
fn existing(
    connection: &Connection,
    map: &MapRow,
    external_id: &ExternalId,
    content_hash: ContentHash,
) -> Result<Existing, StoreError> {
    let failed = failed("looking up an external id");
    let number = number_of_external(connection, map.number, external_id).map_err(&failed)?;
    let Some(number) = number else {
        return Ok(Existing::None);
    };
    let quarantined = quarantine::is_recorded(connection, number).map_err(&failed)?;
    match reference_by_number(connection, number) {
        Ok(Some(reference)) if !quarantined => {
            if reference.content_hash == content_hash {
                return Ok(Existing::SameContent(Box::new(reference)));
            }
            Err(StoreError::ExternalIdConflict {
                map: map.name.clone(),
                external_id: external_id.clone(),
                existing: reference.id,
            })
        }
        Ok(_) | Err(RowError::Damaged(_)) => {
            let id = id_of(connection, number);
            remove(connection, map, number).map_err(&failed)?;
            Ok(Existing::Removed(Replaced { number, id }))
        }
        Err(RowError::Engine(error)) => Err(failed(error)),
    }
}

/// Writes the row and the parts of `new`.
fn write(connection: &Connection, new: &Prepared, map: &MapRow) -> rusqlite::Result<ReferenceRow> {
    let number = next_reference(connection)?;
    let row = reference_row(new, map, number);
    row.write(connection)?;
    crash_points::reach(crash_points::MID_INSERT);
    write_global(connection, map.version, number, &new.global)?;
    write_pooled(connection, number, &new.pooled)?;
    write_patches(connection, number, &new.patches)?;
    count(connection, map.number, 1)?;
    Ok(row)
}

fn reference_row(new: &Prepared, map: &MapRow, number: ReferenceNumber) -> ReferenceRow {
    let mut row = ReferenceRow {
        number,
        id: *ReferenceId::generate().as_bytes(),
        map: map.number,
        external_id: None,
        lat: None,
        lon: None,
        alt: None,
        heading: None,
        captured_at: None,
        metadata: None,
        content_hash: new.content_hash.0,
        created_at: Timestamp::now().unix_micros(),
    };
    row.set_fields(&new.fields);
    row
}

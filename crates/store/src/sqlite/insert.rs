//! Storing a reference: its map on first use, its row, and the three parts of its descriptor, in
//! one transaction.
//!
//! All inserts pass through the one writer, so that of two callers with one external id exactly one
//! creates it.

use super::engine::failed;
use super::purge;
use super::rows::{
    self, MapRow, ReferenceRow, RowError, as_stored, global_checksum, patches_checksum,
    pooled_checksum, to_micros,
};
use crate::{Inserted, StoreError, codec, crash_points};
use placeformer_core::types::{
    ContentHash, Descriptor, ExternalId, GLOBAL_DIM, MapName, ModelId, NewReference, Reference,
    ReferenceFields, ReferenceId,
};
use rusqlite::{Connection, OptionalExtension, params};
use time::OffsetDateTime;

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
        let NewReference {
            map,
            fields,
            content_hash,
            model,
            descriptor,
        } = new;
        let Descriptor {
            global,
            pooled,
            patches,
        } = descriptor;
        let invalid = |reason: String| StoreError::InvalidDescriptor { reason };
        check_global(&global)?;
        let pooled_bytes = codec::encode_f16(&pooled);
        if pooled.is_empty() || codec::decode_f16(&pooled_bytes).is_none() {
            return Err(invalid(
                "the pooled vector is empty or does not fit half precision".into(),
            ));
        }
        Ok(Self {
            map,
            model,
            fields,
            content_hash,
            global: codec::encode_f32(&global),
            pooled: pooled_bytes,
            patches: codec::encode(&patches).map_err(|error| invalid(error.to_string()))?,
        })
    }

    /// Bytes it adds to the store, about.
    pub(super) fn bytes(&self) -> usize {
        self.global.len() + self.pooled.len() + self.patches.len() + 1024
    }
}

/// Refuses a global vector of another length or with values that are not numbers.
pub(super) fn check_global(global: &[f32]) -> Result<(), StoreError> {
    let invalid = |reason: String| Err(StoreError::InvalidDescriptor { reason });
    if global.len() != GLOBAL_DIM {
        return invalid(format!(
            "the global vector has {} values instead of {GLOBAL_DIM}",
            global.len()
        ));
    }
    if !global.iter().all(|v| v.is_finite()) {
        return invalid("the global vector holds a value that is not a finite number".into());
    }
    Ok(())
}

/// Stores `new` inside the writer's transaction; also returns the damaged reference it took the
/// place of.
pub(super) fn insert(
    connection: &Connection,
    new: &Prepared,
) -> Result<(Inserted, Option<Replaced>), StoreError> {
    let map = match MapRow::find(connection, &new.map)? {
        Some(map) if map.model != new.model => {
            return Err(StoreError::ModelMismatch {
                map: new.map.clone(),
                bound: map.model,
                given: new.model.clone(),
            });
        }
        Some(map) => map,
        None => create_map(connection, &new.map, &new.model)?,
    };
    let mut healed = None;
    if let Some(external_id) = &new.fields.external_id {
        match holder(connection, &map, external_id, new.content_hash)? {
            Holder::Nobody => {}
            Holder::SameContent(existing) => return Ok((Inserted::AlreadyThere(*existing), None)),
            Holder::Removed(replaced) => healed = Some(replaced),
        }
    }
    let writing = failed("writing a reference");
    let number = next_in_sequence(connection, "reference").map_err(&writing)?;
    let row = reference_row(new, &map, number);
    write_row(connection, &row).map_err(&writing)?;
    crash_points::reach(crash_points::MID_INSERT);
    write_parts(connection, new, map.version, number).map_err(&writing)?;
    count(connection, map.number, 1).map_err(&writing)?;
    let reference =
        row.reference(new.map.clone(), new.model.clone())
            .map_err(|error| match error {
                RowError::Damaged(reason) => StoreError::InvalidDescriptor { reason },
                RowError::Engine(error) => writing(error),
            })?;
    Ok((Inserted::Created(reference), healed))
}

fn create_map(
    connection: &Connection,
    name: &MapName,
    model: &ModelId,
) -> Result<MapRow, StoreError> {
    let creating = failed("creating a map");
    let version = next_in_sequence(connection, "version").map_err(&creating)?;
    let number: i64 = connection
        .query_row("SELECT coalesce(max(number), 0) + 1 FROM map", [], |row| {
            row.get(0)
        })
        .map_err(&creating)?;
    let map = MapRow {
        number,
        name: name.clone(),
        model: model.clone(),
        version,
        pending_version: None,
        reference_count: 0,
        calibration: None,
        created_at: as_stored(OffsetDateTime::now_utc()),
    };
    connection
        .execute(
            "INSERT INTO map (number, name, model, version, reference_count, created_at, checksum)
             VALUES (?1, ?2, ?3, ?4, 0, ?5, ?6)",
            params![
                number,
                name.as_str(),
                model.as_str(),
                version,
                to_micros(map.created_at),
                map.checksum()
            ],
        )
        .map_err(&creating)?;
    Ok(map)
}

/// Who has an external id.
enum Holder {
    Nobody,
    SameContent(Box<Reference>),
    /// It was damaged and is removed: sending its image again is how a map is healed.
    Removed(Replaced),
}

/// A damaged reference that made way for its image sent again: its number, and its identity as far
/// as it can be read.
pub(super) type Replaced = (i64, ReferenceId);

/// Looks up the holder of an external id; an error if its content is another.
fn holder(
    connection: &Connection,
    map: &MapRow,
    external_id: &ExternalId,
    content_hash: ContentHash,
) -> Result<Holder, StoreError> {
    let looking = failed("looking up an external id");
    let Some(number) = number_of_external(connection, map.number, external_id).map_err(&looking)?
    else {
        return Ok(Holder::Nobody);
    };
    let quarantined = connection
        .prepare_cached("SELECT 1 FROM quarantine WHERE number = ?1")
        .and_then(|mut statement| statement.exists([number]))
        .map_err(&looking)?;
    match rows::reference_by_number(connection, number) {
        Ok(Some(existing)) if !quarantined && existing.content_hash == content_hash => {
            Ok(Holder::SameContent(Box::new(existing)))
        }
        Ok(Some(existing)) if !quarantined => Err(StoreError::ExternalIdConflict {
            map: map.name.clone(),
            external_id: external_id.clone(),
            existing: existing.id,
        }),
        Ok(_) | Err(RowError::Damaged(_)) => {
            let id = rows::id_of(connection, number);
            remove(connection, map, number).map_err(&looking)?;
            Ok(Holder::Removed((number, id)))
        }
        Err(RowError::Engine(error)) => Err(looking(error)),
    }
}

/// The number of the reference with this external id.
pub(super) fn number_of_external(
    connection: &Connection,
    map: i64,
    external_id: &ExternalId,
) -> rusqlite::Result<Option<i64>> {
    connection
        .prepare_cached("SELECT number FROM reference WHERE map = ?1 AND external_id = ?2")?
        .query_row(params![map, external_id.as_str()], |row| row.get(0))
        .optional()
}

fn reference_row(new: &Prepared, map: &MapRow, number: i64) -> ReferenceRow {
    let mut row = ReferenceRow {
        number,
        id: *ReferenceId::generate().as_bytes(),
        map: map.number,
        external_id: None,
        lat: None,
        lon: None,
        heading: None,
        captured_at: None,
        metadata: None,
        content_hash: new.content_hash.0,
        created_at: to_micros(OffsetDateTime::now_utc()),
    };
    row.set_fields(&new.fields);
    row
}

/// Writes a reference's row, replacing the one with its number.
pub(super) fn write_row(connection: &Connection, row: &ReferenceRow) -> rusqlite::Result<()> {
    connection
        .prepare_cached(
            "INSERT INTO reference (number, id, map, external_id, lat, lon, heading, captured_at, metadata,
                                    content_hash, created_at, checksum)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12)
             ON CONFLICT (number) DO UPDATE SET external_id = ?4, lat = ?5, lon = ?6, heading = ?7,
                                    captured_at = ?8, metadata = ?9, checksum = ?12",
        )?
        .execute(params![
            row.number,
            row.id.as_slice(),
            row.map,
            row.external_id,
            row.lat,
            row.lon,
            row.heading,
            row.captured_at,
            row.metadata,
            row.content_hash.as_slice(),
            row.created_at,
            row.checksum()
        ])
        .map(|_| ())
}

fn write_parts(
    connection: &Connection,
    new: &Prepared,
    version: i64,
    number: i64,
) -> rusqlite::Result<()> {
    write_global(connection, version, number, &new.global)?;
    connection
        .prepare_cached("INSERT INTO pooled_vector (number, vector, checksum) VALUES (?1, ?2, ?3)")?
        .execute(params![
            number,
            new.pooled,
            pooled_checksum(number, &new.pooled)
        ])?;
    connection
        .prepare_cached("INSERT INTO patches (number, checksum, blob) VALUES (?1, ?2, ?3)")?
        .execute(params![
            number,
            patches_checksum(number, &new.patches),
            new.patches
        ])?;
    Ok(())
}

/// Writes a global vector of some version.
pub(super) fn write_global(
    connection: &Connection,
    version: i64,
    number: i64,
    vector: &[u8],
) -> rusqlite::Result<()> {
    connection
        .prepare_cached(
            "INSERT INTO global_vector (version, number, vector, checksum) VALUES (?1, ?2, ?3, ?4)",
        )?
        .execute(params![
            version,
            number,
            vector,
            global_checksum(version, number, vector)
        ])
        .map(|_| ())
}

/// Removes a reference with all its parts and keeps the map's count.
pub(super) fn remove(connection: &Connection, map: &MapRow, number: i64) -> rusqlite::Result<()> {
    for version in [Some(map.version), map.pending_version]
        .into_iter()
        .flatten()
    {
        connection
            .prepare_cached("DELETE FROM global_vector WHERE version = ?1 AND number = ?2")?
            .execute([version, number])?;
    }
    purge::remove_parts(connection, number)?;
    count(connection, map.number, -1)
}

fn count(connection: &Connection, map: i64, change: i64) -> rusqlite::Result<()> {
    connection
        .prepare_cached("UPDATE map SET reference_count = reference_count + ?2 WHERE number = ?1")?
        .execute([map, change])
        .map(|_| ())
}

/// Takes the next number of a sequence; numbers are never used twice.
pub(super) fn next_in_sequence(connection: &Connection, name: &str) -> rusqlite::Result<i64> {
    connection
        .prepare_cached("UPDATE sequence SET next = next + 1 WHERE name = ?1 RETURNING next - 1")?
        .query_row([name], |row| row.get(0))
}

//! Giving a map another head: new global vectors from the pooled vectors that are kept, without the images.
//!
//! The new vectors are written beside the old as another version, batch by batch, while queries and inserts go on
//! with the old. One last small transaction makes the map use the new version and binds it to the new model; it
//! commits only if no reference was added since the last batch, otherwise that batch comes first. A crash before
//! leaves the map as it was; the unfinished version is removed at the next start.

use super::engine::failed;
use super::insert::{check_global, next_in_sequence, write_global};
use super::rows::{self, MapRow, RowError};
use super::writer::Effect;
use super::{SqliteStore, purge, read};
use crate::store::{StoreError, codec, crash_points};
use crate::types::{GLOBAL_DIM, MapName, ModelId};
use rusqlite::Connection;

/// References converted per transaction.
const BATCH: i64 = 512;

impl SqliteStore {
    pub(super) fn exchange_head(
        &self,
        map: &MapName,
        new_model: ModelId,
        compute: &mut dyn FnMut(&[f32]) -> Vec<f32>,
    ) -> Result<(), StoreError> {
        let name = map.clone();
        let (number, version) = self.writer.run(Effect::Grows(0), move |connection| begin(connection, &name))?;
        let exchanged = self.convert(map, number, version, &new_model, compute);
        if exchanged.is_err() {
            // Whatever went wrong is what the caller hears; the next start cleans up if this fails as well.
            let _ = self.writer.run(Effect::Shrinks, move |connection| abandon(connection, number, version));
        }
        exchanged
    }

    fn convert(
        &self,
        map: &MapName,
        number: i64,
        version: i64,
        new_model: &ModelId,
        compute: &mut dyn FnMut(&[f32]) -> Vec<f32>,
    ) -> Result<(), StoreError> {
        let mut last = 0;
        loop {
            let batch = self.reading(|connection| self.pooled_behind(connection, number, last))?;
            let Some(&(newest, _)) = batch.last() else {
                let (name, model) = (map.clone(), new_model.clone());
                let finish = move |connection: &Connection| finish(connection, &name, &model, version, last);
                // Freeing the old version follows, so finishing may use the reserve.
                if self.writer.run(Effect::Shrinks, finish)? {
                    return Ok(());
                }
                continue;
            };
            last = newest;
            let mut vectors = Vec::with_capacity(batch.len());
            for (number, pooled) in batch {
                let Some(pooled) = pooled else { continue };
                let global = compute(&pooled);
                check_global(&global)?;
                vectors.push((number, codec::encode_f32(&global)));
            }
            let (name, bytes) = (map.clone(), vectors.len() * GLOBAL_DIM * 4);
            let write = move |connection: &Connection| write_batch(connection, &name, version, &vectors);
            self.writer.run(Effect::Grows(bytes), write)?;
            crash_points::reach(crash_points::MID_REHEAD);
        }
    }

    /// The next pooled vectors by number; `None` for damaged ones, which are quarantined and left without a vector.
    #[allow(clippy::type_complexity, reason = "a list of pairs; a name would hide that")]
    fn pooled_behind(
        &self,
        connection: &Connection,
        map: i64,
        last: i64,
    ) -> Result<Vec<(i64, Option<Vec<f32>>)>, StoreError> {
        let reading = failed("reading pooled vectors");
        let sql = "SELECT r.number, p.vector, p.checksum FROM reference r
                   LEFT JOIN pooled_vector p ON p.number = r.number
                   WHERE r.map = ?1 AND r.number > ?2 ORDER BY r.number LIMIT ?3";
        let mut statement = connection.prepare_cached(sql).map_err(&reading)?;
        let mut found = statement.query([map, last, BATCH]).map_err(&reading)?;
        let mut batch = Vec::new();
        while let Some(row) = found.next().map_err(&reading)? {
            let number: i64 = row.get(0).map_err(&reading)?;
            let pooled = read::blob(row, 1)
                .and_then(|vector| Ok((vector, row.get(2)?)))
                .and_then(|(vector, checksum)| rows::read_pooled(number, vector, checksum));
            match pooled {
                Ok(pooled) => batch.push((number, Some(pooled))),
                Err(RowError::Damaged(reason)) => {
                    self.put_in_quarantine(number, map, rows::id_of(connection, number), &reason);
                    batch.push((number, None));
                }
                Err(RowError::Engine(error)) => return Err(reading(error)),
            }
        }
        Ok(batch)
    }
}

/// Reserves a version for the new vectors.
fn begin(connection: &Connection, name: &MapName) -> Result<(i64, i64), StoreError> {
    let mut map = MapRow::require(connection, name)?;
    if map.pending_version.is_some() {
        return Err(StoreError::ReheadInProgress { map: name.clone() });
    }
    let version = next_in_sequence(connection, "version").map_err(failed("beginning another head"))?;
    map.pending_version = Some(version);
    map.save(connection)?;
    Ok((map.number, version))
}

/// The map, if it is still the one whose head is being exchanged.
fn pending_map(connection: &Connection, name: &MapName, version: i64) -> Result<MapRow, StoreError> {
    let map = MapRow::require(connection, name)?;
    if map.pending_version == Some(version) { Ok(map) } else { Err(StoreError::MapNotFound { map: name.clone() }) }
}

fn write_batch(
    connection: &Connection,
    name: &MapName,
    version: i64,
    vectors: &[(i64, Vec<u8>)],
) -> Result<(), StoreError> {
    let writing = failed("writing vectors of another head");
    pending_map(connection, name, version)?;
    for (number, vector) in vectors {
        let still_there = connection
            .prepare_cached("SELECT 1 FROM reference WHERE number = ?1")
            .and_then(|mut statement| statement.exists([number]))
            .map_err(&writing)?;
        if still_there {
            write_global(connection, version, *number, vector).map_err(&writing)?;
        }
    }
    Ok(())
}

/// Makes the map use the new version, unless a reference was added behind `last`.
fn finish(
    connection: &Connection,
    name: &MapName,
    model: &ModelId,
    version: i64,
    last: i64,
) -> Result<bool, StoreError> {
    let finishing = failed("finishing another head");
    let mut map = pending_map(connection, name, version)?;
    let added = connection
        .prepare_cached("SELECT 1 FROM reference WHERE map = ?1 AND number > ?2")
        .and_then(|mut statement| statement.exists([map.number, last]))
        .map_err(&finishing)?;
    if added {
        return Ok(false);
    }
    purge::retire(connection, map.version).map_err(&finishing)?;
    map.version = version;
    map.pending_version = None;
    map.model = model.clone();
    // Distances under another head mean something else, so the old threshold would mislead.
    map.calibration = None;
    map.save(connection)?;
    Ok(true)
}

fn abandon(connection: &Connection, map: i64, version: i64) -> Result<(), StoreError> {
    connection
        .execute("UPDATE map SET pending_version = NULL WHERE number = ?1 AND pending_version = ?2", [map, version])
        .and_then(|_| purge::retire(connection, version))
        .map_err(failed("abandoning another head"))
}

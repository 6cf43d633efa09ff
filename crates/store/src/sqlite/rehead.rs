//! Giving a map another head: new global vectors from the pooled vectors that are kept, without the
//! images.
//!
//! The new vectors are written beside the old as another version, batch by batch, while queries and
//! inserts go on with the old. One last small transaction makes the map use the new version and
//! binds it to the new model; it commits only if no reference was added since the last batch,
//! otherwise that batch comes first. A crash before leaves the map as it was; the unfinished
//! version is removed at the next start. A head that the map is to keep is stored under the number
//! of its version before the first vector, so that it comes and goes with them.

use super::engine::{damage, failed};
use super::insert::{check_global, next_in_sequence, write_global};
use super::rows::{
    self, MapRow, REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceRow, RowError, head_checksum,
};
use super::writer::Effect;
use super::{SqliteStore, purge, read};
use crate::{GlobalRow, HeadExchange, NewHead, StoreError, codec, crash_points};
use placeformer_core::types::{GLOBAL_DIM, MapName, ModelId, ReferenceId};
use rusqlite::{Connection, OptionalExtension, Row, params};
use std::sync::Arc;

/// References converted per transaction.
const BATCH: i64 = 512;

/// A reference whose vector is to be made anew.
struct Source {
    number: i64,
    pooled: Vec<f32>,
    /// What an index needs of it, its vector still missing; absent while it is not served.
    row: Option<GlobalRow>,
}

/// References read together; the damaged ones among them are quarantined and left without a vector.
struct Batch {
    sources: Vec<Source>,
    /// The greatest number read; absent if there was nothing left to read.
    newest: Option<i64>,
}

impl SqliteStore {
    pub(super) fn exchange_head(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        let (name, model, file) = (map.clone(), head.model, head.file.map(Arc::new));
        let bytes = file.as_ref().map_or(0, |file| file.len());
        let (begun, bound) = (name.clone(), model.clone());
        let begin =
            move |connection: &Connection| begin(connection, &begun, &bound, file.as_deref());
        let (number, version) = self.writing(Effect::Grows(bytes), begin)?;
        let exchanged = self.convert(&name, number, version, &model, exchange);
        if exchanged.is_err() {
            // Whatever went wrong is what the caller hears; the next start cleans up if this fails
            // as well.
            let _ = self.writer.run(Effect::Shrinks, move |connection| {
                abandon(connection, number, version)
            });
        }
        exchanged
    }

    fn convert(
        &self,
        map: &MapName,
        number: i64,
        version: i64,
        model: &ModelId,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        let (mut last, mut finishing) = (0, false);
        loop {
            let Batch { sources, newest } =
                self.reading(|connection| self.pooled_behind(connection, number, last))?;
            let Some(newest) = newest else {
                if !finishing {
                    exchange.finishing();
                    finishing = true;
                    continue;
                }
                let (name, model) = (map.clone(), model.clone());
                let finish =
                    move |connection: &Connection| finish(connection, &name, &model, version, last);
                // Freeing the old version follows, so finishing may use the reserve.
                if self.writing(Effect::Shrinks, finish)? {
                    return Ok(());
                }
                continue;
            };
            last = newest;
            self.convert_batch(map, version, sources, exchange)?;
            crash_points::reach(crash_points::MID_REHEAD);
        }
    }

    fn convert_batch(
        &self,
        map: &MapName,
        version: i64,
        mut sources: Vec<Source>,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        let pooled: Vec<_> = sources
            .iter_mut()
            .map(|source| std::mem::take(&mut source.pooled))
            .collect();
        let globals = exchange.project(&pooled);
        if globals.len() != sources.len() {
            let reason = format!(
                "{} pooled vectors became {} global vectors",
                sources.len(),
                globals.len()
            );
            return Err(StoreError::InvalidDescriptor { reason });
        }
        globals.iter().try_for_each(|global| check_global(global))?;
        let encoded: Vec<_> = sources
            .iter()
            .zip(&globals)
            .map(|(s, global)| (s.number, codec::encode_f32(global)))
            .collect();
        let (name, bytes) = (map.clone(), encoded.len() * GLOBAL_DIM * 4);
        let write =
            move |connection: &Connection| write_batch(connection, &name, version, &encoded);
        self.writing(Effect::Grows(bytes), write)?;
        for (source, global) in sources.into_iter().zip(globals) {
            if let Some(row) = source.row {
                exchange.converted(GlobalRow { global, ..row });
            }
        }
        Ok(())
    }

    /// The next references by number with their pooled vectors.
    fn pooled_behind(
        &self,
        connection: &Connection,
        map: i64,
        last: i64,
    ) -> Result<Batch, StoreError> {
        let reading = failed("reading pooled vectors");
        let sql = format!(
            "SELECT {REFERENCE_COLUMNS}, p.vector, p.checksum FROM {REFERENCE_SOURCE}
             LEFT JOIN pooled_vector p ON p.number = r.number
             WHERE r.map = ?1 AND r.number > ?2 ORDER BY r.number LIMIT ?3"
        );
        let mut statement = connection.prepare_cached(&sql).map_err(&reading)?;
        let mut found = statement.query([map, last, BATCH]).map_err(&reading)?;
        let mut batch = Batch {
            sources: Vec::new(),
            newest: None,
        };
        while let Some(row) = found.next().map_err(&reading)? {
            let number: i64 = row.get(0).map_err(&reading)?;
            batch.newest = Some(number);
            match source(row, number) {
                Ok(source) if self.quarantine.contains(number) => batch.sources.push(Source {
                    row: None,
                    ..source
                }),
                Ok(source) => batch.sources.push(source),
                Err(RowError::Damaged(reason)) => {
                    self.put_in_quarantine(number, map, rows::id_of(connection, number), &reason);
                }
                Err(RowError::Engine(error)) => return Err(reading(error)),
            }
        }
        Ok(batch)
    }
}

fn source(row: &Row<'_>, number: i64) -> Result<Source, RowError> {
    let pooled = rows::read_pooled(number, read::blob(row, 14)?, row.get(15)?)?;
    let columns = ReferenceRow::read(row)?;
    let (location, captured_at) = columns.place_and_time()?;
    let reference: ReferenceId = columns.id();
    Ok(Source {
        number,
        pooled,
        row: Some(GlobalRow {
            reference,
            global: Vec::new(),
            location,
            captured_at,
        }),
    })
}

/// The file of the head that a map keeps for itself.
pub(super) fn read_head(
    connection: &Connection,
    map: &MapRow,
) -> Result<Option<Vec<u8>>, StoreError> {
    let damaged = || StoreError::CorruptHead {
        map: map.name.clone(),
    };
    let stored = connection
        .prepare_cached("SELECT file, checksum FROM map_head WHERE version = ?1")
        .and_then(|mut statement| {
            statement
                .query_row([map.version], |row| {
                    Ok((row.get::<_, Vec<u8>>(0)?, row.get::<_, i64>(1)?))
                })
                .optional()
        })
        .map_err(|error| {
            if damage(&error).is_some() {
                damaged()
            } else {
                failed("reading a map's head")(error)
            }
        })?;
    match stored {
        Some((file, checksum)) if checksum == head_checksum(map.version, &map.model, &file) => {
            Ok(Some(file))
        }
        Some(_) => Err(damaged()),
        None => Ok(None),
    }
}

/// Reserves a version for the new vectors, and stores the head that makes them if the map is to
/// keep it.
fn begin(
    connection: &Connection,
    name: &MapName,
    model: &ModelId,
    file: Option<&Vec<u8>>,
) -> Result<(i64, i64), StoreError> {
    let beginning = failed("beginning another head");
    let mut map = MapRow::require(connection, name)?;
    if map.pending_version.is_some() {
        return Err(StoreError::ReheadInProgress { map: name.clone() });
    }
    let version = next_in_sequence(connection, "version").map_err(&beginning)?;
    map.pending_version = Some(version);
    map.save(connection)?;
    if let Some(file) = file {
        connection
            .execute(
                "INSERT INTO map_head (version, file, checksum) VALUES (?1, ?2, ?3)",
                params![version, file, head_checksum(version, model, file)],
            )
            .map_err(&beginning)?;
    }
    Ok((map.number, version))
}

/// The map, if it is still the one whose head is being exchanged.
fn pending_map(
    connection: &Connection,
    name: &MapName,
    version: i64,
) -> Result<MapRow, StoreError> {
    let map = MapRow::require(connection, name)?;
    if map.pending_version == Some(version) {
        Ok(map)
    } else {
        Err(StoreError::MapNotFound { map: name.clone() })
    }
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
        .execute(
            "UPDATE map SET pending_version = NULL WHERE number = ?1 AND pending_version = ?2",
            [map, version],
        )
        .and_then(|_| purge::retire(connection, version))
        .map_err(failed("abandoning another head"))
}

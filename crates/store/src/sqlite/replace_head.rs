//! Giving a map another head: new global vectors from the pooled vectors that are kept, without
//! the images.
//!
//! The new vectors are written as another version, batch by batch, while queries and inserts go on
//! with the old ones. One last small transaction makes the map use the new version and binds it to
//! the new model. It commits only if no reference was added since the last batch; otherwise those
//! get their vectors first. A crash before leaves the map as it was, and the unfinished version is
//! removed at the next start.
//!
//! A head that the map is to keep is stored before its first vector, under the number of its
//! version, so that the head is removed when the version is.

use super::database::Database;
use super::engine::{damage, failed};
use super::insert::check_global;
use super::job::Effect;
use super::keys::{MapNumber, ReferenceNumber, Version};
use super::map_row::MapRow;
use super::parts::{head_checksum, read_pooled, write_global};
use super::purge;
use super::quarantine::DamagedReference;
use super::reference_row::{REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceColumns, exists, id_of};
use super::row::{RowError, blob};
use super::sequence::next_version;
use crate::error::StoreError;
use crate::records::{GlobalRow, NewHead};
use crate::traits::HeadExchange;
use crate::{codec, crash_points};
use placeformer_core::types::{GLOBAL_DIM, MapName, ModelId};
use rusqlite::{Connection, OptionalExtension, Row, Statement, named_params};
use std::sync::Arc;

/// References converted per transaction.
const BATCH: i64 = 512;

/// A head exchange under way.
#[derive(Clone)]
struct Exchange {
    name: MapName,
    map: MapNumber,
    /// The version that the new vectors are written as.
    version: Version,
    /// The map's model once the exchange is done.
    model: ModelId,
}

/// A reference whose vector is to be made anew.
struct Source {
    number: ReferenceNumber,
    pooled: Vec<f32>,
    /// What an index needs of the reference, its global vector still empty; none if the reference
    /// is not served.
    row: Option<GlobalRow>,
}

/// References read together; the damaged ones among them are quarantined and left without a
/// vector.
struct Batch {
    sources: Vec<Source>,
    /// The greatest number read; none if there was nothing left to read.
    newest: Option<ReferenceNumber>,
}

impl Database {
    /// Gives a map another head.
    pub(super) fn replace_head(
        &self,
        map: &MapName,
        head: NewHead,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        // Shared, because the writer may run the job more than once.
        let file = head.file.map(Arc::new);
        let bytes = file.as_ref().map_or(0, |file| file.len());
        let name = map.clone();
        let model = head.model;
        let begun = self.write(Effect::Grows(bytes), move |connection| {
            begin(connection, &name, &model, file.as_deref())
        })?;
        let converted = self.convert_all(&begun, exchange);
        if converted.is_err() {
            // The caller needs the error that stopped the exchange. If abandoning it fails as
            // well, the next start does that.
            let _ = self.writer.run(Effect::Shrinks, move |connection| {
                abandon(connection, &begun)
            });
        }
        converted
    }

    /// Converts batch after batch until the map has changed to the new version.
    fn convert_all(
        &self,
        begun: &Exchange,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        let mut last = ReferenceNumber::BEFORE_ALL;
        let mut is_finishing = false;
        loop {
            let batch = self.read(|connection| self.pooled_behind(connection, begun.map, last))?;
            if let Some(newest) = batch.newest {
                last = newest;
                self.convert(begun, batch.sources, exchange)?;
                crash_points::reach(crash_points::MID_REHEAD);
                continue;
            }
            if !is_finishing {
                exchange.finishing();
                is_finishing = true;
                continue;
            }
            let ending = begun.clone();
            // What follows is the removal of the old version, so finishing may use the reserve.
            let is_finished = self.write(Effect::Shrinks, move |connection| {
                finish(connection, &ending, last)
            })?;
            if is_finished {
                return Ok(());
            }
        }
    }

    /// Makes the new vectors of `sources` durable.
    fn convert(
        &self,
        begun: &Exchange,
        mut sources: Vec<Source>,
        exchange: &mut dyn HeadExchange,
    ) -> Result<(), StoreError> {
        let pooled: Vec<Vec<f32>> = sources
            .iter_mut()
            .map(|source| std::mem::take(&mut source.pooled))
            .collect();
        let globals = exchange.project(&pooled)?;
        check_projected(&pooled, &globals)?;
        let encoded: Vec<(ReferenceNumber, Vec<u8>)> = sources
            .iter()
            .zip(&globals)
            .map(|(source, global)| (source.number, codec::encode_f32(global)))
            .collect();
        let bytes = encoded.len() * GLOBAL_DIM * 4;
        let writing = begun.clone();
        self.write(Effect::Grows(bytes), move |connection| {
            write_batch(connection, &writing, &encoded)
        })?;
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
        map: MapNumber,
        last: ReferenceNumber,
    ) -> Result<Batch, StoreError> {
        let failed = failed("reading pooled vectors");
        let sql = format!(
            "SELECT {REFERENCE_COLUMNS}, p.vector AS vector, p.checksum AS vector_checksum
             FROM {REFERENCE_SOURCE} LEFT JOIN pooled_vector p ON p.number = r.number
             WHERE r.map = :map AND r.number > :last ORDER BY r.number LIMIT :limit"
        );
        let mut statement = connection.prepare_cached(&sql).map_err(&failed)?;
        let columns = PooledColumns::of(&statement).map_err(&failed)?;
        let mut rows = statement
            .query(named_params! { ":map": map, ":last": last, ":limit": BATCH })
            .map_err(&failed)?;
        let mut batch = Batch {
            sources: Vec::new(),
            newest: None,
        };
        while let Some(row) = rows.next().map_err(&failed)? {
            let number = columns.reference.number(row).map_err(&failed)?;
            batch.newest = Some(number);
            match columns.read(row) {
                Ok(mut source) => {
                    if self.quarantine.contains(number) {
                        source.row = None;
                    }
                    batch.sources.push(source);
                }
                Err(RowError::Damaged(reason)) => self.put_in_quarantine(DamagedReference {
                    number,
                    map,
                    id: id_of(connection, number),
                    reason,
                }),
                Err(RowError::Engine(error)) => return Err(failed(error)),
            }
        }
        Ok(batch)
    }
}

/// Refuses what a projection must not return.
fn check_projected(pooled: &[Vec<f32>], globals: &[Vec<f32>]) -> Result<(), StoreError> {
    if globals.len() != pooled.len() {
        let reason = format!(
            "{} pooled vectors became {} global vectors",
            pooled.len(),
            globals.len()
        );
        return Err(StoreError::InvalidDescriptor { reason });
    }
    globals.iter().try_for_each(|global| check_global(global))
}

/// Where the columns of a reference and its pooled vector are in a statement, found by their
/// names.
struct PooledColumns {
    reference: ReferenceColumns,
    vector: usize,
    vector_checksum: usize,
}

impl PooledColumns {
    fn of(statement: &Statement<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
            reference: ReferenceColumns::of(statement)?,
            vector: statement.column_index("vector")?,
            vector_checksum: statement.column_index("vector_checksum")?,
        })
    }

    fn read(&self, row: &Row<'_>) -> Result<Source, RowError> {
        let number = self.reference.number(row)?;
        let vector = blob(row, self.vector)?;
        let pooled = read_pooled(number, vector, row.get(self.vector_checksum)?)?;
        let columns = self.reference.read(row)?;
        Ok(Source {
            number,
            pooled,
            row: Some(GlobalRow {
                reference: columns.id(),
                global: Vec::new(),
                location: columns.location()?,
                alt: columns.alt()?,
                heading: columns.heading()?,
                captured_at: columns.captured_at()?,
            }),
        })
    }
}

/// The file of the head that a map keeps for itself.
pub(super) fn read_head(
    connection: &Connection,
    map: &MapRow,
) -> Result<Option<Vec<u8>>, StoreError> {
    let corrupt = || StoreError::CorruptHead {
        map: map.name.clone(),
    };
    let read = || -> rusqlite::Result<Option<(Vec<u8>, i64)>> {
        let sql = "SELECT file, checksum FROM map_head WHERE version = ?1";
        let mut statement = connection.prepare_cached(sql)?;
        let head = statement.query_row([map.version], |row| {
            Ok((row.get("file")?, row.get("checksum")?))
        });
        head.optional()
    };
    let stored = read().map_err(|error| match damage(&error) {
        Some(_) => corrupt(),
        None => failed("reading a map's head")(error),
    })?;
    match stored {
        Some((file, checksum)) if checksum == head_checksum(map.version, &map.model, &file) => {
            Ok(Some(file))
        }
        Some(_) => Err(corrupt()),
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
) -> Result<Exchange, StoreError> {
    let failed = failed("beginning another head");
    let mut map = MapRow::require(connection, name)?;
    if map.pending_version.is_some() {
        return Err(StoreError::ReheadInProgress { map: name.clone() });
    }
    let version = next_version(connection).map_err(&failed)?;
    map.pending_version = Some(version);
    map.save(connection)?;
    if let Some(file) = file {
        connection
            .execute(
                "INSERT INTO map_head (version, file, checksum)
                 VALUES (:version, :file, :checksum)",
                named_params! {
                    ":version": version,
                    ":file": file,
                    ":checksum": head_checksum(version, model, file),
                },
            )
            .map_err(&failed)?;
    }
    Ok(Exchange {
        name: name.clone(),
        map: map.number,
        version,
        model: model.clone(),
    })
}

/// The map, if it is still the one that this exchange began with.
fn pending_map(connection: &Connection, begun: &Exchange) -> Result<MapRow, StoreError> {
    let map = MapRow::require(connection, &begun.name)?;
    if map.pending_version == Some(begun.version) {
        Ok(map)
    } else {
        Err(StoreError::MapNotFound {
            map: begun.name.clone(),
        })
    }
}

fn write_batch(
    connection: &Connection,
    begun: &Exchange,
    vectors: &[(ReferenceNumber, Vec<u8>)],
) -> Result<(), StoreError> {
    pending_map(connection, begun)?;
    let write = || -> rusqlite::Result<()> {
        for (number, vector) in vectors {
            // The reference may have been deleted since it was read.
            if exists(connection, *number)? {
                write_global(connection, begun.version, *number, vector)?;
            }
        }
        Ok(())
    };
    write().map_err(failed("writing vectors of another head"))
}

/// Makes the map use the new version. False, and nothing is done, if a reference was added behind
/// `last`.
fn finish(
    connection: &Connection,
    begun: &Exchange,
    last: ReferenceNumber,
) -> Result<bool, StoreError> {
    let failed = failed("finishing another head");
    let mut map = pending_map(connection, begun)?;
    let sql = "SELECT 1 FROM reference WHERE map = :map AND number > :last";
    let was_added = connection
        .prepare_cached(sql)
        .and_then(|mut statement| {
            statement.exists(named_params! { ":map": map.number, ":last": last })
        })
        .map_err(&failed)?;
    if was_added {
        return Ok(false);
    }
    purge::retire(connection, map.version).map_err(&failed)?;
    map.version = begun.version;
    map.pending_version = None;
    map.model = begun.model.clone();
    // Distances under another head mean something else, so the old threshold would mislead.
    map.calibration = None;
    map.save(connection)?;
    Ok(true)
}

/// Gives the exchange up: the map keeps its old version, and the new vectors are removed.
fn abandon(connection: &Connection, begun: &Exchange) -> Result<(), StoreError> {
    let sql = "UPDATE map SET pending_version = NULL
               WHERE number = :map AND pending_version = :version";
    connection
        .execute(
            sql,
            named_params! { ":map": begun.map, ":version": begun.version },
        )
        .and_then(|_| purge::retire(connection, begun.version))
        .map_err(failed("abandoning another head"))
}

//! Streaming the global vectors of a map, from which its index is rebuilt.
//!
//! One statement reads them all. Three kinds of damage are distinguished: a row that fails its
//! checksum is quarantined by the scan; a reference without a vector shows as a difference between
//! the count of vectors and that of references; and where the engine cannot read a page of the
//! database, the scan goes on reference by reference.

use super::database::Database;
use super::engine::{damage, failed};
use super::keys::{ReferenceNumber, Version};
use super::map_row::MapRow;
use super::parts;
use super::quarantine::DamagedReference;
use super::reference_row::{REFERENCE_COLUMNS, ReferenceColumns, id_of};
use super::row::{RowError, blob};
use crate::error::StoreError;
use crate::records::GlobalRow;
use placeformer_core::types::{MapName, ReferenceId};
use rusqlite::{Connection, Row, Statement, named_params};

/// The range of numbers that a scan reads.
#[derive(Clone, Copy)]
enum Range {
    /// Everything behind a number.
    Behind(ReferenceNumber),
    /// One number.
    At(ReferenceNumber),
}

/// How far a scan of global vectors has come.
struct Progress {
    /// The last number read.
    last: ReferenceNumber,
    /// Vectors read, sound or not.
    read: u64,
    /// Whether a row failed its checksum.
    found_damage: bool,
}

/// Where the columns of the scan's statement are, found by their names.
struct GlobalColumns {
    reference: ReferenceColumns,
    vector: usize,
    vector_checksum: usize,
}

impl GlobalColumns {
    fn of(statement: &Statement<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
            reference: ReferenceColumns::of(statement)?,
            vector: statement.column_index("vector")?,
            vector_checksum: statement.column_index("vector_checksum")?,
        })
    }

    fn read(&self, row: &Row<'_>, version: Version) -> Result<GlobalRow, RowError> {
        let columns = self.reference.read(row)?;
        let vector = blob(row, self.vector)?;
        let checksum = row.get(self.vector_checksum)?;
        Ok(GlobalRow {
            reference: columns.id(),
            global: parts::read_global(version, columns.number, vector, checksum)?,
            location: columns.location()?,
            alt: columns.alt()?,
            heading: columns.heading()?,
            captured_at: columns.captured_at()?,
        })
    }
}

impl Database {
    /// Visits the global vectors of a map out of one snapshot, and quarantines references that
    /// have none.
    pub(super) fn scan_globals(
        &self,
        connection: &Connection,
        map: &MapName,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        let failed = failed("reading global vectors");
        // Without a snapshot, a head exchanged meanwhile could remove the version being read.
        let snapshot = connection.unchecked_transaction().map_err(&failed)?;
        let map = MapRow::require(&snapshot, map)?;
        let mut progress = Progress {
            last: ReferenceNumber::BEFORE_ALL,
            read: 0,
            found_damage: false,
        };
        let range = Range::Behind(progress.last);
        match self.scan(&snapshot, &map, range, &mut progress, visit) {
            Ok(()) => self.quarantine_lost_globals(&snapshot, &map, &progress),
            Err(error) if damage(&error).is_some() => {
                self.scan_one_by_one(&snapshot, &map, progress.last, visit)
            }
            Err(error) => Err(failed(error)),
        }
    }

    /// Visits the vectors in `range`, and keeps `progress` up to date on the way.
    fn scan(
        &self,
        connection: &Connection,
        map: &MapRow,
        range: Range,
        progress: &mut Progress,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> rusqlite::Result<()> {
        let (condition, number) = match range {
            Range::Behind(number) => ("g.number > :number", number),
            Range::At(number) => ("g.number = :number", number),
        };
        // CROSS JOIN fixes the order of the loops: vectors outside, so that they come in the order
        // in which they lie on disk.
        let sql = format!(
            "SELECT {REFERENCE_COLUMNS}, g.vector AS vector, g.checksum AS vector_checksum
             FROM global_vector g CROSS JOIN reference r ON r.number = g.number
                                  CROSS JOIN map m ON m.number = r.map
             WHERE g.version = :version AND {condition} ORDER BY g.number"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let columns = GlobalColumns::of(&statement)?;
        let mut rows =
            statement.query(named_params! { ":version": map.version, ":number": number })?;
        while let Some(row) = rows.next()? {
            let number = columns.reference.number(row)?;
            progress.last = number;
            progress.read += 1;
            if self.quarantine.contains(number) {
                continue;
            }
            match columns.read(row, map.version) {
                Ok(global) => visit(global),
                Err(RowError::Damaged(reason)) => {
                    progress.found_damage = true;
                    self.put_in_quarantine(DamagedReference {
                        number,
                        map: columns.reference.map_or_unknown(row),
                        id: columns.reference.id_or_zeros(row),
                        reason,
                    });
                }
                Err(RowError::Engine(error)) => return Err(error),
            }
        }
        Ok(())
    }

    /// Quarantines the references of a map that the scan did not come across because they have no
    /// global vector.
    ///
    /// Looking for them takes long, so it is done only if there can be any: if the scan read fewer
    /// vectors than the map has references, or found a damaged row. The number in a damaged row
    /// may be wrong, so that the row counts for another reference and the counts agree by
    /// accident.
    fn quarantine_lost_globals(
        &self,
        connection: &Connection,
        map: &MapRow,
        progress: &Progress,
    ) -> Result<(), StoreError> {
        let failed = failed("counting references");
        let sql = "SELECT count(*) AS count FROM reference INDEXED BY reference_by_map_number
                   WHERE map = ?1";
        let references: i64 = connection
            .query_row(sql, [map.number], |row| row.get("count"))
            .map_err(&failed)?;
        if references as u64 == progress.read && !progress.found_damage {
            return Ok(());
        }
        for (number, id) in references_without_vector(connection, map).map_err(&failed)? {
            self.put_in_quarantine(DamagedReference {
                number,
                map: map.number,
                id,
                reason: "its global vector is missing".to_owned(),
            });
        }
        Ok(())
    }

    /// Goes on behind `last`, one reference at a time, where the engine could not read a page.
    fn scan_one_by_one(
        &self,
        connection: &Connection,
        map: &MapRow,
        last: ReferenceNumber,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        let failed = failed("reading global vectors one by one");
        for number in numbers_behind(connection, map, last).map_err(&failed)? {
            let mut progress = Progress {
                last: number,
                read: 0,
                found_damage: false,
            };
            let scanned = self.scan(connection, map, Range::At(number), &mut progress, visit);
            let reason = match scanned {
                Ok(()) if progress.read > 0 => continue,
                Ok(()) => "its global vector is missing".to_owned(),
                Err(error) => match damage(&error) {
                    Some(reason) => reason,
                    None => return Err(failed(error)),
                },
            };
            self.put_in_quarantine(DamagedReference {
                number,
                map: map.number,
                id: id_of(connection, number),
                reason,
            });
        }
        Ok(())
    }
}

/// Number and identity of the references of a map that have no global vector.
fn references_without_vector(
    connection: &Connection,
    map: &MapRow,
) -> rusqlite::Result<Vec<(ReferenceNumber, ReferenceId)>> {
    let sql = "SELECT r.number AS number, r.id AS id
               FROM reference r INDEXED BY reference_by_map
               WHERE r.map = :map AND NOT EXISTS
                   (SELECT 1 FROM global_vector g
                    WHERE g.version = :version AND g.number = r.number)";
    let mut statement = connection.prepare_cached(sql)?;
    let parameters = named_params! { ":map": map.number, ":version": map.version };
    let rows = statement.query_map(parameters, |row| {
        let id = ReferenceId::from_bytes(row.get("id")?);
        Ok((row.get("number")?, id))
    })?;
    rows.collect()
}

/// Numbers of a map's references behind `last`, out of an index alone.
fn numbers_behind(
    connection: &Connection,
    map: &MapRow,
    last: ReferenceNumber,
) -> rusqlite::Result<Vec<ReferenceNumber>> {
    let sql = "SELECT number FROM reference INDEXED BY reference_by_map_number
               WHERE map = :map AND number > :last ORDER BY number";
    let mut statement = connection.prepare_cached(sql)?;
    let parameters = named_params! { ":map": map.number, ":last": last };
    let numbers = statement.query_map(parameters, |row| row.get("number"))?;
    numbers.collect()
}

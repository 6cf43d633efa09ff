//! Everything that reads references. A damaged row is quarantined where it is met, and the rest is
//! served.

use super::engine::{damage, failed};
use super::rows::{self, MapRow, REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceRow, RowError};
use super::{SqliteStore, insert};
use crate::{GlobalRow, Page, StoreError};
use placeformer_core::types::{ExternalId, MapName, PackedPatches, Reference, ReferenceId};
use rusqlite::{Connection, Row};

/// Binds the range of a keyset page: the map or all, and the identity to start behind.
const PAGE_OF_MAP: &str = "WHERE r.map = ?1 AND r.id > ?2 ORDER BY r.id";
const PAGE_OF_ALL: &str = "WHERE ?1 IS NULL AND r.id > ?2 ORDER BY r.id";

/// The same identities out of an index alone.
const IDS_OF_MAP: &str = "SELECT r.id FROM reference r INDEXED BY reference_by_map WHERE r.map = ?1 AND r.id > ?2 ORDER BY r.id";
const IDS_OF_ALL: &str = "SELECT r.id FROM reference r INDEXED BY reference_by_id WHERE ?1 IS NULL AND r.id > ?2 ORDER BY r.id";

impl Page {
    /// Whether it holds `limit` references; called only where there is another one, so it then says
    /// where that begins.
    fn is_full(&mut self, limit: usize) -> bool {
        let full = self.references.len() == limit;
        if full {
            self.next = self.references.last().map(|last| last.id);
        }
        full
    }
}

impl SqliteStore {
    /// Refuses a quarantined reference with the reason.
    pub(super) fn refuse_damaged(&self, id: ReferenceId, number: i64) -> Result<(), StoreError> {
        self.quarantine
            .reason(number)
            .map_or(Ok(()), |reason| Err(StoreError::Corrupt { id, reason }))
    }

    fn locate(&self, connection: &Connection, id: ReferenceId) -> Result<i64, StoreError> {
        let located = rows::locate(connection, id).inspect_err(|error| {
            if matches!(error, StoreError::Corrupt { .. }) {
                self.quarantine.met(id.to_string(), Some(id));
            }
        });
        Ok(located?.0)
    }

    /// Settles a failed read of a reference: damage is quarantined and reported as such.
    fn settle<T>(
        &self,
        connection: &Connection,
        id: ReferenceId,
        number: i64,
        context: &'static str,
        read: Result<Option<T>, RowError>,
    ) -> Result<T, StoreError> {
        match read {
            Ok(Some(value)) => Ok(value),
            Ok(None) => self.settle_missing(connection, id, number),
            Err(RowError::Damaged(reason)) => {
                let map = rows::locate(connection, id).map_or(0, |(_, map)| map);
                self.put_in_quarantine(number, map, id, &reason);
                Err(StoreError::Corrupt { id, reason })
            }
            Err(RowError::Engine(error)) => Err(failed(context)(error)),
        }
    }

    /// A part that is not there: the reference was deleted meanwhile, or the part is lost.
    fn settle_missing<T>(
        &self,
        connection: &Connection,
        id: ReferenceId,
        number: i64,
    ) -> Result<T, StoreError> {
        let (_, map) = rows::locate(connection, id)?;
        let reason = "a part of it is missing".to_owned();
        self.put_in_quarantine(number, map, id, &reason);
        Err(StoreError::Corrupt { id, reason })
    }

    pub(super) fn read_reference(
        &self,
        connection: &Connection,
        id: ReferenceId,
    ) -> Result<Reference, StoreError> {
        let number = self.locate(connection, id)?;
        self.refuse_damaged(id, number)?;
        let read = rows::reference_by_number(connection, number).and_then(|found| match found {
            Some(reference) if reference.id != id => {
                Err(RowError::Damaged("its row holds another identity".into()))
            }
            found => Ok(found),
        });
        self.settle(connection, id, number, "reading a reference", read)
    }

    pub(super) fn read_patches(
        &self,
        connection: &Connection,
        id: ReferenceId,
    ) -> Result<PackedPatches, StoreError> {
        let number = self.locate(connection, id)?;
        self.refuse_damaged(id, number)?;
        let read = || -> Result<Option<PackedPatches>, RowError> {
            let sql = "SELECT blob, checksum FROM patches WHERE number = ?1";
            let mut statement = connection.prepare_cached(sql)?;
            let mut found = statement.query([number])?;
            let Some(row) = found.next()? else {
                return Ok(None);
            };
            rows::read_patches(number, blob(row, 0)?, row.get(1)?).map(Some)
        };
        self.settle(connection, id, number, "reading key patches", read())
    }

    pub(super) fn read_external(
        &self,
        connection: &Connection,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        let Some(map) = MapRow::find(connection, map)? else {
            return Ok(None);
        };
        let finding = failed("finding an external id");
        let Some(number) =
            insert::number_of_external(connection, map.number, external_id).map_err(&finding)?
        else {
            return Ok(None);
        };
        let id = connection
            .query_row(
                "SELECT id FROM reference WHERE number = ?1",
                [number],
                |row| row.get(0),
            )
            .map(ReferenceId::from_bytes)
            .map_err(&finding)?;
        self.read_reference(connection, id).map(Some)
    }

    pub(super) fn read_page(
        &self,
        connection: &Connection,
        map: Option<&MapName>,
        after: Option<ReferenceId>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        let map = map
            .map(|name| MapRow::require(connection, name))
            .transpose()?
            .map(|map| map.number);
        let mut page = Page {
            references: Vec::new(),
            next: None,
        };
        match self.fill_page(connection, map, after, limit, &mut page) {
            Err(StoreError::Damaged { .. }) => {
                self.fill_page_singly(connection, map, after, limit, &mut page)?
            }
            outcome => outcome?,
        }
        Ok(page)
    }

    fn fill_page(
        &self,
        connection: &Connection,
        map: Option<i64>,
        after: Option<ReferenceId>,
        limit: usize,
        page: &mut Page,
    ) -> Result<(), StoreError> {
        let listing = failed("listing references");
        let range = if map.is_some() {
            PAGE_OF_MAP
        } else {
            PAGE_OF_ALL
        };
        let sql = format!("SELECT {REFERENCE_COLUMNS} FROM {REFERENCE_SOURCE} {range}");
        let mut statement = connection.prepare_cached(&sql).map_err(&listing)?;
        let start: &[u8] = after.as_ref().map_or(&[], |id| id.as_bytes());
        let mut found = statement.query((map, start)).map_err(&listing)?;
        while let Some(row) = found.next().map_err(&listing)? {
            if page.is_full(limit) {
                return Ok(());
            }
            let number: i64 = row.get(0).map_err(&listing)?;
            if self.quarantine.contains(number) {
                continue;
            }
            match rows::read_reference(row) {
                Ok(reference) => page.references.push(reference),
                Err(RowError::Damaged(reason)) => self.quarantine_row(row, number, &reason),
                Err(RowError::Engine(error)) => return Err(listing(error)),
            }
        }
        Ok(())
    }

    /// Steps over what the engine cannot read: identities come from the index, each reference is
    /// read by itself.
    fn fill_page_singly(
        &self,
        connection: &Connection,
        map: Option<i64>,
        after: Option<ReferenceId>,
        limit: usize,
        page: &mut Page,
    ) -> Result<(), StoreError> {
        let listing = failed("listing references one by one");
        let start = page.references.last().map(|last| last.id).or(after);
        let start: &[u8] = start.as_ref().map_or(&[], |id| id.as_bytes());
        let sql = if map.is_some() {
            IDS_OF_MAP
        } else {
            IDS_OF_ALL
        };
        let mut statement = connection.prepare_cached(sql).map_err(&listing)?;
        let mut ids = statement.query((map, start)).map_err(&listing)?;
        while let Some(row) = ids.next().map_err(&listing)? {
            if page.is_full(limit) {
                return Ok(());
            }
            let id = ReferenceId::from_bytes(row.get(0).map_err(&listing)?);
            match self.read_reference(connection, id) {
                Ok(reference) => page.references.push(reference),
                Err(StoreError::Corrupt { .. } | StoreError::ReferenceNotFound { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Streams the global vectors of a map out of one snapshot, and quarantines references that
    /// have none.
    pub(super) fn read_globals(
        &self,
        connection: &Connection,
        map: &MapRow,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        let mut scan = Scan {
            last: i64::MIN,
            met: 0,
            damaged: false,
        };
        match self.scan_range(connection, map, GLOBALS_BEHIND, &mut scan, visit) {
            Err(error) if damage(&error).is_some() => {
                self.read_globals_singly(connection, map, scan.last, visit)
            }
            Err(error) => Err(failed("reading global vectors")(error)),
            Ok(()) => self.quarantine_lost_globals(connection, map, &scan),
        }
    }

    /// References without a global vector are invisible to the scan, so they are counted. A damaged
    /// row may stand for another than it belongs to, which leaves the count as it was.
    fn quarantine_lost_globals(
        &self,
        connection: &Connection,
        map: &MapRow,
        scan: &Scan,
    ) -> Result<(), StoreError> {
        let counting = failed("counting references");
        let count =
            "SELECT count(*) FROM reference INDEXED BY reference_by_map_number WHERE map = ?1";
        let there: i64 = connection
            .query_row(count, [map.number], |row| row.get(0))
            .map_err(&counting)?;
        if there as u64 == scan.met && !scan.damaged {
            return Ok(());
        }
        let lost = "SELECT r.number, r.id FROM reference r INDEXED BY reference_by_map WHERE r.map = ?1
                    AND NOT EXISTS (SELECT 1 FROM global_vector g WHERE g.version = ?2 AND g.number = r.number)";
        let mut statement = connection.prepare_cached(lost).map_err(&counting)?;
        let mut found = statement
            .query([map.number, map.version])
            .map_err(&counting)?;
        while let Some(row) = found.next().map_err(&counting)? {
            let (number, id) = row
                .get(0)
                .and_then(|number| Ok((number, row.get(1)?)))
                .map_err(&counting)?;
            let id = ReferenceId::from_bytes(id);
            self.put_in_quarantine(number, map.number, id, "its global vector is missing");
        }
        Ok(())
    }

    /// Steps over a page that the engine cannot read, a reference at a time.
    fn read_globals_singly(
        &self,
        connection: &Connection,
        map: &MapRow,
        last: i64,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        let reading = failed("reading global vectors one by one");
        let sql = "SELECT number FROM reference INDEXED BY reference_by_map_number
                   WHERE map = ?1 AND number > ?2 ORDER BY number";
        let numbers: Vec<i64> = connection
            .prepare_cached(sql)
            .and_then(|mut statement| {
                statement
                    .query_map([map.number, last], |row| row.get(0))?
                    .collect()
            })
            .map_err(&reading)?;
        for number in numbers {
            let mut scan = Scan {
                last: number,
                met: 0,
                damaged: false,
            };
            let reason = match self.scan_range(connection, map, GLOBAL_AT, &mut scan, visit) {
                Ok(()) if scan.met == 0 => "its global vector is missing".to_owned(),
                Ok(()) => continue,
                Err(error) => damage(&error).ok_or_else(|| reading(error))?,
            };
            self.put_in_quarantine(number, map.number, rows::id_of(connection, number), &reason);
        }
        Ok(())
    }

    /// Visits the rows that `range` selects behind or at `scan.last`, which follows.
    fn scan_range(
        &self,
        connection: &Connection,
        map: &MapRow,
        range: &str,
        scan: &mut Scan,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> rusqlite::Result<()> {
        let sql = format!(
            "SELECT {REFERENCE_COLUMNS}, g.vector, g.checksum
             FROM global_vector g CROSS JOIN reference r ON r.number = g.number CROSS JOIN map m ON m.number = r.map
             WHERE g.version = ?1 AND {range} ORDER BY g.number"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let mut found = statement.query([map.version, scan.last])?;
        while let Some(row) = found.next()? {
            scan.last = row.get(0)?;
            scan.met += 1;
            if self.quarantine.contains(scan.last) {
                continue;
            }
            match global_row(row, map.version) {
                Ok(global) => visit(global),
                Err(RowError::Damaged(reason)) => {
                    scan.damaged = true;
                    self.quarantine_row(row, scan.last, &reason);
                }
                Err(RowError::Engine(error)) => return Err(error),
            }
        }
        Ok(())
    }

    /// Quarantines the reference in a row of [`REFERENCE_COLUMNS`].
    fn quarantine_row(&self, row: &Row<'_>, number: i64, reason: &str) {
        let id = row
            .get(1)
            .map_or(ReferenceId::from_bytes([0; 16]), ReferenceId::from_bytes);
        self.put_in_quarantine(number, row.get(2).unwrap_or(0), id, reason);
    }
}

/// How far a scan of global vectors has come.
struct Scan {
    /// Number of the last reference met.
    last: i64,
    /// References met, sound or not.
    met: u64,
    /// Whether a row failed its checksum.
    damaged: bool,
}

const GLOBALS_BEHIND: &str = "g.number > ?2";
const GLOBAL_AT: &str = "g.number = ?2";

fn global_row(row: &Row<'_>, version: i64) -> Result<GlobalRow, RowError> {
    let columns = ReferenceRow::read(row)?;
    let (location, captured_at) = columns.place_and_time()?;
    let global = rows::read_global(version, columns.number, blob(row, 14)?, row.get(15)?)?;
    Ok(GlobalRow {
        reference: columns.id(),
        global,
        location,
        captured_at,
    })
}

/// A blob column without copying it.
pub(super) fn blob<'r>(row: &'r Row<'_>, column: usize) -> Result<&'r [u8], RowError> {
    row.get_ref(column)?
        .as_blob()
        .map_err(|error| RowError::Damaged(error.to_string()))
}

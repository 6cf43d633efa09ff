//! Everything that reads references. A damaged row is quarantined where it is met, and the rest is served.

use super::engine::{damage, failed};
use super::rows::{self, MapRow, REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceRow, RowError};
use super::{SqliteStore, insert};
use crate::store::{GlobalRow, Page, StoreError};
use crate::types::{ExternalId, MapName, PackedPatches, Reference, ReferenceId};
use rusqlite::{Connection, Row};

/// Binds the range of a keyset page: the map or all, and the identity to start behind.
const PAGE_OF_MAP: &str = "WHERE r.map = ?1 AND r.id > ?2 ORDER BY r.id";
const PAGE_OF_ALL: &str = "WHERE ?1 IS NULL AND r.id > ?2 ORDER BY r.id";

impl SqliteStore {
    /// Refuses a quarantined reference with the reason.
    pub(super) fn refuse_damaged(&self, id: ReferenceId, number: i64) -> Result<(), StoreError> {
        self.quarantine.reason(number).map_or(Ok(()), |reason| Err(StoreError::Corrupt { id, reason }))
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
    fn settle_missing<T>(&self, connection: &Connection, id: ReferenceId, number: i64) -> Result<T, StoreError> {
        let (_, map) = rows::locate(connection, id)?;
        let reason = "a part of it is missing".to_owned();
        self.put_in_quarantine(number, map, id, &reason);
        Err(StoreError::Corrupt { id, reason })
    }

    pub(super) fn read_reference(&self, connection: &Connection, id: ReferenceId) -> Result<Reference, StoreError> {
        let (number, _) = rows::locate(connection, id)?;
        self.refuse_damaged(id, number)?;
        let read = rows::reference_by_number(connection, number).and_then(|found| match found {
            Some(reference) if reference.id != id => Err(RowError::Damaged("its row holds another identity".into())),
            found => Ok(found),
        });
        self.settle(connection, id, number, "reading a reference", read)
    }

    pub(super) fn read_patches(&self, connection: &Connection, id: ReferenceId) -> Result<PackedPatches, StoreError> {
        let (number, _) = rows::locate(connection, id)?;
        self.refuse_damaged(id, number)?;
        let read = || -> Result<Option<PackedPatches>, RowError> {
            let sql = "SELECT blob, checksum FROM patches WHERE number = ?1";
            let mut statement = connection.prepare_cached(sql)?;
            let mut found = statement.query([number])?;
            let Some(row) = found.next()? else { return Ok(None) };
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
        let Some(map) = MapRow::find(connection, map)? else { return Ok(None) };
        let finding = failed("finding an external id");
        let Some(number) = insert::number_of_external(connection, map.number, external_id).map_err(&finding)? else {
            return Ok(None);
        };
        let id = connection
            .query_row("SELECT id FROM reference WHERE number = ?1", [number], |row| row.get(0))
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
        let listing = failed("listing references");
        let map = map.map(|name| MapRow::require(connection, name)).transpose()?;
        let range = if map.is_some() { PAGE_OF_MAP } else { PAGE_OF_ALL };
        let sql = format!("SELECT {REFERENCE_COLUMNS} FROM {REFERENCE_SOURCE} {range}");
        let mut statement = connection.prepare_cached(&sql).map_err(&listing)?;
        let start: &[u8] = after.as_ref().map_or(&[], |id| id.as_bytes());
        let mut found = statement.query((map.as_ref().map(|map| map.number), start)).map_err(&listing)?;
        let mut references: Vec<Reference> = Vec::new();
        while let Some(row) = found.next().map_err(&listing)? {
            if references.len() == limit {
                let next = references.last().map(|last| last.id);
                return Ok(Page { references, next });
            }
            let number: i64 = row.get(0).map_err(&listing)?;
            if self.quarantine.contains(number) {
                continue;
            }
            match rows::read_reference(row) {
                Ok(reference) => references.push(reference),
                Err(RowError::Damaged(reason)) => self.quarantine_row(row, number, &reason),
                Err(RowError::Engine(error)) => return Err(listing(error)),
            }
        }
        Ok(Page { references, next: None })
    }

    /// Streams the global vectors of a map out of one snapshot.
    pub(super) fn read_globals(
        &self,
        connection: &Connection,
        map: &MapRow,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> Result<(), StoreError> {
        let mut last = i64::MIN;
        match self.scan_range(connection, map, GLOBALS_BEHIND, &mut last, visit) {
            Err(error) if damage(&error).is_some() => self.read_globals_singly(connection, map, last, visit),
            outcome => outcome.map_err(failed("reading global vectors")),
        }
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
        let numbers: Vec<i64> = connection
            .prepare_cached("SELECT number FROM reference WHERE map = ?1 AND number > ?2 ORDER BY number")
            .and_then(|mut statement| statement.query_map([map.number, last], |row| row.get(0))?.collect())
            .map_err(&reading)?;
        for number in numbers {
            if let Err(error) = self.scan_range(connection, map, GLOBAL_AT, &mut { number }, visit) {
                let reason = damage(&error).ok_or_else(|| reading(error))?;
                self.put_in_quarantine(number, map.number, self.id_of(connection, number), &reason);
            }
        }
        Ok(())
    }

    /// Visits the rows that `range` selects behind or at `last`, which follows.
    fn scan_range(
        &self,
        connection: &Connection,
        map: &MapRow,
        range: &str,
        last: &mut i64,
        visit: &mut dyn FnMut(GlobalRow),
    ) -> rusqlite::Result<()> {
        let sql = format!(
            "SELECT {REFERENCE_COLUMNS}, g.vector, g.checksum
             FROM global_vector g CROSS JOIN reference r ON r.number = g.number CROSS JOIN map m ON m.number = r.map
             WHERE g.version = ?1 AND {range} ORDER BY g.number"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let mut found = statement.query([map.version, *last])?;
        while let Some(row) = found.next()? {
            *last = row.get(0)?;
            if self.quarantine.contains(*last) {
                continue;
            }
            match global_row(row, map.version) {
                Ok(global) => visit(global),
                Err(RowError::Damaged(reason)) => self.quarantine_row(row, *last, &reason),
                Err(RowError::Engine(error)) => return Err(error),
            }
        }
        Ok(())
    }

    /// Quarantines the reference in a row of [`REFERENCE_COLUMNS`].
    fn quarantine_row(&self, row: &Row<'_>, number: i64, reason: &str) {
        let id = row.get(1).map_or(ReferenceId::from_bytes([0; 16]), ReferenceId::from_bytes);
        self.put_in_quarantine(number, row.get(2).unwrap_or(0), id, reason);
    }

    /// The identity in a row that may be unreadable otherwise.
    pub(super) fn id_of(&self, connection: &Connection, number: i64) -> ReferenceId {
        let sql = "SELECT id FROM reference WHERE number = ?1";
        let id = connection.query_row(sql, [number], |row| row.get(0));
        ReferenceId::from_bytes(id.unwrap_or([0; 16]))
    }
}

const GLOBALS_BEHIND: &str = "g.number > ?2";
const GLOBAL_AT: &str = "g.number = ?2";

fn global_row(row: &Row<'_>, version: i64) -> Result<GlobalRow, RowError> {
    let columns = ReferenceRow::read(row)?;
    let (location, captured_at) = columns.place_and_time()?;
    let global = rows::read_global(version, columns.number, blob(row, 14)?, row.get(15)?)?;
    Ok(GlobalRow { reference: columns.id(), global, location, captured_at })
}

/// A blob column without copying it.
pub(super) fn blob<'r>(row: &'r Row<'_>, column: usize) -> Result<&'r [u8], RowError> {
    row.get_ref(column)?.as_blob().map_err(|error| RowError::Damaged(error.to_string()))
}

//! Listing references page by page.
//!
//! A page is read in one statement. If the engine cannot read a page of the database on the way,
//! the list goes on reference by reference, with the identities out of an index, so that one
//! damaged database page does not hide the references on the others.

use super::database::Database;
use super::engine::failed;
use super::keys::MapNumber;
use super::map_row::MapRow;
use super::quarantine::DamagedReference;
use super::reference_row::{REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceColumns};
use super::row::RowError;
use crate::error::StoreError;
use crate::records::Page;
use placeformer_core::types::{MapName, Reference, ReferenceId};
use rusqlite::Connection;

// A list of one map and a list of all use different indexes. So there is a condition for each
// instead of one that fits both, and the one for all takes the map as a parameter to ignore.

const OF_MAP: &str = "r.map = ?1 AND r.id > ?2 ORDER BY r.id";
const OF_ALL: &str = "?1 IS NULL AND r.id > ?2 ORDER BY r.id";

/// Identities of a map's references, out of an index alone.
const IDS_OF_MAP: &str = "SELECT r.id AS id FROM reference r INDEXED BY reference_by_map
     WHERE r.map = ?1 AND r.id > ?2 ORDER BY r.id";

/// Identities of all references, out of an index alone.
const IDS_OF_ALL: &str = "SELECT r.id AS id FROM reference r INDEXED BY reference_by_id
     WHERE ?1 IS NULL AND r.id > ?2 ORDER BY r.id";

/// A page being filled.
struct Listing {
    /// Only references of this map.
    map: Option<MapNumber>,
    /// The list starts behind this identity.
    after: Option<ReferenceId>,
    limit: usize,
    references: Vec<Reference>,
}

impl Listing {
    fn is_full(&self) -> bool {
        self.references.len() == self.limit
    }

    /// The identity behind which the list goes on.
    fn last_id(&self) -> Option<ReferenceId> {
        match self.references.last() {
            Some(last) => Some(last.id),
            None => self.after,
        }
    }
}

/// The bytes of an identity to start behind; none sort before all.
fn start_bytes(after: &Option<ReferenceId>) -> &[u8] {
    match after {
        Some(id) => id.as_bytes(),
        None => &[],
    }
}

impl Database {
    /// At most `limit` references behind `after`.
    pub(super) fn page(
        &self,
        connection: &Connection,
        map: Option<&MapName>,
        after: Option<ReferenceId>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        let map = match map {
            Some(name) => Some(MapRow::require(connection, name)?.number),
            None => None,
        };
        let mut listing = Listing {
            map,
            after,
            limit,
            references: Vec::new(),
        };
        let has_more = match self.fill(connection, &mut listing) {
            Err(StoreError::Damaged { .. }) => self.fill_one_by_one(connection, &mut listing)?,
            outcome => outcome?,
        };
        let last = listing.references.last().map(|last| last.id);
        let next = if has_more { last } else { None };
        Ok(Page {
            references: listing.references,
            next,
        })
    }

    /// Fills the page; true if there is at least one reference more.
    fn fill(&self, connection: &Connection, listing: &mut Listing) -> Result<bool, StoreError> {
        let failed = failed("listing references");
        let condition = if listing.map.is_some() {
            OF_MAP
        } else {
            OF_ALL
        };
        let sql = format!("SELECT {REFERENCE_COLUMNS} FROM {REFERENCE_SOURCE} WHERE {condition}");
        let mut statement = connection.prepare_cached(&sql).map_err(&failed)?;
        let columns = ReferenceColumns::of(&statement).map_err(&failed)?;
        let start = listing.after;
        let mut rows = statement
            .query((listing.map, start_bytes(&start)))
            .map_err(&failed)?;
        while let Some(row) = rows.next().map_err(&failed)? {
            if listing.is_full() {
                return Ok(true);
            }
            let number = columns.number(row).map_err(&failed)?;
            if self.quarantine.contains(number) {
                continue;
            }
            match columns.read_reference(row) {
                Ok(reference) => listing.references.push(reference),
                Err(RowError::Damaged(reason)) => self.put_in_quarantine(DamagedReference {
                    number,
                    map: columns.map_or_unknown(row),
                    id: columns.id_or_zeros(row),
                    reason,
                }),
                Err(RowError::Engine(error)) => return Err(failed(error)),
            }
        }
        Ok(false)
    }

    /// Goes on where the engine could not; true if there is at least one reference more.
    fn fill_one_by_one(
        &self,
        connection: &Connection,
        listing: &mut Listing,
    ) -> Result<bool, StoreError> {
        let failed = failed("listing references one by one");
        let sql = if listing.map.is_some() {
            IDS_OF_MAP
        } else {
            IDS_OF_ALL
        };
        let mut statement = connection.prepare_cached(sql).map_err(&failed)?;
        let start = listing.last_id();
        let mut rows = statement
            .query((listing.map, start_bytes(&start)))
            .map_err(&failed)?;
        while let Some(row) = rows.next().map_err(&failed)? {
            if listing.is_full() {
                return Ok(true);
            }
            let id = ReferenceId::from_bytes(row.get("id").map_err(&failed)?);
            match self.reference(connection, id) {
                Ok(reference) => listing.references.push(reference),
                Err(StoreError::CorruptRecord { .. } | StoreError::ReferenceNotFound { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(false)
    }
}

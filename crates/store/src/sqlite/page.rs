//! Listing references page by page, in the order they were added.
//!
//! The order is that of their numbers, which the writer counts up; identities begin with the time,
//! and clocks are set back. A page is read in one statement. If the engine cannot read a page of
//! the database on the way, the list goes on reference by reference, with the identities out of an
//! index, so that one damaged database page does not hide the references on the others.

use super::database::Database;
use super::engine::failed;
use super::keys::{MapNumber, ReferenceNumber};
use super::map_row::MapRow;
use super::quarantine::DamagedReference;
use super::reference_row::{REFERENCE_COLUMNS, REFERENCE_SOURCE, ReferenceColumns};
use super::row::RowError;
use crate::error::StoreError;
use crate::records::{Cursor, Page};
use placeformer_core::types::{MapName, Reference, ReferenceId};
use rusqlite::Connection;

// A list of one map and a list of all use different indexes. So there is a condition for each
// instead of one that fits both, and the one for all takes the map as a parameter to ignore.

const OF_MAP: &str = "r.map = ?1 AND r.number > ?2 ORDER BY r.number";
const OF_ALL: &str = "?1 IS NULL AND r.number > ?2 ORDER BY r.number";

/// Numbers and identities of a map's references, out of an index alone. The index is not in the
/// order of the numbers; the engine keeps the least of them while it reads the map's part of it.
const IDS_OF_MAP: &str =
    "SELECT r.number AS number, r.id AS id FROM reference r INDEXED BY reference_by_map
     WHERE r.map = ?1 AND r.number > ?2 ORDER BY r.number LIMIT ?3";

/// Numbers and identities of all references, out of an index alone.
const IDS_OF_ALL: &str =
    "SELECT r.number AS number, r.id AS id FROM reference r INDEXED BY reference_by_id
     WHERE ?1 IS NULL AND r.number > ?2 ORDER BY r.number LIMIT ?3";

/// A page being filled.
struct Listing {
    /// Only references of this map.
    map: Option<MapNumber>,
    /// The list goes on behind this number.
    after: ReferenceNumber,
    limit: usize,
    references: Vec<Reference>,
}

impl Listing {
    fn is_full(&self) -> bool {
        self.references.len() == self.limit
    }

    /// Adds the reference of this number.
    fn push(&mut self, number: ReferenceNumber, reference: Reference) {
        self.references.push(reference);
        self.after = number;
    }
}

impl Database {
    /// At most `limit` references behind `after`.
    pub(super) fn page(
        &self,
        connection: &Connection,
        map: Option<&MapName>,
        after: Option<Cursor>,
        limit: usize,
    ) -> Result<Page, StoreError> {
        let map = match map {
            Some(name) => Some(MapRow::require(connection, name)?.number),
            None => None,
        };
        let mut listing = Listing {
            map,
            after: after.map_or(ReferenceNumber::BEFORE_ALL, ReferenceNumber::at),
            limit,
            references: Vec::new(),
        };
        let has_more = match self.fill(connection, &mut listing) {
            Err(StoreError::Damaged { .. }) => self.fill_one_by_one(connection, &mut listing)?,
            outcome => outcome?,
        };
        let next = has_more.then(|| listing.after.cursor());
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
        let mut rows = statement
            .query((listing.map, listing.after))
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
                Ok(reference) => listing.push(number, reference),
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
        let mut start = listing.after;
        loop {
            // One more than fits tells whether there are more. Damaged ones take no place in the
            // page, so there may be another round.
            let wanted = listing.limit - listing.references.len() + 1;
            let found = identities(connection, listing.map, start, wanted)?;
            for &(number, id) in &found {
                if listing.is_full() {
                    return Ok(true);
                }
                start = number;
                match self.reference(connection, id) {
                    Ok(reference) => listing.push(number, reference),
                    Err(
                        StoreError::CorruptRecord { .. } | StoreError::ReferenceNotFound { .. },
                    ) => {}
                    Err(error) => return Err(error),
                }
            }
            if found.len() < wanted {
                return Ok(false);
            }
        }
    }
}

/// Numbers and identities of at most `limit` references behind `after`, out of an index alone.
fn identities(
    connection: &Connection,
    map: Option<MapNumber>,
    after: ReferenceNumber,
    limit: usize,
) -> Result<Vec<(ReferenceNumber, ReferenceId)>, StoreError> {
    let sql = if map.is_some() {
        IDS_OF_MAP
    } else {
        IDS_OF_ALL
    };
    let read = || -> rusqlite::Result<Vec<(ReferenceNumber, ReferenceId)>> {
        let mut statement = connection.prepare_cached(sql)?;
        let rows = statement.query_map((map, after, limit as i64), |row| {
            Ok((row.get("number")?, ReferenceId::from_bytes(row.get("id")?)))
        })?;
        rows.collect()
    };
    read().map_err(failed("listing references one by one"))
}

#[cfg(test)]
mod tests {
    use super::super::SqliteStore;
    use super::super::change::tests::{config, new_reference, rewrite};
    use super::*;
    use crate::{Inserted, ReadPlaces, WritePlaces};
    use tempfile::TempDir;

    fn add(store: &SqliteStore) -> ReferenceId {
        match store.insert(new_reference()).unwrap() {
            Inserted::Created(reference) => reference.id,
            Inserted::AlreadyThere(_) => panic!("it has no external id"),
        }
    }

    /// A store of six, the last three added after the clock was set back to before the first.
    fn set_back() -> (TempDir, SqliteStore, Vec<ReferenceId>) {
        let directory = tempfile::tempdir().unwrap();
        let store = SqliteStore::open(directory.path(), &config()).unwrap();
        let mut ids: Vec<ReferenceId> = (0..6).map(|_| add(&store)).collect();
        drop(store);
        for (i, id) in ids[3..].iter_mut().enumerate() {
            // Identities begin with the time.
            let earlier = [i as u8; 16];
            rewrite(&directory, *id, |row| row.id = earlier);
            *id = ReferenceId::from_bytes(earlier);
        }
        let store = SqliteStore::open(directory.path(), &config()).unwrap();
        (directory, store, ids)
    }

    #[test]
    fn a_clock_that_is_set_back_hides_nothing_from_whoever_reads_page_by_page() {
        let (_directory, store, ids) = set_back();
        let city: MapName = "city".parse().unwrap();
        for map in [None, Some(&city)] {
            for limit in 1..8 {
                let mut listed = Vec::new();
                let mut after = None;
                loop {
                    let page = store.list(map, after, limit).unwrap();
                    listed.extend(page.references.iter().map(|reference| reference.id));
                    after = page.next;
                    if after.is_none() {
                        break;
                    }
                }
                assert_eq!(listed, ids, "{limit} at a time");
            }
        }
    }

    #[test]
    fn what_is_added_or_deleted_between_two_pages_disturbs_nothing_else() {
        let (_directory, store, ids) = set_back();
        let first = store.list(None, None, 4).unwrap();
        store.delete(ids[3]).unwrap();
        store.delete(ids[5]).unwrap();
        let added = add(&store);
        let second = store.list(None, first.next, 4).unwrap();
        let listed: Vec<_> = second
            .references
            .iter()
            .map(|reference| reference.id)
            .collect();
        assert_eq!((listed, second.next), (vec![ids[4], added], None));
    }

    #[test]
    fn one_by_one_the_pages_are_the_same() {
        let (_directory, store, _) = set_back();
        let database = &store.database;
        let city: MapName = "city".parse().unwrap();
        for map in [None, Some(&city)] {
            for (start, limit) in [(0, 1), (0, 4), (2, 3), (2, 4), (5, 1), (6, 2), (0, 9)] {
                let after = Some(Cursor::at(start));
                let expected = store.list(map, after, limit).unwrap();
                let found = database.read(|connection| {
                    let map = map.map(|name| MapRow::require(connection, name));
                    let mut listing = Listing {
                        map: map.transpose()?.map(|map| map.number),
                        after: ReferenceNumber::at(Cursor::at(start)),
                        limit,
                        references: Vec::new(),
                    };
                    let has_more = database.fill_one_by_one(connection, &mut listing)?;
                    Ok(Page {
                        next: has_more.then(|| listing.after.cursor()),
                        references: listing.references,
                    })
                });
                assert_eq!(found.unwrap(), expected, "{limit} after {start}");
            }
        }
    }
}

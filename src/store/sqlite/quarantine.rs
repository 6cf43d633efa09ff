//! References known to be damaged, mirrored in memory so that no read path asks the disk about them.
//!
//! The mirror is the authority while the process lives: it holds even when the disk is too full to record the find.

use super::engine::failed;
use crate::store::{Quarantined, StoreError};
use crate::types::ReferenceId;
use rusqlite::Connection;
use std::collections::BTreeMap;
use std::sync::{PoisonError, RwLock};

#[derive(Debug, Clone)]
struct Entry {
    map: i64,
    id: ReferenceId,
    reason: String,
}

/// Damaged references by number.
#[derive(Default)]
pub(super) struct Quarantine(RwLock<BTreeMap<i64, Entry>>);

impl Quarantine {
    /// Reads what earlier processes recorded.
    pub(super) fn load(connection: &Connection) -> Result<Self, StoreError> {
        let loading = failed("reading the quarantine");
        let mut statement = connection.prepare("SELECT number, id, map, reason FROM quarantine").map_err(&loading)?;
        let rows = statement.query_map([], |row| {
            let entry = Entry { id: ReferenceId::from_bytes(row.get(1)?), map: row.get(2)?, reason: row.get(3)? };
            Ok((row.get(0)?, entry))
        });
        let entries = rows.map_err(&loading)?.collect::<Result<_, _>>().map_err(&loading)?;
        Ok(Self(RwLock::new(entries)))
    }

    /// Adds a reference; false if it was known.
    pub(super) fn add(&self, number: i64, map: i64, id: ReferenceId, reason: &str) -> bool {
        let entry = Entry { map, id, reason: reason.to_owned() };
        let mut entries = self.0.write().unwrap_or_else(PoisonError::into_inner);
        if entries.contains_key(&number) {
            return false;
        }
        entries.insert(number, entry);
        true
    }

    /// Why this reference is quarantined, if it is.
    pub(super) fn reason(&self, number: i64) -> Option<String> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).get(&number).map(|entry| entry.reason.clone())
    }

    /// Whether this reference is quarantined.
    pub(super) fn contains(&self, number: i64) -> bool {
        self.0.read().unwrap_or_else(PoisonError::into_inner).contains_key(&number)
    }

    /// How many references of a map are quarantined.
    pub(super) fn count(&self, map: i64) -> u64 {
        let entries = self.0.read().unwrap_or_else(PoisonError::into_inner);
        entries.values().filter(|entry| entry.map == map).count() as u64
    }

    /// Forgets a deleted reference.
    pub(super) fn forget(&self, number: i64) {
        self.0.write().unwrap_or_else(PoisonError::into_inner).remove(&number);
    }

    /// Forgets the references of a deleted map.
    pub(super) fn forget_map(&self, map: i64) {
        self.0.write().unwrap_or_else(PoisonError::into_inner).retain(|_, entry| entry.map != map);
    }

    /// All of them.
    pub(super) fn list(&self) -> Vec<Quarantined> {
        let entries = self.0.read().unwrap_or_else(PoisonError::into_inner);
        entries.values().map(|entry| Quarantined { id: entry.id, reason: entry.reason.clone() }).collect()
    }
}

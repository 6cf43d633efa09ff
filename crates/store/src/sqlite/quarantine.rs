//! References known to be damaged, mirrored in memory so that no read path asks the disk about
//! them.
//!
//! The mirror is the authority while the process lives: it holds even when the disk is too full to
//! record the find. Beside it stands what was met since the store's user last asked, so that damage
//! is counted, and leaves the user's index, whichever call met it.

use super::engine::failed;
use crate::{Damage, Quarantined, StoreError};
use placeformer_core::types::ReferenceId;
use rusqlite::Connection;
use std::collections::{BTreeMap, HashSet};
use std::sync::{Mutex, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// Damage without a number that is remembered. A damaged page of the index may be asked for any
/// number of identities.
const REMEMBERED: usize = 10_000;

#[derive(Debug, Clone)]
struct Entry {
    map: i64,
    id: ReferenceId,
    reason: String,
}

/// Damaged references by number, and news of them.
#[derive(Default)]
pub(super) struct Quarantine {
    entries: RwLock<BTreeMap<i64, Entry>>,
    news: Mutex<News>,
}

#[derive(Default)]
struct News {
    damage: Damage,
    /// What was counted without being a quarantined reference, so that it is counted once.
    counted: HashSet<String>,
}

impl Quarantine {
    /// Reads what earlier processes recorded.
    pub(super) fn load(connection: &Connection) -> Result<Self, StoreError> {
        let loading = failed("reading the quarantine");
        let mut statement = connection
            .prepare("SELECT number, id, map, reason FROM quarantine")
            .map_err(&loading)?;
        let rows = statement.query_map([], |row| {
            let entry = Entry {
                id: ReferenceId::from_bytes(row.get(1)?),
                map: row.get(2)?,
                reason: row.get(3)?,
            };
            Ok((row.get(0)?, entry))
        });
        let entries = rows
            .map_err(&loading)?
            .collect::<Result<_, _>>()
            .map_err(&loading)?;
        Ok(Self {
            entries: RwLock::new(entries),
            news: Mutex::default(),
        })
    }

    /// Adds a reference; false if it was known.
    pub(super) fn add(&self, number: i64, map: i64, id: ReferenceId, reason: &str) -> bool {
        let entry = Entry {
            map,
            id,
            reason: reason.to_owned(),
        };
        let mut entries = self.write();
        if entries.contains_key(&number) {
            return false;
        }
        entries.insert(number, entry);
        drop(entries);
        self.tell(|news| {
            news.damage.found += 1;
            news.damage.withdrawn.push(id);
        });
        true
    }

    /// Damage was met that no quarantined reference stands for, such as one that cannot even be
    /// located; the first time it is news.
    pub(super) fn met(&self, what: String, reference: Option<ReferenceId>) {
        self.tell(|news| {
            if news.counted.len() < REMEMBERED && news.counted.insert(what) {
                news.damage.found += 1;
                news.damage.withdrawn.extend(reference);
            }
        });
    }

    /// A damaged reference's image was sent again and took its place. `id` is what its row said, in
    /// case the damage is news.
    pub(super) fn replaced(&self, number: i64, id: ReferenceId) {
        let known = self.write().remove(&number);
        self.tell(|news| {
            news.damage.found += u64::from(known.is_none());
            news.damage
                .withdrawn
                .extend([id].into_iter().chain(known.map(|entry| entry.id)));
        });
    }

    /// The news since the last call.
    pub(super) fn drain(&self) -> Damage {
        let mut news = self.news.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut news.damage)
    }

    fn tell(&self, change: impl FnOnce(&mut News)) {
        change(&mut self.news.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Why this reference is quarantined, if it is.
    pub(super) fn reason(&self, number: i64) -> Option<String> {
        self.read().get(&number).map(|entry| entry.reason.clone())
    }

    /// Whether this reference is quarantined.
    pub(super) fn contains(&self, number: i64) -> bool {
        self.read().contains_key(&number)
    }

    /// How many references of a map are quarantined.
    pub(super) fn count(&self, map: i64) -> u64 {
        self.read()
            .values()
            .filter(|entry| entry.map == map)
            .count() as u64
    }

    /// Forgets a deleted reference.
    pub(super) fn forget(&self, number: i64) {
        self.write().remove(&number);
    }

    /// Forgets the references of a deleted map.
    pub(super) fn forget_map(&self, map: i64) {
        self.write().retain(|_, entry| entry.map != map);
    }

    /// All of them.
    pub(super) fn list(&self) -> Vec<Quarantined> {
        self.read()
            .values()
            .map(|entry| Quarantined {
                id: entry.id,
                reason: entry.reason.clone(),
            })
            .collect()
    }

    fn read(&self) -> RwLockReadGuard<'_, BTreeMap<i64, Entry>> {
        self.entries.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, BTreeMap<i64, Entry>> {
        self.entries.write().unwrap_or_else(PoisonError::into_inner)
    }
}

//! References known to be damaged, mirrored in memory so that no read path asks the disk about
//! them.
//!
//! While the process lives the mirror is the authority, because the disk may be too full to record
//! a find. It also keeps what was found since the store's user last asked. So damage is counted
//! and leaves the user's index whichever call found it.

use super::engine::failed;
use super::keys::{MapNumber, ReferenceNumber};
use crate::error::StoreError;
use crate::records::{Damage, Quarantined};
use placeformer_core::types::{ReferenceId, Timestamp};
use rusqlite::{Connection, named_params};
use std::collections::{BTreeMap, HashSet};
use std::sync::{Mutex, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// Most finds remembered of damage that stands for no quarantined reference. Any number of
/// identities may be asked for that a damaged page of the index hides.
const REMEMBERED: usize = 10_000;

/// A damaged reference, as far as it can be read.
#[derive(Debug, Clone)]
pub(super) struct DamagedReference {
    pub number: ReferenceNumber,
    pub map: MapNumber,
    pub id: ReferenceId,
    pub reason: String,
}

/// Damaged references by number, and what of that has not been reported yet.
#[derive(Default)]
pub(super) struct Quarantine {
    entries: RwLock<BTreeMap<ReferenceNumber, DamagedReference>>,
    unreported: Mutex<Unreported>,
}

#[derive(Default)]
struct Unreported {
    damage: Damage,
    /// Finds counted that are no quarantined reference, so that each is counted once.
    counted: HashSet<String>,
}

impl Quarantine {
    /// Reads what earlier processes recorded.
    pub(super) fn load(connection: &Connection) -> Result<Self, StoreError> {
        let read = || -> rusqlite::Result<BTreeMap<ReferenceNumber, DamagedReference>> {
            let mut statement =
                connection.prepare("SELECT number, id, map, reason FROM quarantine")?;
            let entries = statement.query_map([], |row| {
                let entry = DamagedReference {
                    number: row.get("number")?,
                    map: row.get("map")?,
                    id: ReferenceId::from_bytes(row.get("id")?),
                    reason: row.get("reason")?,
                };
                Ok((entry.number, entry))
            })?;
            entries.collect()
        };
        let entries = read().map_err(failed("reading the quarantine"))?;
        Ok(Self {
            entries: RwLock::new(entries),
            unreported: Mutex::default(),
        })
    }

    /// Adds a reference; false if it is quarantined already.
    pub(super) fn add(&self, damaged: &DamagedReference) -> bool {
        let mut entries = self.write();
        if entries.contains_key(&damaged.number) {
            return false;
        }
        entries.insert(damaged.number, damaged.clone());
        drop(entries);
        self.report(|unreported| {
            unreported.damage.found += 1;
            unreported.damage.withdrawn.push(damaged.id);
        });
        true
    }

    /// Counts damage that no quarantined reference stands for, such as a reference that cannot
    /// even be located. The same find, named by `what`, is counted once.
    pub(super) fn count_other(&self, what: String, reference: Option<ReferenceId>) {
        self.report(|unreported| {
            if unreported.counted.len() < REMEMBERED && unreported.counted.insert(what) {
                unreported.damage.found += 1;
                unreported.damage.withdrawn.extend(reference);
            }
        });
    }

    /// Takes out a damaged reference that its image, sent again, has replaced. `id` is what its
    /// row said, and reported in case the damage was not known before.
    pub(super) fn replaced(&self, number: ReferenceNumber, id: ReferenceId) {
        let known = self.write().remove(&number);
        self.report(|unreported| {
            unreported.damage.withdrawn.push(id);
            match known {
                Some(entry) => unreported.damage.withdrawn.push(entry.id),
                None => unreported.damage.found += 1,
            }
        });
    }

    /// What was found since the last call.
    pub(super) fn drain(&self) -> Damage {
        let mut unreported = self
            .unreported
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut unreported.damage)
    }

    fn report(&self, change: impl FnOnce(&mut Unreported)) {
        let mut unreported = self
            .unreported
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        change(&mut unreported);
    }

    /// Why this reference is quarantined, if it is.
    pub(super) fn reason(&self, number: ReferenceNumber) -> Option<String> {
        self.read().get(&number).map(|entry| entry.reason.clone())
    }

    /// Whether this reference is quarantined.
    pub(super) fn contains(&self, number: ReferenceNumber) -> bool {
        self.read().contains_key(&number)
    }

    /// How many references of a map are quarantined.
    pub(super) fn count(&self, map: MapNumber) -> u64 {
        let entries = self.read();
        entries.values().filter(|entry| entry.map == map).count() as u64
    }

    /// Forgets a deleted reference.
    pub(super) fn forget(&self, number: ReferenceNumber) {
        self.write().remove(&number);
    }

    /// Forgets the references of a deleted map.
    pub(super) fn forget_map(&self, map: MapNumber) {
        self.write().retain(|_, entry| entry.map != map);
    }

    /// All of them, by number.
    pub(super) fn list(&self) -> Vec<Quarantined> {
        let entries = self.read();
        let quarantined = entries.values().map(|entry| Quarantined {
            id: entry.id,
            reason: entry.reason.clone(),
        });
        quarantined.collect()
    }

    fn read(&self) -> RwLockReadGuard<'_, BTreeMap<ReferenceNumber, DamagedReference>> {
        self.entries.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, BTreeMap<ReferenceNumber, DamagedReference>> {
        self.entries.write().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Records a damaged reference on disk, for the processes that come after this one.
pub(super) fn record(
    connection: &Connection,
    damaged: &DamagedReference,
) -> Result<(), StoreError> {
    connection
        .execute(
            "INSERT OR IGNORE INTO quarantine (number, id, map, reason, detected_at)
             VALUES (:number, :id, :map, :reason, :detected_at)",
            named_params! {
                ":number": damaged.number,
                ":id": damaged.id.as_bytes().as_slice(),
                ":map": damaged.map,
                ":reason": damaged.reason,
                ":detected_at": Timestamp::now().unix_micros(),
            },
        )
        .map_err(failed("recording a damaged reference"))?;
    Ok(())
}

/// Whether a reference is recorded as damaged on disk.
pub(super) fn is_recorded(
    connection: &Connection,
    number: ReferenceNumber,
) -> rusqlite::Result<bool> {
    connection
        .prepare_cached("SELECT 1 FROM quarantine WHERE number = ?1")?
        .exists([number])
}

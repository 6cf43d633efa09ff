//! Whether the server is ready, and if not, why.
//!
//! The whole process shares one [`Health`]. Start-up moves it from phase to phase, shutdown sets it
//! to draining, and a disk that is full or cannot be written makes it unready until that is over.
//! `/readyz` prints the first reason found; `/readyz?for=query` ignores the disk, because queries
//! need no room on it.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Why the server is not ready.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unready {
    /// Weights are being fetched or loaded, or the first inference runs.
    LoadingModel,
    /// The store is being opened and brought to the current schema.
    Migrating,
    /// The in-memory indexes are being rebuilt from the store.
    BuildingIndex {
        /// References indexed so far.
        done: u64,
        /// References in the store.
        total: u64,
    },
    /// Stopping: requests under way are finished, new ones go elsewhere.
    Draining,
    /// The disk is almost full: queries are answered, but nothing new is stored.
    DiskFull,
    /// The files of the store are gone, exchanged, or cannot be written: queries are answered as
    /// far as the store can be read, but nothing is stored, changed or deleted.
    StorageLost {
        /// What is wrong, for people.
        reason: String,
    },
}

impl Unready {
    /// The stable name that `/readyz` prints.
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::LoadingModel => "loading_model",
            Self::Migrating => "migrating",
            Self::BuildingIndex { .. } => "building_index",
            Self::Draining => "draining",
            Self::DiskFull => "disk_full",
            Self::StorageLost { .. } => "storage_lost",
        }
    }
}

/// How far start-up has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    LoadingModel,
    Migrating,
    BuildingIndex,
    Serving,
}

/// The state behind `/readyz`.
#[derive(Debug)]
pub struct Health {
    phase: Mutex<Phase>,
    /// References indexed since start-up began.
    indexed: AtomicU64,
    /// References in the store at that time.
    to_index: AtomicU64,
    draining: AtomicBool,
    disk_full: AtomicBool,
    /// What is wrong with the files of the store, if anything.
    storage_lost: Mutex<Option<String>>,
}

impl Default for Health {
    fn default() -> Self {
        Self {
            phase: Mutex::new(Phase::LoadingModel),
            indexed: AtomicU64::new(0),
            to_index: AtomicU64::new(0),
            draining: AtomicBool::new(false),
            disk_full: AtomicBool::new(false),
            storage_lost: Mutex::new(None),
        }
    }
}

impl Health {
    /// The weights are in memory, and the store is being opened.
    pub fn migrating(&self) {
        self.enter(Phase::Migrating);
    }

    /// The store is open; `total` references are to be indexed.
    pub fn building_index(&self, total: u64) {
        self.to_index.store(total, Ordering::Relaxed);
        self.enter(Phase::BuildingIndex);
    }

    /// `count` more references are indexed.
    pub fn indexed(&self, count: u64) {
        self.indexed.fetch_add(count, Ordering::Relaxed);
    }

    /// Everything is loaded, and requests are served.
    pub fn serving(&self) {
        self.enter(Phase::Serving);
    }

    /// Shutdown has begun.
    pub fn draining(&self) {
        self.draining.store(true, Ordering::Relaxed);
    }

    /// Whether shutdown has begun.
    pub fn is_draining(&self) -> bool {
        self.draining.load(Ordering::Relaxed)
    }

    /// The disk filled up, or has room again.
    pub fn set_disk_full(&self, full: bool) {
        if self.disk_full.swap(full, Ordering::Relaxed) != full {
            if full {
                tracing::error!("the disk is full: nothing new is stored until there is room");
            } else {
                tracing::info!("the disk has room again");
            }
        }
    }

    /// Whether the disk is full.
    pub fn is_disk_full(&self) -> bool {
        self.disk_full.load(Ordering::Relaxed)
    }

    /// The storage was lost, for this reason, or is back.
    pub fn set_storage_lost(&self, lost: Option<String>) {
        let mut known = self.storage();
        if *known == lost {
            return;
        }
        match &lost {
            Some(reason) => tracing::error!(reason, "the storage is lost: nothing is stored"),
            None => tracing::info!("the storage is back"),
        }
        *known = lost;
    }

    /// What is wrong with the files of the store; `None` if nothing is known to be.
    pub fn storage_lost(&self) -> Option<String> {
        self.storage().clone()
    }

    fn storage(&self) -> MutexGuard<'_, Option<String>> {
        self.storage_lost
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// The reason for not being ready; `None` when ready.
    pub fn unready(&self) -> Option<Unready> {
        let lost = || {
            self.storage_lost()
                .map(|reason| Unready::StorageLost { reason })
        };
        self.unready_for_queries()
            .or_else(lost)
            .or_else(|| self.is_disk_full().then_some(Unready::DiskFull))
    }

    /// The reason for not answering queries; `None` when they are answered. A disk that is full or
    /// cannot be written is no reason.
    pub fn unready_for_queries(&self) -> Option<Unready> {
        if self.is_draining() {
            return Some(Unready::Draining);
        }
        match *self.phase() {
            Phase::LoadingModel => Some(Unready::LoadingModel),
            Phase::Migrating => Some(Unready::Migrating),
            Phase::BuildingIndex => Some(Unready::BuildingIndex {
                done: self.indexed.load(Ordering::Relaxed),
                total: self.to_index.load(Ordering::Relaxed),
            }),
            Phase::Serving => None,
        }
    }

    fn enter(&self, phase: Phase) {
        *self.phase() = phase;
        tracing::debug!(?phase, "start-up");
    }

    fn phase(&self) -> MutexGuard<'_, Phase> {
        // The phase is whole even if a thread panicked while it had the lock.
        self.phase.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_obstacle_is_named() {
        let health = Health::default();
        assert_eq!(health.unready(), Some(Unready::LoadingModel));
        health.migrating();
        assert_eq!(health.unready(), Some(Unready::Migrating));
        health.building_index(10);
        health.indexed(4);
        assert_eq!(
            health.unready(),
            Some(Unready::BuildingIndex { done: 4, total: 10 })
        );
        health.serving();
        assert_eq!(health.unready(), None);
        health.set_disk_full(true);
        assert_eq!(health.unready(), Some(Unready::DiskFull));
        assert_eq!(health.unready_for_queries(), None);
        let reason = "cannot find it".to_owned();
        health.set_storage_lost(Some(reason.clone()));
        assert_eq!(health.unready(), Some(Unready::StorageLost { reason }));
        assert_eq!(health.unready_for_queries(), None);
        health.set_storage_lost(None);
        assert_eq!(health.unready(), Some(Unready::DiskFull));
        health.draining();
        assert_eq!(health.unready(), Some(Unready::Draining));
        assert_eq!(health.unready_for_queries(), Some(Unready::Draining));
    }
}

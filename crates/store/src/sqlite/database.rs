//! The open database: its readers, its writer, and what is known to be damaged in it.
//!
//! Every read and write passes through here, so that damage is counted once, whichever call found
//! it.

use super::job::{Effect, Pending};
use super::quarantine::{self, DamagedReference, Quarantine};
use super::readers::Readers;
use super::reference_row::{Located, locate};
use super::writer::Writer;
use crate::error::StoreError;
use placeformer_core::types::ReferenceId;
use rusqlite::Connection;

/// Connections to the database, and its quarantine.
pub(super) struct Database {
    pub writer: Writer,
    pub readers: Readers,
    pub quarantine: Quarantine,
}

impl Database {
    /// Reads with a connection from the pool.
    pub(super) fn read<T>(
        &self,
        work: impl FnOnce(&Connection) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        self.count_damage(self.readers.with(work))
    }

    /// Writes, and waits until that is durable.
    pub(super) fn write<T: Send + 'static>(
        &self,
        effect: Effect,
        work: impl FnMut(&Connection) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, StoreError> {
        self.wait(self.writer.submit(effect, work)?)
    }

    /// Waits for a write that was handed to the writer.
    pub(super) fn wait<T>(&self, pending: Pending<T>) -> Result<T, StoreError> {
        self.count_damage(pending.wait())
    }

    /// Counts damage for which no single reference stands; that of a reference is counted when it
    /// is quarantined.
    fn count_damage<T>(&self, outcome: Result<T, StoreError>) -> Result<T, StoreError> {
        if let Err(
            error @ (StoreError::Damaged { .. }
            | StoreError::CorruptMap { .. }
            | StoreError::CorruptHead { .. }),
        ) = &outcome
        {
            self.quarantine.count_other(error.to_string(), None);
        }
        outcome
    }

    /// Finds a reference that is to be served. An error if it is quarantined.
    pub(super) fn locate_sound(
        &self,
        connection: &Connection,
        id: ReferenceId,
    ) -> Result<Located, StoreError> {
        let located = locate(connection, id);
        if let Err(StoreError::CorruptRecord { .. }) = &located {
            self.quarantine.count_other(id.to_string(), Some(id));
        }
        let located = located?;
        match self.quarantine.reason(located.number) {
            Some(reason) => Err(StoreError::CorruptRecord { id, reason }),
            None => Ok(located),
        }
    }

    /// Takes a damaged reference out of service and records why.
    pub(super) fn put_in_quarantine(&self, damaged: DamagedReference) {
        if !self.quarantine.add(&damaged) {
            return;
        }
        let id = damaged.id;
        let reason = damaged.reason.as_str();
        tracing::error!(
            reference = %id,
            reason,
            "a stored reference is damaged; it is quarantined"
        );
        let record = move |connection: &Connection| quarantine::record(connection, &damaged);
        if let Err(error) = self.writer.run(Effect::Shrinks, record) {
            // It stays out of service while this process lives, and the next will find it again.
            tracing::warn!(%error, reference = %id, "cannot record the quarantine");
        }
    }

    /// Quarantines the reference that a write found damaged.
    pub(super) fn quarantine_damaged_by_id(&self, id: ReferenceId, reason: &str) {
        let located = self.readers.with(|connection| locate(connection, id));
        match located {
            Ok(Located { number, map }) => self.put_in_quarantine(DamagedReference {
                number,
                map,
                id,
                reason: reason.to_owned(),
            }),
            // Deleted meanwhile, or damaged so that it cannot even be located.
            Err(_) => self.quarantine.count_other(id.to_string(), Some(id)),
        }
    }
}

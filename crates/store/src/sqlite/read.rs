//! Reading single references and their key patches. A damaged row is quarantined by the call that
//! finds it.

use super::database::Database;
use super::engine::failed;
use super::map_row::MapRow;
use super::parts;
use super::quarantine::DamagedReference;
use super::reference_row::{Located, id_of_external, locate, reference_by_number};
use super::row::{RowError, blob};
use crate::error::StoreError;
use placeformer_core::types::{ExternalId, MapName, PackedPatches, Reference, ReferenceId};
use rusqlite::Connection;

impl Database {
    /// One reference.
    pub(super) fn reference(
        &self,
        connection: &Connection,
        id: ReferenceId,
    ) -> Result<Reference, StoreError> {
        let located = self.locate_sound(connection, id)?;
        let found = reference_by_number(connection, located.number);
        let found = found.and_then(|found| match found {
            Some(reference) if reference.id != id => {
                Err(RowError::Damaged("its row holds another identity".into()))
            }
            found => Ok(found),
        });
        self.checked(connection, id, located, "reading a reference", found)
    }

    /// The key patches of one reference.
    pub(super) fn patches(
        &self,
        connection: &Connection,
        id: ReferenceId,
    ) -> Result<PackedPatches, StoreError> {
        let located = self.locate_sound(connection, id)?;
        let read = || -> Result<Option<PackedPatches>, RowError> {
            let sql = "SELECT blob, checksum FROM patches WHERE number = ?1";
            let mut statement = connection.prepare_cached(sql)?;
            let mut rows = statement.query([located.number])?;
            let Some(row) = rows.next()? else {
                return Ok(None);
            };
            let checksum = row.get("checksum")?;
            parts::read_patches(located.number, blob(row, "blob")?, checksum).map(Some)
        };
        self.checked(connection, id, located, "reading key patches", read())
    }

    /// What was read of a reference, after quarantining it if that is damaged or missing.
    fn checked<T>(
        &self,
        connection: &Connection,
        id: ReferenceId,
        located: Located,
        context: &'static str,
        read: Result<Option<T>, RowError>,
    ) -> Result<T, StoreError> {
        let reason = match read {
            Ok(Some(value)) => return Ok(value),
            Ok(None) => {
                // If the reference was deleted meanwhile, it can no longer be located either, and
                // that is the error to report. Otherwise only the part is lost.
                locate(connection, id)?;
                "a part of it is missing".to_owned()
            }
            Err(RowError::Damaged(reason)) => reason,
            Err(RowError::Engine(error)) => return Err(failed(context)(error)),
        };
        self.put_in_quarantine(DamagedReference {
            number: located.number,
            map: located.map,
            id,
            reason: reason.clone(),
        });
        Err(StoreError::CorruptRecord { id, reason })
    }

    /// The reference with this external id.
    pub(super) fn reference_by_external_id(
        &self,
        connection: &Connection,
        map: &MapName,
        external_id: &ExternalId,
    ) -> Result<Option<Reference>, StoreError> {
        let Some(map) = MapRow::find(connection, map)? else {
            return Ok(None);
        };
        let id = id_of_external(connection, map.number, external_id)
            .map_err(failed("finding an external id"))?;
        match id {
            Some(id) => self.reference(connection, id).map(Some),
            None => Ok(None),
        }
    }

    /// Those of several references that exist and are sound.
    pub(super) fn references(
        &self,
        connection: &Connection,
        ids: &[ReferenceId],
    ) -> Result<Vec<Reference>, StoreError> {
        let mut references = Vec::with_capacity(ids.len());
        for &id in ids {
            match self.reference(connection, id) {
                Ok(reference) => references.push(reference),
                Err(StoreError::ReferenceNotFound { .. } | StoreError::CorruptRecord { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(references)
    }
}

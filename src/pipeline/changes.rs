//! Changing and deleting references and maps, in the store and in the index together.

use super::maps::{Change, Moved};
use super::{Caller, PipelineError, Service};
use placeformer_core::types::{Calibration, MapName, Reference, ReferenceId};
use placeformer_store::{ReferencePatch, StoreError};
use std::sync::Arc;

impl Service {
    /// Changes a reference's metadata; its image and descriptor stay.
    ///
    /// # Errors
    /// The metadata is too long, there is no such reference, or the store fails.
    pub async fn update(
        self: &Arc<Self>,
        caller: &Caller,
        id: ReferenceId,
        patch: ReferencePatch,
    ) -> Result<Reference, PipelineError> {
        let metadata = patch.metadata.as_ref().and_then(Option::as_ref);
        self.check_metadata(metadata)?;
        self.write(caller, move |service| service.update_now(id, patch))
            .await
    }

    /// Deletes a reference and returns what it was.
    ///
    /// # Errors
    /// There is no such reference, or the store fails.
    pub async fn delete(
        self: &Arc<Self>,
        caller: &Caller,
        id: ReferenceId,
    ) -> Result<Reference, PipelineError> {
        self.write(caller, move |service| service.delete_now(id))
            .await
    }

    /// Deletes a map with everything in it; returns how many references that were.
    ///
    /// # Errors
    /// There is no such map, or the store fails.
    pub async fn delete_map(
        self: &Arc<Self>,
        caller: &Caller,
        name: MapName,
    ) -> Result<u64, PipelineError> {
        self.write(caller, move |service| service.delete_map_now(&name))
            .await
    }

    /// Stores a map's calibration, or clears it. It is in force from the next query on.
    ///
    /// # Errors
    /// There is no such map, the calibration was fitted for another model or another re-ranking, or
    /// the store fails.
    pub async fn set_calibration(
        self: &Arc<Self>,
        caller: &Caller,
        name: MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), PipelineError> {
        self.write(caller, move |service| {
            service.set_calibration_now(&name, calibration)
        })
        .await
    }

    fn update_now(
        &self,
        id: ReferenceId,
        patch: ReferencePatch,
    ) -> Result<Reference, PipelineError> {
        let changes_index = patch.location.is_some()
            || patch.alt.is_some()
            || patch.heading.is_some()
            || patch.captured_at.is_some();
        let entry = self.maps.entry(&self.store.get(id)?.map);
        let _changing = entry.lock_for_change();
        let reference = self.store.update(id, patch)?;
        if changes_index {
            let change = Change::Moved(Moved {
                id,
                location: reference.fields.location,
                alt: reference.fields.alt,
                heading: reference.fields.heading,
                captured_at: reference.fields.captured_at,
            });
            if let Some(live) = entry.live() {
                change.apply(&live.index);
            }
            entry.note(change);
        }
        Ok(reference)
    }

    fn delete_now(&self, id: ReferenceId) -> Result<Reference, PipelineError> {
        let found = self.store.get(id);
        if let Err(StoreError::CorruptRecord { .. }) = found {
            // A damaged record cannot say which map it is of, so no map can be locked; following
            // the damage takes the reference out of every index instead.
            self.follow_damage();
            return Ok(self.store.delete(id)?);
        }
        let entry = self.maps.entry(&found?.map);
        let _changing = entry.lock_for_change();
        let reference = self.store.delete(id)?;
        if let Some(live) = entry.live() {
            live.index.remove(id);
        }
        entry.note(Change::Deleted(id));
        self.patches.forget(id);
        Ok(reference)
    }

    fn delete_map_now(&self, name: &MapName) -> Result<u64, PipelineError> {
        // A map that is not served because its own record is damaged can still be deleted.
        let damaged = || matches!(self.store.map(name), Err(StoreError::CorruptMap { .. }));
        if self.maps.live(name).is_none() && !damaged() {
            return Err(PipelineError::MapNotFound(name.clone()));
        }
        let entry = self.maps.entry(name);
        let _changing = entry.lock_for_change();
        let deleted = self.store.delete_map(name)?;
        entry.clear();
        Ok(deleted)
    }

    fn set_calibration_now(
        &self,
        name: &MapName,
        calibration: Option<Calibration>,
    ) -> Result<(), PipelineError> {
        let (entry, _) = self.existing(name)?;
        let _changing = entry.lock_for_change();
        if let Some(calibration) = &calibration {
            self.calibrations.check(name, calibration)?;
        }
        self.store.set_calibration(name, calibration.clone())?;
        if let Some(live) = entry.live() {
            live.calibrate(calibration);
        }
        Ok(())
    }

    /// Changes the store, on no more threads at once than `store_writes` of the settings.
    ///
    /// Cancel safety: dropped while waiting, nothing is written; dropped later, the write runs to
    /// its end, because store and index change together.
    async fn write<T: Send + 'static>(
        self: &Arc<Self>,
        caller: &Caller,
        work: impl FnOnce(&Self) -> Result<T, PipelineError> + Send + 'static,
    ) -> Result<T, PipelineError> {
        self.run_limited(&self.store_writes, caller, work).await
    }
}

//! The service: everything a request needs, the bounds on requests, and the questions that need no
//! image.

use super::admission::{Admission, ConcurrencyLimit};
use super::blocking::blocking;
use super::calibrations::Calibrations;
use super::extraction::Extraction;
use super::maps::{Change, LiveMap, MapEntry, Maps};
use super::patches::PatchCache;
use super::tracks::TrackConfig;
use super::{Caller, PipelineConfig, PipelineError};
use crate::ops::memory::MemoryWatermark;
use crate::ops::metrics::{MemoryComponent, Rejection};
use crate::ops::{Health, Metrics};
use placeformer_core::types::{
    Calibration, ExternalId, ImageSize, InvalidValue, MapName, Metadata, ModelId, Reference,
    ReferenceId,
};
use placeformer_store::{Cursor, MapInfo, Page, PlaceStore, StoreError};
use placeformer_track::TrackKey;
use placeformer_vision::rerank::{RerankConfig, Reranker};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Mutex;

/// A running service. Shared behind an `Arc`; every method may be called from many tasks at once.
pub struct Service {
    pub(super) store: Arc<dyn PlaceStore>,
    pub(super) extraction: Extraction,
    pub(super) reranker: Reranker,
    pub(super) rerank_config: RerankConfig,
    pub(super) maps: Maps,
    pub(super) patches: PatchCache,
    pub(super) calibrations: Calibrations,
    /// Bounds queries and matches.
    pub(super) queries: Arc<Admission>,
    /// Bounds new references.
    pub(super) references: Arc<Admission>,
    /// Bounds what reads the store for anything but a query.
    pub(super) store_reads: ConcurrencyLimit,
    /// Bounds what changes the store for anything but a new reference.
    pub(super) store_writes: ConcurrencyLimit,
    /// Lets one map at a time be given another head, which takes minutes.
    pub(super) heads: ConcurrencyLimit,
    /// Locked while the gauges are brought up to date from the store.
    pub(super) observing: Arc<Mutex<()>>,
    pub(super) memory: MemoryWatermark,
    pub(super) config: PipelineConfig,
    pub(super) tracks: TrackConfig,
    /// Authenticates the tokens of tracks.
    pub(super) track_key: TrackKey,
    pub(super) metrics: Arc<Metrics>,
    pub(super) health: Arc<Health>,
}

/// What this server computes with.
#[derive(Debug, Clone)]
pub struct ServiceInfo {
    /// Its model.
    pub model: ModelId,
    /// The size in pixels that images are resized to.
    pub input_size: ImageSize,
    /// How candidates are re-ranked.
    pub rerank: RerankConfig,
    /// Defaults and bounds of requests.
    pub pipeline: PipelineConfig,
    /// What confidences come from on maps without a calibration of their own.
    pub calibration: Option<Calibration>,
}

impl Service {
    /// What this server computes with.
    pub fn info(&self) -> ServiceInfo {
        let source = self.extraction.source();
        let model = source.model_id();
        ServiceInfo {
            model: model.clone(),
            input_size: source.input_size(),
            rerank: self.rerank_config.clone(),
            pipeline: self.config.clone(),
            calibration: self.calibrations.built_in(model).cloned(),
        }
    }

    /// Settings of the pipeline.
    pub fn config(&self) -> &PipelineConfig {
        &self.config
    }

    /// One reference's metadata.
    ///
    /// # Errors
    /// There is no such reference, or the store is busy or fails.
    pub async fn reference(
        self: &Arc<Self>,
        caller: &Caller,
        id: ReferenceId,
    ) -> Result<Reference, PipelineError> {
        self.read(caller, move |store| store.get(id)).await
    }

    /// The map that a reference is of, also if the reference itself is damaged.
    ///
    /// # Errors
    /// There is no such reference, or the store is busy or fails.
    pub async fn map_of(
        self: &Arc<Self>,
        caller: &Caller,
        id: ReferenceId,
    ) -> Result<MapName, PipelineError> {
        self.read(caller, move |store| store.map_of(id)).await
    }

    /// The reference to which a map builder gave this external id, if there is one.
    ///
    /// # Errors
    /// There is no such map, or the store is busy or fails.
    pub async fn find_external(
        self: &Arc<Self>,
        caller: &Caller,
        map: MapName,
        external_id: ExternalId,
    ) -> Result<Option<Reference>, PipelineError> {
        self.read(caller, move |store| store.find_external(&map, &external_id))
            .await
    }

    /// A page of references, in the order they were added.
    ///
    /// # Errors
    /// There is no such map, or the store is busy or fails.
    pub async fn references(
        self: &Arc<Self>,
        caller: &Caller,
        map: Option<MapName>,
        after: Option<Cursor>,
        limit: usize,
    ) -> Result<Page, PipelineError> {
        self.read(caller, move |store| store.list(map.as_ref(), after, limit))
            .await
    }

    /// All maps by name.
    ///
    /// # Errors
    /// The store is busy or fails.
    pub async fn maps(self: &Arc<Self>, caller: &Caller) -> Result<Vec<MapInfo>, PipelineError> {
        self.read(caller, |store| store.maps()).await
    }

    /// One map.
    ///
    /// # Errors
    /// There is no such map, or the store is busy or fails.
    pub async fn map(
        self: &Arc<Self>,
        caller: &Caller,
        name: MapName,
    ) -> Result<MapInfo, PipelineError> {
        self.read(caller, move |store| store.map(&name)).await
    }

    /// Refuses new references while the storage is lost, or disk or memory is short. Deleting is
    /// not refused here.
    ///
    /// # Errors
    /// The storage is lost, the disk is almost full, or resident memory is above the watermark.
    pub fn may_store(&self) -> Result<(), PipelineError> {
        if let Some(reason) = self.health.storage_lost() {
            self.metrics.rejected(Rejection::StorageLost);
            return Err(PipelineError::StorageLost(reason));
        }
        if self.health.is_disk_full() {
            self.metrics.rejected(Rejection::DiskFull);
            return Err(PipelineError::DiskFull);
        }
        self.memory
            .check()
            .inspect_err(|_| self.metrics.rejected(Rejection::MemoryPressure))?;
        Ok(())
    }

    /// Brings the health up to date with the files of the store. Blocks.
    pub fn check_storage(&self) {
        let lost = match self.store.check_storage() {
            Err(StoreError::StorageLost { reason }) => Some(reason),
            // A disk that is full, or a store that closes, is not lost.
            Ok(()) | Err(_) => None,
        };
        self.health.set_storage_lost(lost);
    }

    /// Becomes unready for ingest if the store says that its storage is lost.
    pub(super) fn note_lost_storage<T>(&self, outcome: &Result<T, PipelineError>) {
        if let Err(PipelineError::Store(StoreError::StorageLost { reason })) = outcome {
            self.metrics.rejected(Rejection::StorageLost);
            // Only what the store says of itself now counts: one page that cannot be read is not
            // the whole disk.
            if self.store.check_storage().is_err() {
                self.health.set_storage_lost(Some(reason.clone()));
            }
        }
    }

    /// Bounds the metadata of a reference.
    pub(super) fn check_metadata(&self, metadata: Option<&Metadata>) -> Result<(), PipelineError> {
        let length = metadata.map_or(0, |metadata| metadata.as_str().len());
        let bound = self.config.max_metadata_bytes;
        if length > bound {
            let reason = format!("{length} bytes of JSON are more than the {bound} allowed");
            return Err(InvalidValue::new("metadata", reason).into());
        }
        Ok(())
    }

    /// Brings the gauges up to date, before they are read.
    ///
    /// Cancel safety: dropped at any point, some gauges keep their old values.
    pub async fn observe(self: &Arc<Self>) {
        self.observe_memory();
        // At most one task asks the store at a time. The others read what that one finds.
        let Ok(observing) = self.observing.clone().try_lock_owned() else {
            return;
        };
        let store = self.store.clone();
        let asking = blocking(move || {
            let footprint = store.footprint();
            let quarantined = store.quarantined();
            drop(observing);
            (footprint, quarantined)
        });
        let Ok((footprint, quarantined)) = asking.await else {
            return;
        };
        match footprint {
            Ok(footprint) => self
                .metrics
                .set_memory(MemoryComponent::Sqlite, footprint.cache_bytes),
            Err(error) => tracing::warn!(%error, "the store's footprint could not be read"),
        }
        match quarantined {
            Ok(records) => self.metrics.set_quarantined(records.len()),
            Err(error) => tracing::warn!(%error, "the quarantine could not be read"),
        }
    }

    fn observe_memory(&self) {
        let maps = self.maps.all();
        let index: usize = maps.iter().map(|(_, live)| live.index.memory_bytes()).sum();
        let model = self.extraction.source().memory_bytes();
        let metrics = &self.metrics;
        metrics.set_memory(MemoryComponent::Index, index as u64);
        metrics.set_memory(MemoryComponent::Cache, self.patches.bytes());
        metrics.set_memory(MemoryComponent::Model, model);

        let sizes = maps
            .iter()
            .map(|(name, live)| (name.clone(), live.index.len() as u64));
        metrics.set_references(sizes.collect());
    }

    /// Counts damage that the store has found, and stops searching for what it no longer serves.
    pub(super) fn follow_damage(&self) {
        let damage = self.store.drain_damage();
        self.metrics.corrupt_records(damage.found);
        if damage.withdrawn.is_empty() {
            return;
        }
        for entry in self.maps.entries() {
            for &id in &damage.withdrawn {
                // Another head may be replacing this map's index right now. The change is noted
                // before the index is looked up, so the new index loses the reference either way:
                // it is the one found below, or it comes later and reads the journal.
                entry.note(Change::Deleted(id));
                if let Some(live) = entry.live() {
                    live.index.remove(id);
                }
            }
        }
        for &id in &damage.withdrawn {
            self.patches.forget(id);
        }
    }

    /// A map that exists, with its entry.
    pub(super) fn existing(
        &self,
        name: &MapName,
    ) -> Result<(Arc<MapEntry>, Arc<LiveMap>), PipelineError> {
        if let Some(entry) = self.maps.get(name)
            && let Some(live) = entry.live()
        {
            return Ok((entry, live));
        }
        Err(self.missing_map(name))
    }

    /// Why a map cannot be searched: its record in the store is damaged, or it does not exist.
    /// Reads the store.
    pub(super) fn missing_map(&self, name: &MapName) -> PipelineError {
        match self.store.map(name) {
            Err(error @ StoreError::CorruptMap { .. }) => error.into(),
            _ => PipelineError::MapNotFound(name.clone()),
        }
    }

    /// Longest time that a request may wait to be served.
    pub(super) fn max_wait(&self) -> Duration {
        Duration::from_millis(self.config.max_wait_ms)
    }

    /// Counts a request that ended because its deadline passed.
    pub(super) fn count_if_late<T>(&self, outcome: &Result<T, PipelineError>) {
        if let Err(PipelineError::DeadlineExceeded { .. }) = outcome {
            self.metrics.rejected(Rejection::Deadline);
        }
    }

    /// Reads the store, on no more threads at once than `store_reads` of the settings.
    ///
    /// Cancel safety: dropped while waiting, nothing is read; dropped later, the read keeps its
    /// permit until it ends.
    async fn read<T: Send + 'static>(
        self: &Arc<Self>,
        caller: &Caller,
        work: impl FnOnce(&dyn PlaceStore) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, PipelineError> {
        let reading = move |service: &Self| Ok(work(&*service.store)?);
        self.run_limited(&self.store_reads, caller, reading).await
    }

    /// Runs `work` on a blocking thread once `limit` allows, and follows the damage it found.
    ///
    /// Cancel safety: dropped while waiting, nothing is done; dropped later, the work runs to its
    /// end and keeps its permit until then.
    pub(super) async fn run_limited<T: Send + 'static>(
        self: &Arc<Self>,
        limit: &ConcurrencyLimit,
        caller: &Caller,
        work: impl FnOnce(&Self) -> Result<T, PipelineError> + Send + 'static,
    ) -> Result<T, PipelineError> {
        let permit = limit.acquire(caller, self.max_wait()).await?;
        let service = self.clone();
        let outcome = blocking(move || {
            let outcome = work(&service);
            service.note_lost_storage(&outcome);
            service.follow_damage();
            drop(permit);
            outcome
        });
        let panicked = |_| PipelineError::Panicked { stage: "the store" };
        outcome.await.map_err(panicked)?
    }
}

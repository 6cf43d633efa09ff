//! The service: everything a request needs, and the questions that need no image.

use super::admission::{Admission, Turns};
use super::blocking::blocking;
use super::extraction::Extraction;
use super::maps::{Change, LiveMap, MapEntry, Maps};
use super::patches::PatchCache;
use super::trust::Trust;
use super::{PipelineConfig, PipelineError};
use crate::ops::memory::MemoryWatermark;
use crate::ops::metrics::MemoryComponent;
use crate::ops::{Health, Metrics};
use placeformer_core::types::{
    Calibration, ExternalId, ImageSize, MapName, ModelId, Reference, ReferenceId,
};
use placeformer_store::{MapInfo, Page, PlaceStore, StoreError};
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
    pub(super) trust: Trust,
    /// The door for queries and matches.
    pub(super) queries: Arc<Admission>,
    /// The door for new references.
    pub(super) references: Arc<Admission>,
    /// Reading the store for anything but a query.
    pub(super) store_reads: Turns,
    /// Changing the store for anything but a new reference.
    pub(super) store_writes: Turns,
    /// One, for giving maps other heads, which takes minutes.
    pub(super) heads: Turns,
    /// Held while the gauges are brought up to date.
    pub(super) observing: Arc<Mutex<()>>,
    pub(super) memory: MemoryWatermark,
    pub(super) config: PipelineConfig,
    pub(super) metrics: Arc<Metrics>,
    pub(super) health: Arc<Health>,
}

/// What this server computes with.
#[derive(Debug, Clone)]
pub struct ServiceInfo {
    /// Its model.
    pub model: ModelId,
    /// The size images are resized to.
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
        let model = self.extraction.source().model_id();
        ServiceInfo {
            model: model.clone(),
            input_size: self.extraction.source().input_size(),
            rerank: self.rerank_config.clone(),
            pipeline: self.config.clone(),
            calibration: self.trust.built_in(model).cloned(),
        }
    }

    /// Settings of the composition.
    pub fn config(&self) -> &PipelineConfig {
        &self.config
    }

    /// How long a query may wait for its turn.
    pub(super) fn patience(&self) -> Duration {
        Duration::from_millis(self.config.max_wait_ms)
    }

    /// One reference's metadata.
    pub async fn reference(self: &Arc<Self>, id: ReferenceId) -> Result<Reference, PipelineError> {
        self.read(move |store| store.get(id)).await
    }

    /// The reference that a map builder named so, if there is one.
    pub async fn find_external(
        self: &Arc<Self>,
        map: MapName,
        external_id: ExternalId,
    ) -> Result<Option<Reference>, PipelineError> {
        self.read(move |store| store.find_external(&map, &external_id))
            .await
    }

    /// A page of references, ascending by id.
    pub async fn references(
        self: &Arc<Self>,
        map: Option<MapName>,
        after: Option<ReferenceId>,
        limit: usize,
    ) -> Result<Page, PipelineError> {
        self.read(move |store| store.list(map.as_ref(), after, limit))
            .await
    }

    /// All maps by name.
    pub async fn maps(self: &Arc<Self>) -> Result<Vec<MapInfo>, PipelineError> {
        self.read(|store| store.maps()).await
    }

    /// One map.
    pub async fn map(self: &Arc<Self>, name: MapName) -> Result<MapInfo, PipelineError> {
        self.read(move |store| store.map(&name)).await
    }

    /// Brings the gauges up to date, before they are read.
    pub async fn observe(self: &Arc<Self>) {
        let maps = self.maps.all();
        let index: usize = maps.iter().map(|(_, live)| live.index.memory_bytes()).sum();
        self.metrics
            .set_memory(MemoryComponent::Index, index as u64);
        self.metrics
            .set_memory(MemoryComponent::Cache, self.patches.bytes());
        self.metrics.set_memory(
            MemoryComponent::Model,
            self.extraction.source().memory_bytes(),
        );
        self.metrics.set_references(
            maps.iter()
                .map(|(name, live)| (name.to_string(), live.index.len() as u64))
                .collect(),
        );
        // Never more than one at the store, whoever else asks; those see what this one finds.
        let Ok(turn) = self.observing.clone().try_lock_owned() else {
            return;
        };
        let store = self.store.clone();
        let seen = blocking(move || {
            let seen = (store.footprint(), store.quarantined());
            drop(turn);
            seen
        });
        let Ok((footprint, quarantined)) = seen.await else {
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

    /// Counts damage that the store has met, and stops searching for what it no longer serves.
    pub(super) fn follow_damage(&self) {
        let damage = self.store.drain_damage();
        self.metrics.corrupt_records(damage.found);
        if damage.withdrawn.is_empty() {
            return;
        }
        for entry in self.maps.entries() {
            for &id in &damage.withdrawn {
                // Noted first: a new index is either in force already or still to be told.
                entry.note(Change::Deleted(id));
                if let Some(live) = entry.live() {
                    live.index.remove(id);
                }
            }
        }
        damage
            .withdrawn
            .iter()
            .for_each(|&id| self.patches.forget(id));
    }

    /// A map that lives.
    pub(super) fn existing(
        &self,
        name: &MapName,
    ) -> Result<(Arc<MapEntry>, Arc<LiveMap>), PipelineError> {
        let found = self
            .maps
            .get(name)
            .and_then(|entry| Some((entry.clone(), entry.live()?)));
        found.ok_or_else(|| self.why_no_map(name))
    }

    /// A map that does not live does not exist, or its record is damaged. Reads the store.
    pub(super) fn why_no_map(&self, name: &MapName) -> PipelineError {
        match self.store.map(name) {
            Err(error @ StoreError::CorruptMap { .. }) => error.into(),
            _ => PipelineError::MapNotFound(name.clone()),
        }
    }

    /// Reads the store in turn with others.
    ///
    /// Cancel safety: dropped while waiting, nothing is read; dropped later, the read holds its
    /// place until it ends.
    pub(super) async fn read<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&dyn PlaceStore) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, PipelineError> {
        self.in_turn(&self.store_reads, |service| Ok(work(&*service.store)?))
            .await
    }

    /// Runs `work` when its turn has come, and follows what damage it met.
    ///
    /// Cancel safety: dropped while waiting, nothing is done; dropped later, the work runs to its
    /// end in its place.
    pub(super) async fn in_turn<T: Send + 'static>(
        self: &Arc<Self>,
        turns: &Turns,
        work: impl FnOnce(&Self) -> Result<T, PipelineError> + Send + 'static,
    ) -> Result<T, PipelineError> {
        let place = turns.take(self.patience()).await?;
        let service = self.clone();
        let outcome = blocking(move || {
            let outcome = work(&service);
            service.follow_damage();
            drop(place);
            outcome
        });
        outcome
            .await
            .map_err(|_| PipelineError::Panicked { stage: "the store" })?
    }
}

//! From an open store to a service: every map's index is rebuilt from the store, the maps beside each other and each
//! map's blocks while its next references are read, with visible progress.

use super::admission::Admission;
use super::extraction::Extraction;
use super::maps::{LiveMap, MapEntry, Maps};
use super::patches::PatchCache;
use super::trust::Trust;
use super::{DescriptorSource, PipelineConfig, PipelineError, Service};
use crate::image::ImageConfig;
use crate::ops::memory::MemoryWatermark;
use crate::ops::{Health, Metrics};
use crate::rerank::{RerankConfig, Reranker};
use crate::search::{IndexBuilder, IndexEntry, MapIndex};
use crate::store::{MapInfo, PlaceStore};
use rayon::prelude::*;
use std::sync::Arc;

/// References between two reports of progress.
const PROGRESS_STEP: u64 = 1024;

/// What a service is made of.
pub struct Parts {
    /// The truth on disk.
    pub store: Arc<dyn PlaceStore>,
    /// The model.
    pub source: Arc<dyn DescriptorSource>,
    /// Limits of images.
    pub image: ImageConfig,
    /// Settings of the matcher.
    pub rerank: RerankConfig,
    /// Settings of the composition.
    pub pipeline: PipelineConfig,
    /// Where measurements go.
    pub metrics: Arc<Metrics>,
    /// Where progress goes.
    pub health: Arc<Health>,
}

impl Service {
    /// Builds the indexes and opens for requests. Blocks until all maps can be searched.
    pub fn start(parts: Parts) -> Result<Arc<Self>, PipelineError> {
        parts.pipeline.check()?;
        let trust = Trust::new(parts.source.model_id(), parts.rerank.id());
        let maps = build_indexes(&*parts.store, &*parts.source, &parts.health)?;
        for (name, live) in maps.all() {
            trust.warn_if_useless(&name, live.calibration().as_deref());
        }
        let service = Arc::new(Self {
            trust,
            extraction: Extraction::new(parts.source, parts.image, parts.metrics.clone()),
            reranker: Reranker::new(parts.rerank.clone()),
            rerank_config: parts.rerank,
            maps,
            patches: PatchCache::new(parts.pipeline.patch_cache_bytes, parts.metrics.clone()),
            queries: Admission::new(parts.pipeline.queue_capacity, parts.metrics.clone()),
            references: Admission::new(parts.pipeline.queue_capacity, parts.metrics.clone()),
            memory: MemoryWatermark::new(parts.pipeline.memory_watermark_bytes),
            config: parts.pipeline,
            store: parts.store,
            metrics: parts.metrics,
            health: parts.health,
        });
        Ok(service)
    }
}

fn build_indexes(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    health: &Health,
) -> Result<Maps, PipelineError> {
    let (maps, infos) = (Maps::default(), store.maps()?);
    health.building_index(infos.iter().map(|info| info.references).sum());
    infos.par_iter().try_for_each(|info| build_index(store, source, health, info, &maps.entry(&info.name)))?;
    Ok(maps)
}

fn build_index(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    health: &Health,
    info: &MapInfo,
    entry: &MapEntry,
) -> Result<(), PipelineError> {
    let model = info.model.clone();
    if model != *source.model_id() {
        tracing::warn!(map = %info.name, map_model = %model, server_model = %source.model_id(),
            "this map was built with another model: it can be read and deleted, but not searched");
        entry.put(LiveMap::new(model, MapIndex::default(), info.calibration.clone()));
        return Ok(());
    }
    let mut entries = IndexBuilder::default();
    store.scan_globals(&info.name, &mut |row| {
        entries.push(IndexEntry {
            id: row.reference,
            global: row.global,
            location: row.location,
            captured_at: row.captured_at,
        });
        if (entries.len() as u64).is_multiple_of(PROGRESS_STEP) {
            health.indexed(PROGRESS_STEP);
        }
    })?;
    health.indexed(entries.len() as u64 % PROGRESS_STEP);
    tracing::info!(map = %info.name, references = entries.len(), "indexed");
    entry.put(LiveMap::new(model, entries.finish(), info.calibration.clone()));
    Ok(())
}

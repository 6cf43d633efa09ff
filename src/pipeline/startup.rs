//! From an open store to a service: every map's index is rebuilt from the store, the maps beside
//! each other and each map's blocks while its next references are read, with visible progress.

use super::admission::{Admission, Turns};
use super::extraction::Extraction;
use super::maps::{LiveMap, MapEntry, Maps, Projection};
use super::patches::PatchCache;
use super::trust::Trust;
use super::{DescriptorSource, PipelineConfig, PipelineError, Service};
use crate::ops::memory::MemoryWatermark;
use crate::ops::{Health, Metrics};
use placeformer_core::error::ErrorCode;
use placeformer_store::{GlobalRow, MapInfo, PlaceStore, StoreError};
use placeformer_vision::extract::Head;
use placeformer_vision::image::ImageConfig;
use placeformer_vision::rerank::{RerankConfig, Reranker};
use placeformer_vision::search::{IndexBuilder, IndexEntry, MapIndex};
use rayon::prelude::*;
use std::path::Path;
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
        let trust = Trust::new(parts.rerank.id());
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
            store_reads: Turns::new(parts.pipeline.store_reads, parts.metrics.clone()),
            store_writes: Turns::new(parts.pipeline.store_writes, parts.metrics.clone()),
            heads: Turns::new(1, parts.metrics.clone()),
            observing: Arc::default(),
            memory: MemoryWatermark::new(parts.pipeline.memory_watermark_bytes),
            config: parts.pipeline,
            store: parts.store,
            metrics: parts.metrics,
            health: parts.health,
        });
        // The scan of all global descriptors may have met damage.
        service.follow_damage();
        Ok(service)
    }
}

fn build_indexes(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    health: &Health,
) -> Result<Maps, PipelineError> {
    let (maps, infos) = (Maps::default(), store.maps()?);
    health.building_index(
        infos
            .iter()
            .fold(0, |sum, info| sum.saturating_add(info.references)),
    );
    infos
        .par_iter()
        .try_for_each(|info| build_index(store, source, health, info, &maps.entry(&info.name)))?;
    Ok(maps)
}

fn build_index(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    health: &Health,
    info: &MapInfo,
    entry: &MapEntry,
) -> Result<(), PipelineError> {
    let projection = projection(store, source, info)?;
    let model = info.model.clone();
    if let Projection::Foreign | Projection::Lost = projection {
        entry.put(LiveMap::new(
            model,
            projection,
            MapIndex::default(),
            info.calibration.clone(),
        ));
        return Ok(());
    }
    let mut entries = IndexBuilder::default();
    let scanned = store.scan_globals(&info.name, &mut |row| {
        entries.push(index_entry(row));
        if (entries.len() as u64).is_multiple_of(PROGRESS_STEP) {
            health.indexed(PROGRESS_STEP);
        }
    });
    match scanned {
        Err(error) if error.code() == ErrorCode::CorruptRecord => {
            tracing::error!(map = %info.name, %error, "only a part of this map can be searched");
        }
        outcome => outcome?,
    }
    health.indexed(entries.len() as u64 % PROGRESS_STEP);
    tracing::info!(map = %info.name, references = entries.len(), "indexed");
    entry.put(LiveMap::new(
        model,
        projection,
        entries.finish(),
        info.calibration.clone(),
    ));
    Ok(())
}

pub(super) fn index_entry(row: GlobalRow) -> IndexEntry {
    let GlobalRow {
        reference,
        global,
        location,
        captured_at,
    } = row;
    IndexEntry {
        id: reference,
        global,
        location,
        captured_at,
    }
}

/// How this server makes descriptors that compare with the map's.
fn projection(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    info: &MapInfo,
) -> Result<Projection, PipelineError> {
    let server = source.model_id();
    match store.head(&info.name) {
        Ok(Some(file)) => match Head::from_bytes(&file, Path::new("the map's head")) {
            Ok(head) if head.rebind(server).is_ok_and(|model| model == info.model) => {
                return Ok(Projection::Own(Arc::new(head)));
            }
            Ok(_) => {}
            Err(error) => {
                tracing::error!(map = %info.name, %error, "the map's head cannot be read by this release")
            }
        },
        Ok(None) => {}
        Err(error @ StoreError::CorruptHead { .. }) if info.model != *server => {
            tracing::error!(map = %info.name, %error, "this map is not searched");
            return Ok(Projection::Lost);
        }
        // It is the server's own as well, so nothing is lost.
        Err(error @ StoreError::CorruptHead { .. }) => tracing::error!(map = %info.name, %error),
        Err(error) => return Err(error.into()),
    }
    if info.model == *server {
        return Ok(Projection::Server);
    }
    tracing::warn!(map = %info.name, map_model = %info.model, server_model = %server,
        "this map was built with another model: it can be read and deleted, but not searched; \
         if only the head differs, `placeformer map rehead` gives it this server's");
    Ok(Projection::Foreign)
}

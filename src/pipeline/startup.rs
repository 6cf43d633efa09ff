//! From an open store to a service.
//!
//! The index of every map is rebuilt from the store: the maps at the same time, and the blocks of
//! each map while its next references are read. Progress shows in `/readyz`.

use super::admission::{Admission, ConcurrencyLimit};
use super::calibrations::Calibrations;
use super::extraction::Extraction;
use super::maps::{LiveMap, MapEntry, Maps, Projection, index_entry};
use super::patches::PatchCache;
use super::tracks::TrackConfig;
use super::{DescriptorSource, PipelineConfig, PipelineError, Service};
use crate::ops::memory::MemoryWatermark;
use crate::ops::{Health, Metrics};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::ModelId;
use placeformer_store::{MapInfo, PlaceStore, StoreError};
use placeformer_track::TrackKey;
use placeformer_vision::extract::Head;
use placeformer_vision::image::ImageConfig;
use placeformer_vision::rerank::{RerankConfig, Reranker};
use placeformer_vision::search::{IndexBuilder, MapIndex};
use rayon::prelude::*;
use std::path::Path;
use std::sync::Arc;

/// References between two reports of progress.
const PROGRESS_STEP: u64 = 1024;

/// What a service is made of.
pub struct Parts {
    /// The store, from which the indexes are rebuilt.
    pub store: Arc<dyn PlaceStore>,
    /// The model.
    pub source: Arc<dyn DescriptorSource>,
    /// Limits of images.
    pub image: ImageConfig,
    /// Settings of the matcher.
    pub rerank: RerankConfig,
    /// Settings of the pipeline.
    pub pipeline: PipelineConfig,
    /// Settings of tracks.
    pub tracks: TrackConfig,
    /// Authenticates the tokens of tracks.
    pub track_key: TrackKey,
    /// Where measurements go.
    pub metrics: Arc<Metrics>,
    /// Where progress goes.
    pub health: Arc<Health>,
}

impl Service {
    /// Builds the indexes of all maps. Blocks until every map can be searched.
    ///
    /// # Errors
    /// A setting is out of range, or the store fails.
    pub fn start(parts: Parts) -> Result<Arc<Self>, PipelineError> {
        let Parts {
            store,
            source,
            image,
            rerank,
            pipeline: config,
            tracks,
            track_key,
            metrics,
            health,
        } = parts;
        config.check()?;
        tracks.check()?;
        let calibrations = Calibrations::new(&rerank);
        calibrations.warn_if_nothing_learned(source.model_id());
        let maps = build_indexes(&*store, &*source, &health)?;
        for (name, live) in maps.all() {
            calibrations.warn_if_unusable(&name, live.calibration().as_deref());
        }

        let admission = || Admission::new(config.queue_capacity, metrics.clone());
        let limit = |at_once| ConcurrencyLimit::new(at_once, metrics.clone());
        let service = Arc::new(Self {
            calibrations,
            extraction: Extraction::new(source, image, metrics.clone()),
            reranker: Reranker::new(rerank.clone()),
            rerank_config: rerank,
            maps,
            patches: PatchCache::new(config.patch_cache_bytes, metrics.clone()),
            queries: admission(),
            references: admission(),
            store_reads: limit(config.store_reads),
            store_writes: limit(config.store_writes),
            heads: limit(1),
            observing: Arc::default(),
            memory: MemoryWatermark::new(config.memory_watermark_bytes),
            config,
            tracks,
            track_key,
            store,
            metrics,
            health,
        });
        // Reading all global descriptors may have found damage.
        service.follow_damage();
        Ok(service)
    }
}

fn build_indexes(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    health: &Health,
) -> Result<Maps, PipelineError> {
    let maps = Maps::default();
    let infos = store.maps()?;
    let references = infos.iter().map(|info| info.references);
    health.building_index(references.fold(0, u64::saturating_add));
    infos
        .par_iter()
        .try_for_each(|info| build_index(store, source, health, info, &maps.entry(&info.name)))?;
    Ok(maps)
}

/// Brings one map to life, with an index if its descriptors can be compared with this server's.
fn build_index(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    health: &Health,
    info: &MapInfo,
    entry: &MapEntry,
) -> Result<(), PipelineError> {
    let projection = projection(store, source, info)?;
    let index = match projection {
        Projection::Foreign | Projection::Lost => MapIndex::default(),
        Projection::Server | Projection::Own(_) => read_index(store, health, info)?,
    };
    let model = info.model.clone();
    let calibration = info.calibration.clone();
    entry.put(LiveMap::new(model, projection, index, calibration));
    Ok(())
}

/// Reads a map's global descriptors into an index.
fn read_index(
    store: &dyn PlaceStore,
    health: &Health,
    info: &MapInfo,
) -> Result<MapIndex, PipelineError> {
    let mut entries = IndexBuilder::default();
    let read = store.scan_globals(&info.name, &mut |row| {
        entries.push(index_entry(row));
        if (entries.len() as u64).is_multiple_of(PROGRESS_STEP) {
            health.indexed(PROGRESS_STEP);
        }
    });
    match read {
        Err(error) if error.code() == ErrorCode::CorruptRecord => {
            tracing::error!(map = %info.name, %error, "only a part of this map can be searched");
        }
        outcome => outcome?,
    }
    health.indexed(entries.len() as u64 % PROGRESS_STEP);
    tracing::info!(map = %info.name, references = entries.len(), "indexed");
    Ok(entries.finish())
}

/// How this server makes descriptors that can be compared with the map's.
fn projection(
    store: &dyn PlaceStore,
    source: &dyn DescriptorSource,
    info: &MapInfo,
) -> Result<Projection, PipelineError> {
    let server = source.model_id();
    let map = &info.name;
    match store.head(map) {
        Ok(Some(file)) => {
            if let Some(head) = own_head(&file, server, info) {
                return Ok(Projection::Own(Arc::new(head)));
            }
        }
        Ok(None) => {}
        Err(error @ StoreError::CorruptHead { .. }) if info.model != *server => {
            tracing::error!(%map, %error, "this map is not searched");
            return Ok(Projection::Lost);
        }
        // The server has the same head, so the map can be searched all the same.
        Err(error @ StoreError::CorruptHead { .. }) => tracing::error!(%map, %error),
        Err(error) => return Err(error.into()),
    }
    if info.model == *server {
        return Ok(Projection::Server);
    }
    tracing::warn!(%map, map_model = %info.model, server_model = %server,
        "this map was built with another model: it can be read and deleted, but not searched; \
         if only the head differs, `placeformer map rehead` gives it this server's");
    Ok(Projection::Foreign)
}

/// The head that the map keeps, if the server's pooled tokens can be projected with it.
fn own_head(file: &[u8], server: &ModelId, info: &MapInfo) -> Option<Head> {
    match Head::from_bytes(file, Path::new("the map's head")) {
        Ok(head) => {
            let fits = head.rebind(server).is_ok_and(|model| model == info.model);
            fits.then_some(head)
        }
        Err(error) => {
            let map = &info.name;
            tracing::error!(%map, %error, "the map's head cannot be read by this release");
            None
        }
    }
}

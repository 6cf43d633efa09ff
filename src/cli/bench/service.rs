//! The service as `bench` measures it: the pipeline itself, without HTTP.

use crate::ops::{Health, Metrics};
use crate::pipeline::{
    Caller, IngestRequest, Parts, PipelineConfig, QueryOptions, QueryRequest, Service, TrackConfig,
};
use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt, stream};
use placeformer_core::types::{MapName, ReferenceFields};
use placeformer_lab::bench::{MeasuredService, ServiceError, StartService};
use placeformer_store::CombinedStore;
use placeformer_track::TrackKey;
use placeformer_vision::extract::Extractor;
use placeformer_vision::image::ImageConfig;
use placeformer_vision::rerank::RerankConfig;
use std::sync::Arc;
use tokio::runtime::Runtime;

/// A deadline that no measurement misses, in milliseconds.
const DEADLINE_MS: u64 = 600_000;

/// Starts pipelines with default settings.
pub struct PipelineServices;

impl StartService for PipelineServices {
    fn start(
        &self,
        store: CombinedStore,
        extractor: Arc<Extractor>,
    ) -> Result<Box<dyn MeasuredService>, ServiceError> {
        let runtime = Runtime::new()?;
        let pipeline = PipelineConfig {
            deadline_ms: DEADLINE_MS,
            ..PipelineConfig::default()
        };
        let service = Service::start(Parts {
            store: Arc::new(store),
            source: extractor,
            image: ImageConfig::default(),
            rerank: RerankConfig::default(),
            pipeline,
            tracks: TrackConfig::default(),
            track_key: TrackKey::random()?,
            metrics: Arc::new(Metrics::new()?),
            health: Arc::new(Health::default()),
        })?;
        Ok(Box::new(RunningPipeline { runtime, service }))
    }
}

/// A pipeline and the runtime its calls are waited for on.
struct RunningPipeline {
    runtime: Runtime,
    service: Arc<Service>,
}

impl MeasuredService for RunningPipeline {
    fn query(&self, map: &MapName, photo: &Bytes) -> Result<bool, ServiceError> {
        let request = QueryRequest {
            map: map.clone(),
            image: photo.clone(),
            options: QueryOptions::default(),
        };
        let querying = self.service.query(&Caller::Local, request);
        let answer = self.runtime.block_on(querying)?;
        Ok(answer.ranked_by.is_some())
    }

    fn ingest(&self, map: &MapName, photos: &[Bytes], at_once: usize) -> Result<(), ServiceError> {
        let ingest = |image: Bytes| async move {
            let request = IngestRequest {
                map: map.clone(),
                fields: ReferenceFields::default(),
                image,
                reads_photo: false,
                allow_uninformative: false,
            };
            self.service.ingest(&Caller::Local, request).await
        };
        let ingest_all = stream::iter(photos.iter().cloned())
            .map(ingest)
            .buffer_unordered(at_once)
            .try_for_each(|_| async { Ok(()) });
        self.runtime.block_on(ingest_all)?;
        Ok(())
    }
}

//! An import straight into a store: the pipeline of the server without the server.

use super::sink::{Outcome, Sent, Sink, Stored, Upload};
use crate::cli::progress::ProgressBars;
use crate::config::{Config, ModelOverrides, Overrides};
use crate::ops::{Health, Metrics};
use crate::pipeline::{Caller, IngestRequest, Parts, PipelineError, Service};
use anyhow::Context;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{MapName, Reference, ReferenceId};
use placeformer_models::open_extractor;
use placeformer_store::{Cursor, Page, ReferencePatch, SqliteStore};
use placeformer_track::TrackKey;
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use tokio::runtime::Runtime;

/// An opened store as a sink.
pub(super) struct StoreSink {
    service: Arc<Service>,
    runtime: Runtime,
    /// Whether photos are stored that show nothing by which a place could be known.
    allow_uninformative: bool,
}

/// References listed at once when resuming.
const PAGE: usize = 1000;

impl StoreSink {
    /// Loads the model and opens the store in `data` with the settings of `config`, which `model`
    /// overrides.
    pub(super) fn open(
        data: &Path,
        config: Option<&Path>,
        model: ModelOverrides,
        allow_uninformative: bool,
    ) -> anyhow::Result<Self> {
        let overrides = Overrides {
            data: Some(data.to_owned()),
            model,
            ..Default::default()
        };
        let config = Config::load(config, &overrides)?;
        placeformer_kernels::self_check()?;
        let extractor = open_extractor(&config.extract, &ProgressBars::default())
            .context("cannot load the model")?;
        let store = SqliteStore::open(data, &config.store)?;
        let service = Service::start(Parts {
            store: Arc::new(store),
            source: Arc::new(extractor),
            image: config.image,
            rerank: config.rerank,
            pipeline: config.pipeline,
            tracks: config.tracks,
            track_key: TrackKey::random()?,
            metrics: Arc::new(Metrics::new()?),
            health: Arc::new(Health::default()),
        })?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()?;
        Ok(Self {
            service,
            runtime,
            allow_uninformative,
        })
    }

    fn page(&self, map: &MapName, after: Option<Cursor>) -> Result<Page, PipelineError> {
        let map = Some(map.clone());
        let page = self.service.references(&Caller::Local, map, after, PAGE);
        self.runtime.block_on(page)
    }
}

impl Sink for StoreSink {
    fn present(&self, map: &MapName) -> anyhow::Result<HashMap<String, Stored>> {
        let mut present = HashMap::new();
        let mut after = None;
        loop {
            let page = match self.page(map, after) {
                Ok(page) => page,
                Err(error) if error.code() == ErrorCode::MapNotFound => break,
                Err(error) => return Err(error.into()),
            };
            for reference in page.references {
                if let Some(id) = &reference.fields.external_id {
                    present.insert(id.to_string(), Stored::from(&reference));
                }
            }
            after = page.next;
            if after.is_none() {
                break;
            }
        }
        Ok(present)
    }

    fn send(&self, upload: Upload) -> Sent {
        let Upload { map, fields, image } = upload;
        let request = IngestRequest {
            map,
            fields,
            image,
            // The import has read the photo, and knows more about it.
            reads_photo: false,
            allow_uninformative: self.allow_uninformative,
        };
        let ingested = self
            .runtime
            .block_on(self.service.ingest(&Caller::Local, request));
        sent_once(ingested.map(|answer| match answer.created {
            true => Outcome::Created(answer.reference.id.to_string()),
            false => Outcome::Present(Stored::from(&answer.reference)),
        }))
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Sent {
        let updated = self
            .runtime
            .block_on(self.service.update(&Caller::Local, id, patch));
        sent_once(updated.map(|_| Outcome::Updated))
    }
}

impl From<&Reference> for Stored {
    fn from(reference: &Reference) -> Self {
        Self {
            id: reference.id,
            content: reference.content_hash,
            location: reference.fields.location,
            alt: reference.fields.alt,
            heading: reference.fields.heading,
            captured_at: reference.fields.captured_at,
        }
    }
}

fn sent_once(outcome: Result<Outcome, PipelineError>) -> Sent {
    let refused = |error: PipelineError| Outcome::Refused {
        code: error.code().as_str().into(),
        detail: format!("{:#}", anyhow::Error::new(error)),
    };
    Sent {
        outcome: outcome.unwrap_or_else(refused),
        attempts: 1,
    }
}

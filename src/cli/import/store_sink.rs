//! An import straight into a store: the pipeline of the server without the server.

use super::sink::{Outcome, Sent, Sink, Upload};
use crate::cli::progress::ProgressBars;
use crate::config::{Config, ModelOverrides, Overrides};
use crate::ops::{Health, Metrics};
use crate::pipeline::{Caller, IngestRequest, Parts, PipelineError, Service};
use anyhow::Context;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::MapName;
use placeformer_models::open_extractor;
use placeformer_store::{Cursor, Page, SqliteStore};
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use tokio::runtime::Runtime;

/// An opened store as a sink.
pub(super) struct StoreSink {
    service: Arc<Service>,
    runtime: Runtime,
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
            metrics: Arc::new(Metrics::new()?),
            health: Arc::new(Health::default()),
        })?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()?;
        Ok(Self { service, runtime })
    }

    fn page(&self, map: &MapName, after: Option<Cursor>) -> Result<Page, PipelineError> {
        let map = Some(map.clone());
        let page = self.service.references(&Caller::Local, map, after, PAGE);
        self.runtime.block_on(page)
    }
}

impl Sink for StoreSink {
    fn present(&self, map: &MapName) -> anyhow::Result<HashMap<String, String>> {
        let mut present = HashMap::new();
        let mut after = None;
        loop {
            let page = match self.page(map, after) {
                Ok(page) => page,
                Err(error) if error.code() == ErrorCode::MapNotFound => break,
                Err(error) => return Err(error.into()),
            };
            for reference in page.references {
                if let Some(id) = reference.fields.external_id {
                    present.insert(id.into(), reference.content_hash.to_string());
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
        let request = IngestRequest { map, fields, image };
        let ingesting = self.service.ingest(&Caller::Local, request);
        let outcome = match self.runtime.block_on(ingesting) {
            Ok(answer) if answer.created => Outcome::Created(answer.reference.id.to_string()),
            Ok(answer) => Outcome::Present(answer.reference.id.to_string()),
            Err(error) => Outcome::Refused {
                code: error.code().as_str().into(),
                detail: format!("{:#}", anyhow::Error::new(error)),
            },
        };
        Sent {
            outcome,
            attempts: 1,
        }
    }
}

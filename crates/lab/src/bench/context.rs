//! What all measurements share: the model, the machine's limits, and a folder to work in.

use super::error::BenchError;
use super::filled::FilledStore;
use super::limits::Limits;
use super::scenes::CANDIDATES;
use super::service::{MeasuredService, StartService};
use super::streets::{fill_with_streets, street_map};
use placeformer_core::types::{ImageTensor, ReferenceId};
use placeformer_store::{ReadPlaces, SqliteStore, StoreConfig};
use placeformer_vision::extract::{EncoderSpec, Extractor, VitWeights};
use placeformer_vision::image::{ImageConfig, load_tensor};
use std::path::PathBuf;
use std::sync::Arc;

/// Everything a run needs.
pub struct Bench<'a> {
    /// The model with its head.
    pub extractor: Arc<Extractor>,
    /// The same weights, for the baseline and for batches.
    pub weights: VitWeights,
    /// What the model computes.
    pub spec: EncoderSpec,
    /// The machine's limits.
    pub limits: Limits,
    /// A folder for a store and files; streets that an earlier run drew there are used again.
    pub folder: PathBuf,
    /// Paired runs of a row that takes long; short rows take more.
    pub rounds: usize,
    /// Starts the service of the rows that measure all of it.
    pub services: &'a dyn StartService,
}

impl Bench<'_> {
    /// A photo as the model takes it.
    pub(super) fn tensor(&self, photo: &[u8]) -> Result<ImageTensor, BenchError> {
        let size = self.spec.input_size;
        Ok(load_tensor(photo, &ImageConfig::default(), size)?)
    }

    /// A folder of this name without anything in it.
    pub(super) fn new_folder(&self, name: &str) -> Result<PathBuf, BenchError> {
        let path = self.folder.join(name);
        let failed = |source| BenchError::Io {
            path: path.clone(),
            source,
        };
        if path.exists() {
            std::fs::remove_dir_all(&path).map_err(failed)?;
        }
        std::fs::create_dir_all(&path).map_err(failed)?;
        Ok(path)
    }

    /// A service over `store` with `extra` made-up references in each map.
    pub(super) fn service(
        &self,
        store: SqliteStore,
        extra: u64,
    ) -> Result<Box<dyn MeasuredService>, BenchError> {
        let store = FilledStore::around(store, extra)?;
        self.services
            .start(store, self.extractor.clone())
            .map_err(BenchError::Service)
    }

    /// A store with a map of [`CANDIDATES`] drawn streets, made at the first call.
    pub(super) fn store_of_streets(&self) -> Result<(SqliteStore, Vec<ReferenceId>), BenchError> {
        let store = SqliteStore::open(&self.folder.join("store"), &StoreConfig::default())?;
        fill_with_streets(&store, &self.extractor, CANDIDATES as u64)?;
        let page = store.list(Some(&street_map()), None, CANDIDATES)?;
        let ids = page.references.into_iter().map(|reference| reference.id);
        Ok((store, ids.collect()))
    }
}

/// Refuses to compare times of ours and a baseline that do not compute the same.
pub(super) fn agree(
    row: &'static str,
    yes: bool,
    difference: impl FnOnce() -> String,
) -> Result<(), BenchError> {
    if yes {
        Ok(())
    } else {
        Err(BenchError::Disagree {
            row,
            difference: difference(),
        })
    }
}

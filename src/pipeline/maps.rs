//! The maps that can be searched, each with its index.
//!
//! A map's entry outlives the map: deleting empties it, the next insert fills it again, so that whoever waits for
//! its lock meanwhile never writes into an orphan. Inserts share the lock, deletions and changes take it alone;
//! both hold it over commit and index together, so the index never keeps what the store has lost.

use super::PipelineError;
use crate::search::MapIndex;
use crate::types::{Calibration, MapName, ModelId};
use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

#[derive(Default)]
pub(super) struct Maps(RwLock<HashMap<MapName, Arc<MapEntry>>>);

/// One name, whether or not the map exists right now.
#[derive(Default)]
pub(super) struct MapEntry {
    writes: RwLock<()>,
    live: RwLock<Option<Arc<LiveMap>>>,
}

/// A map that exists.
pub(super) struct LiveMap {
    pub(super) model: ModelId,
    pub(super) index: MapIndex,
    calibration: RwLock<Option<Arc<Calibration>>>,
}

impl Maps {
    /// The map, if it exists.
    pub(super) fn live(&self, name: &MapName) -> Option<Arc<LiveMap>> {
        read(&self.0).get(name).and_then(|entry| entry.live())
    }

    /// The map, which must exist and be bound to `model`.
    pub(super) fn comparable(&self, name: &MapName, model: &ModelId) -> Result<Arc<LiveMap>, PipelineError> {
        let live = self.live(name).ok_or_else(|| PipelineError::MapNotFound(name.clone()))?;
        live.check_model(name, model)?;
        Ok(live)
    }

    /// The entry of a name, made on first use.
    pub(super) fn entry(&self, name: &MapName) -> Arc<MapEntry> {
        if let Some(entry) = read(&self.0).get(name) {
            return entry.clone();
        }
        write(&self.0).entry(name.clone()).or_default().clone()
    }

    /// All maps that exist.
    pub(super) fn all(&self) -> Vec<(MapName, Arc<LiveMap>)> {
        read(&self.0).iter().filter_map(|(name, entry)| Some((name.clone(), entry.live()?))).collect()
    }
}

impl MapEntry {
    pub(super) fn live(&self) -> Option<Arc<LiveMap>> {
        read(&self.live).clone()
    }

    /// Held by an insert over its commit and its entry into the index.
    pub(super) fn inserting(&self) -> RwLockReadGuard<'_, ()> {
        read(&self.writes)
    }

    /// Held by a deletion or change over store and index.
    pub(super) fn changing(&self) -> RwLockWriteGuard<'_, ()> {
        write(&self.writes)
    }

    /// The map, brought to life with `model` if it was not.
    pub(super) fn live_or_create(&self, model: &ModelId) -> Arc<LiveMap> {
        if let Some(live) = self.live() {
            return live;
        }
        let fresh = || Arc::new(LiveMap::new(model.clone(), MapIndex::default(), None));
        write(&self.live).get_or_insert_with(fresh).clone()
    }

    pub(super) fn put(&self, live: LiveMap) {
        *write(&self.live) = Some(Arc::new(live));
    }

    pub(super) fn clear(&self) {
        *write(&self.live) = None;
    }
}

impl LiveMap {
    pub(super) fn new(model: ModelId, index: MapIndex, calibration: Option<Calibration>) -> Self {
        Self { model, index, calibration: RwLock::new(calibration.map(Arc::new)) }
    }

    /// How far its best answers can be trusted, if that was fitted for this map.
    pub(super) fn calibration(&self) -> Option<Arc<Calibration>> {
        read(&self.calibration).clone()
    }

    pub(super) fn calibrate(&self, calibration: Option<Calibration>) {
        *write(&self.calibration) = calibration.map(Arc::new);
    }

    pub(super) fn check_model(&self, name: &MapName, model: &ModelId) -> Result<(), PipelineError> {
        if self.model == *model {
            return Ok(());
        }
        Err(PipelineError::ModelMismatch {
            map: name.clone(),
            map_model: self.model.clone(),
            server_model: model.clone(),
        })
    }
}

// No code panics while it holds one of these locks for writing, and the values stay whole if it did.
fn read<T>(lock: &RwLock<T>) -> RwLockReadGuard<'_, T> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

fn write<T>(lock: &RwLock<T>) -> RwLockWriteGuard<'_, T> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

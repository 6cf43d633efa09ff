//! The maps that can be searched, each with its index.
//!
//! A map's entry outlives the map: deleting empties it, the next insert fills it again, so that
//! whoever waits for its lock meanwhile never writes into an orphan. Inserts share the lock,
//! deletions and changes take it alone; both hold it over commit and index together, so the index
//! never keeps what the store has lost. While another head is prepared for a map, what changes
//! meanwhile is noted, so that the new index can catch up.

use super::PipelineError;
use placeformer_core::types::{Calibration, Descriptor, GeoPoint, MapName, ModelId, ReferenceId};
use placeformer_store::StoreError;
use placeformer_vision::extract::Head;
use placeformer_vision::search::{IndexEntry, MapIndex};
use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use time::OffsetDateTime;

#[derive(Default)]
pub(super) struct Maps(RwLock<HashMap<MapName, Arc<MapEntry>>>);

/// One name, whether or not the map exists right now.
#[derive(Default)]
pub(super) struct MapEntry {
    writes: RwLock<()>,
    live: RwLock<Option<Arc<LiveMap>>>,
    /// Changes since another head began to be prepared; none while that is not so.
    journal: Mutex<Option<Vec<Change>>>,
}

/// A change of what an index holds.
pub(super) enum Change {
    Moved(ReferenceId, Option<GeoPoint>, Option<OffsetDateTime>),
    Deleted(ReferenceId),
}

/// How the global descriptors of a map are made.
pub(super) enum Projection {
    /// By the server's own head.
    Server,
    /// By a head that the map keeps, from the server's pooled tokens.
    Own(Arc<Head>),
    /// Not by this server.
    Foreign,
    /// By a head that was lost to the disk.
    Lost,
}

/// A map that exists.
pub(super) struct LiveMap {
    pub(super) model: ModelId,
    pub(super) projection: Projection,
    pub(super) index: MapIndex,
    calibration: RwLock<Option<Arc<Calibration>>>,
}

impl Maps {
    /// The map, if it exists.
    pub(super) fn live(&self, name: &MapName) -> Option<Arc<LiveMap>> {
        self.get(name)?.live()
    }

    /// The entry of a name that was used before.
    pub(super) fn get(&self, name: &MapName) -> Option<Arc<MapEntry>> {
        read(&self.0).get(name).cloned()
    }

    /// The map, which must exist and be comparable with what a server of `model` sees.
    pub(super) fn comparable(
        &self,
        name: &MapName,
        model: &ModelId,
    ) -> Result<Arc<LiveMap>, PipelineError> {
        let live = self
            .live(name)
            .ok_or_else(|| PipelineError::MapNotFound(name.clone()))?;
        live.check_model(name, model)?;
        Ok(live)
    }

    /// The entry of a name, made on first use.
    pub(super) fn entry(&self, name: &MapName) -> Arc<MapEntry> {
        if let Some(entry) = self.get(name) {
            return entry;
        }
        write(&self.0).entry(name.clone()).or_default().clone()
    }

    /// Every entry there is.
    pub(super) fn entries(&self) -> Vec<Arc<MapEntry>> {
        read(&self.0).values().cloned().collect()
    }

    /// All maps that exist.
    pub(super) fn all(&self) -> Vec<(MapName, Arc<LiveMap>)> {
        read(&self.0)
            .iter()
            .filter_map(|(name, entry)| Some((name.clone(), entry.live()?)))
            .collect()
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

    /// The map, brought to life with the server's `model` if it was not.
    pub(super) fn live_or_create(&self, model: &ModelId) -> Arc<LiveMap> {
        if let Some(live) = self.live() {
            return live;
        }
        let fresh = || {
            Arc::new(LiveMap::new(
                model.clone(),
                Projection::Server,
                MapIndex::default(),
                None,
            ))
        };
        write(&self.live).get_or_insert_with(fresh).clone()
    }

    pub(super) fn put(&self, live: LiveMap) -> Arc<LiveMap> {
        write(&self.live).insert(Arc::new(live)).clone()
    }

    pub(super) fn clear(&self) {
        *write(&self.live) = None;
    }

    /// Begins to note changes; false if that is being done already.
    pub(super) fn begin_journal(&self) -> bool {
        let mut journal = lock(&self.journal);
        let begins = journal.is_none();
        journal.get_or_insert_default();
        begins
    }

    /// Notes a change, if anyone wants to know: before the index in force is changed, or while
    /// [`MapEntry::changing`] is held.
    pub(super) fn note(&self, change: Change) {
        if let Some(journal) = lock(&self.journal).as_mut() {
            journal.push(change);
        }
    }

    /// What changed since [`MapEntry::begin_journal`]; ends it.
    pub(super) fn end_journal(&self) -> Vec<Change> {
        lock(&self.journal).take().unwrap_or_default()
    }
}

impl Change {
    pub(super) fn apply(self, index: &MapIndex) {
        match self {
            Self::Deleted(id) => {
                index.remove(id);
            }
            // Only what is in the index moves; a damaged reference is not.
            Self::Moved(id, location, captured_at) => {
                if let Some(global) = index.global(id) {
                    index.insert(IndexEntry {
                        id,
                        global,
                        location,
                        captured_at,
                    });
                }
            }
        }
    }
}

impl LiveMap {
    pub(super) fn new(
        model: ModelId,
        projection: Projection,
        index: MapIndex,
        calibration: Option<Calibration>,
    ) -> Self {
        Self {
            model,
            projection,
            index,
            calibration: RwLock::new(calibration.map(Arc::new)),
        }
    }

    /// The global descriptor, comparable with this map's, of what the server saw.
    pub(super) fn global_of<'d>(&self, descriptor: &'d Descriptor) -> Cow<'d, [f32]> {
        match &self.projection {
            Projection::Own(head) => Cow::Owned(head.project(&descriptor.pooled)),
            Projection::Server | Projection::Foreign | Projection::Lost => {
                Cow::Borrowed(&descriptor.global)
            }
        }
    }

    /// How far its best answers can be trusted, if that was fitted for this map.
    pub(super) fn calibration(&self) -> Option<Arc<Calibration>> {
        read(&self.calibration).clone()
    }

    pub(super) fn calibrate(&self, calibration: Option<Calibration>) {
        *write(&self.calibration) = calibration.map(Arc::new);
    }

    /// Refuses a map that what this server, which runs `model`, sees cannot be compared with.
    pub(super) fn check_model(&self, name: &MapName, model: &ModelId) -> Result<(), PipelineError> {
        match self.projection {
            Projection::Server | Projection::Own(_) => Ok(()),
            Projection::Lost => Err(StoreError::CorruptHead { map: name.clone() }.into()),
            Projection::Foreign => Err(PipelineError::ModelMismatch {
                map: name.clone(),
                map_model: self.model.clone(),
                server_model: model.clone(),
            }),
        }
    }
}

fn lock<T>(lock: &Mutex<T>) -> MutexGuard<'_, T> {
    lock.lock().unwrap_or_else(PoisonError::into_inner)
}

// No code panics while it holds one of these locks for writing, and the values stay whole if it
// did.
fn read<T>(lock: &RwLock<T>) -> RwLockReadGuard<'_, T> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

fn write<T>(lock: &RwLock<T>) -> RwLockWriteGuard<'_, T> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

//! The maps that can be searched, each with its index.
//!
//! A map's entry outlives the map: deleting the map empties the entry, and the next insert fills it
//! again. So a request that waits for the entry's lock while the map is deleted never writes into
//! an index that nobody searches.
//!
//! Inserts share that lock, deletions and changes lock it alone. Both keep it locked over the
//! commit in the store and the change of the index, so the index never keeps what the store has
//! lost. While another head is prepared for a map, the changes made meanwhile are noted in a
//! journal, from which the new index catches up.

use super::PipelineError;
use placeformer_core::types::{
    Altitude, Calibration, Descriptor, GeoPoint, Heading, MapName, ModelId, ReferenceId, Timestamp,
};
use placeformer_store::{GlobalRow, StoreError};
use placeformer_vision::extract::Head;
use placeformer_vision::search::{IndexEntry, MapIndex};
use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// All maps by name.
#[derive(Default)]
pub(super) struct Maps(RwLock<HashMap<MapName, Arc<MapEntry>>>);

/// One name, whether or not the map exists right now.
#[derive(Default)]
pub(super) struct MapEntry {
    /// Locked over a commit in the store and the change of the index that belongs to it.
    writes: RwLock<()>,
    live: RwLock<Option<Arc<LiveMap>>>,
    /// Changes made since another head began to be prepared; `None` while no head is prepared.
    journal: Mutex<Option<Vec<Change>>>,
}

/// A change of an entry of an index.
#[derive(Debug, Clone, Copy)]
pub(super) enum Change {
    /// Another location, height, heading or capture time.
    Moved(Moved),
    /// No longer there.
    Deleted(ReferenceId),
}

/// Where, in which direction and when a reference was taken, as it is from now on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moved {
    pub(super) id: ReferenceId,
    pub(super) location: Option<GeoPoint>,
    pub(super) alt: Option<Altitude>,
    pub(super) heading: Option<Heading>,
    pub(super) captured_at: Option<Timestamp>,
}

/// How the global descriptors of a map are made.
pub(super) enum Projection {
    /// By the server's own head.
    Server,
    /// By a head that the map keeps, from the server's pooled tokens.
    Own(Arc<Head>),
    /// Not by this server.
    Foreign,
    /// By a head of which the store has only damaged bytes.
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

    /// The map, which must exist and have descriptors comparable with those of a server that runs
    /// `model`.
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
    /// The map, if it exists now.
    pub(super) fn live(&self) -> Option<Arc<LiveMap>> {
        read(&self.live).clone()
    }

    /// The lock of an insert, shared with others, to be kept from before the commit until the
    /// reference is in the index.
    pub(super) fn lock_for_insert(&self) -> RwLockReadGuard<'_, ()> {
        read(&self.writes)
    }

    /// The lock of a deletion or change, shared with nobody, to be kept over store and index.
    pub(super) fn lock_for_change(&self) -> RwLockWriteGuard<'_, ()> {
        write(&self.writes)
    }

    /// The map, created empty with the server's `model` if it does not exist.
    pub(super) fn live_or_create(&self, model: &ModelId) -> Arc<LiveMap> {
        if let Some(live) = self.live() {
            return live;
        }
        let empty = || {
            let index = MapIndex::default();
            Arc::new(LiveMap::new(model.clone(), Projection::Server, index, None))
        };
        write(&self.live).get_or_insert_with(empty).clone()
    }

    /// Puts `live` in the place of what was there.
    pub(super) fn put(&self, live: LiveMap) -> Arc<LiveMap> {
        write(&self.live).insert(Arc::new(live)).clone()
    }

    /// The map exists no longer.
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

    /// Notes a change in the journal, if one is kept. To be called before the index in force is
    /// changed, or with [`MapEntry::lock_for_change`] locked; otherwise an index that replaces the
    /// one in force between the two would miss the change.
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
    /// Makes the change in `index`.
    pub(super) fn apply(self, index: &MapIndex) {
        match self {
            Self::Deleted(id) => {
                index.remove(id);
            }
            // A damaged reference is not in the index and does not enter it by being moved.
            Self::Moved(moved) => {
                if let Some(global) = index.global(moved.id) {
                    index.insert(IndexEntry {
                        id: moved.id,
                        global,
                        location: moved.location,
                        alt: moved.alt,
                        heading: moved.heading,
                        captured_at: moved.captured_at,
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

    /// The global descriptor by which this map is searched, from a descriptor that the server made.
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

    /// Replaces the calibration, from the next query on.
    pub(super) fn calibrate(&self, calibration: Option<Calibration>) {
        *write(&self.calibration) = calibration.map(Arc::new);
    }

    /// Refuses a map whose descriptors cannot be compared with those of this server, which runs
    /// `model`.
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

/// A reference of the store as an entry of an index.
pub(super) fn index_entry(row: GlobalRow) -> IndexEntry {
    let GlobalRow {
        reference,
        global,
        location,
        alt,
        heading,
        captured_at,
    } = row;
    IndexEntry {
        id: reference,
        global,
        location,
        alt,
        heading,
        captured_at,
    }
}

// A thread that panics with one of these locks leaves the value whole, because each value is
// changed by one assignment or one call. So a poisoned lock can be used all the same.

fn lock<T>(lock: &Mutex<T>) -> MutexGuard<'_, T> {
    lock.lock().unwrap_or_else(PoisonError::into_inner)
}

fn read<T>(lock: &RwLock<T>) -> RwLockReadGuard<'_, T> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

fn write<T>(lock: &RwLock<T>) -> RwLockWriteGuard<'_, T> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

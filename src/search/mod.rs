//! Exact nearest neighbours among the global descriptors of one map.

use crate::types::{GeoPoint, ReferenceFilter, ReferenceId};
use time::OffsetDateTime;

/// One reference as the index holds it.
#[derive(Debug, Clone, PartialEq)]
pub struct IndexEntry {
    /// Identity.
    pub id: ReferenceId,
    /// Global descriptor, `[256]`.
    pub global: Vec<f32>,
    /// For the geographic filter.
    pub location: Option<GeoPoint>,
    /// For the time filter.
    pub captured_at: Option<OffsetDateTime>,
}

/// A found reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// Identity.
    pub id: ReferenceId,
    /// Euclidean distance between the global descriptors.
    pub distance: f32,
}

/// The global descriptors of one map in memory; searched and changed through `&self` from many threads.
#[derive(Default)]
pub struct MapIndex {}

impl MapIndex {
    /// Builds an index of everything at once.
    pub fn build(_entries: Vec<IndexEntry>) -> Self {
        unimplemented!()
    }

    /// Adds a reference, or replaces the one with its id.
    pub fn insert(&self, _entry: IndexEntry) {
        unimplemented!()
    }

    /// Forgets a reference; false if it was not there.
    pub fn remove(&self, _id: ReferenceId) -> bool {
        unimplemented!()
    }

    /// The `k` nearest that pass `filter`, nearest first, ties by ascending id.
    pub fn search(&self, _query: &[f32], _k: usize, _filter: &ReferenceFilter) -> Vec<Neighbour> {
        unimplemented!()
    }

    /// Number of references.
    pub fn len(&self) -> usize {
        unimplemented!()
    }

    /// Whether it holds none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes on the heap.
    pub fn memory_bytes(&self) -> usize {
        unimplemented!()
    }
}

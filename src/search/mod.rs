//! Exact nearest neighbours among the global descriptors of one map.
//!
//! A query must see every reference of a map (an approximate index loses the very places that re-ranking would have
//! saved), at a million references in milliseconds, while references come and go. The scan is limited by memory
//! bandwidth, so it reads int8 codes, a quarter of the bytes; `scan.rs` proves why the result is exact nevertheless.
//!
//! References live in blocks of 4096 (`block.rs`): sealed ones never change, so a search takes the list of them and
//! scans without a lock while the index moves on; the youngest references are in one open block, the tail, which a
//! search scans first, under a read lock of at most some 40 microseconds. Appending fills the tail, and sealing it
//! moves it. Removing copies a bitmap of 512 bytes. Two blocks that together fit into one are merged as soon as both
//! are at most half alive, which costs each removal a constant share of one copy. So a search sees the index as it was
//! at one instant, and nobody waits long for anyone. The order of the store's ids is the order of insertion, hence
//! blocks are mostly sorted by themselves and their id ranges disjoint; neither is relied upon.

mod block;
mod filter;
mod scan;

use self::block::{Block, CAPACITY, Sealed};
use self::filter::Sieve;
use self::scan::{Part, Query, Top};
use crate::types::{GLOBAL_DIM, GeoPoint, ReferenceFilter, ReferenceId};
use rayon::prelude::*;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
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

/// Blocks scanned by one thread at a time at the least; fewer are not worth sending to another thread.
const BLOCKS_PER_TASK: usize = 4;

/// The global descriptors of one map in memory; searched and changed through `&self` from many threads.
///
/// Takes about 1.35 kB per reference.
#[derive(Default)]
pub struct MapIndex {
    state: RwLock<State>,
}

#[derive(Default)]
struct State {
    /// Shared with searches under way; copied on the next change only if one still holds it.
    sealed: Arc<Vec<Sealed>>,
    /// The youngest references, unsorted.
    tail: Block,
    /// References in all.
    len: usize,
}

impl MapIndex {
    /// Builds an index of everything at once, in parallel; of entries with one id the last counts.
    ///
    /// # Panics
    /// If a descriptor's length is not 256.
    pub fn build(mut entries: Vec<IndexEntry>) -> Self {
        entries.iter().for_each(check);
        entries.par_sort_by_key(|entry| entry.id);
        // Of equal ids, which the stable sort left in order, the last overwrites the one kept.
        entries.dedup_by(|later, kept| {
            let same = later.id == kept.id;
            if same {
                std::mem::swap(later, kept);
            }
            same
        });
        let len = entries.len();
        let tail = Block::of(entries.drain(len - len % CAPACITY..));
        let sealed: Vec<Sealed> =
            entries.into_par_iter().chunks(CAPACITY).map(|chunk| Sealed::new(Block::of(chunk))).collect();
        Self { state: RwLock::new(State { sealed: Arc::new(sealed), tail, len }) }
    }

    /// Adds a reference, or replaces the one with its id.
    ///
    /// # Panics
    /// If the descriptor's length is not 256.
    pub fn insert(&self, entry: IndexEntry) {
        check(&entry);
        let mut state = self.write();
        state.remove(entry.id);
        state.tail.push(&entry);
        state.len += 1;
        if state.tail.len() == CAPACITY {
            let full = std::mem::take(&mut state.tail);
            Arc::make_mut(&mut state.sealed).push(Sealed::new(full));
        }
    }

    /// Forgets a reference; false if it was not there.
    pub fn remove(&self, id: ReferenceId) -> bool {
        self.write().remove(id)
    }

    /// The global descriptor of a reference, `[256]`; `None` if it is not there.
    pub fn global(&self, id: ReferenceId) -> Option<Vec<f32>> {
        let state = self.read();
        if let Some(row) = state.tail.ids.iter().position(|&there| there == id) {
            return Some(state.tail.vector(row).to_vec());
        }
        let (number, row) = state.find_sealed(id)?;
        Some(state.sealed[number].block.vector(row).to_vec())
    }

    /// The `k` nearest that pass `filter`, nearest first, ties by ascending id. Exact; see the module.
    ///
    /// # Panics
    /// If the query's length is not 256.
    pub fn search(&self, query: &[f32], k: usize, filter: &ReferenceFilter) -> Vec<Neighbour> {
        assert_eq!(query.len(), GLOBAL_DIM, "length of a query");
        if k == 0 {
            return Vec::new();
        }
        let query = Query::new(query, k, Sieve::new(filter));
        let mut top = Top::new(k);
        let sealed = {
            let state = self.read();
            let mut part = Part::default();
            part.scan_rows(&query, &state.tail, 0, |_| true);
            part.settle(&query, |_| &state.tail, &mut top);
            Arc::clone(&state.sealed)
        };
        top.announce(&query);
        let scan = |mut part: Part, (number, sealed): (usize, &Sealed)| {
            part.scan(&query, sealed, number);
            part
        };
        let part = if sealed.len() <= BLOCKS_PER_TASK {
            sealed.iter().enumerate().fold(Part::default(), scan)
        } else {
            let parts = sealed.par_iter().enumerate().with_min_len(BLOCKS_PER_TASK).fold(Part::default, scan);
            parts.reduce(Part::default, |a, b| a.joined(b, &query))
        };
        part.settle(&query, |number| &sealed[number as usize].block, &mut top);
        top.into_neighbours()
    }

    /// Number of references.
    pub fn len(&self) -> usize {
        self.read().len
    }

    /// Whether it holds none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes on the heap.
    pub fn memory_bytes(&self) -> usize {
        let state = self.read();
        let sealed: usize = state.sealed.iter().map(Sealed::memory_bytes).sum();
        sealed + state.sealed.capacity() * size_of::<Sealed>() + state.tail.memory_bytes()
    }

    // A panic while writing can only come from running out of memory; what is there stays consistent enough to read.
    fn read(&self) -> RwLockReadGuard<'_, State> {
        self.state.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, State> {
        self.state.write().unwrap_or_else(PoisonError::into_inner)
    }
}

fn check(entry: &IndexEntry) {
    assert_eq!(entry.global.len(), GLOBAL_DIM, "length of the descriptor of {}", entry.id);
}

impl State {
    fn remove(&mut self, id: ReferenceId) -> bool {
        if let Some(row) = self.tail.ids.iter().position(|&there| there == id) {
            self.tail.swap_remove(row);
        } else if let Some((number, row)) = self.find_sealed(id) {
            let sealed = Arc::make_mut(&mut self.sealed);
            sealed[number].remove(row);
            compact(sealed, number);
        } else {
            return false;
        }
        self.len -= 1;
        true
    }

    fn find_sealed(&self, id: ReferenceId) -> Option<(usize, usize)> {
        self.sealed.iter().enumerate().find_map(|(number, sealed)| Some((number, sealed.find(id)?)))
    }
}

/// Merges the block a row was removed from with another, if both are at most half alive.
fn compact(sealed: &mut Vec<Sealed>, number: usize) {
    let sparse = |sealed: &Sealed| sealed.live <= CAPACITY / 2;
    if sealed[number].live == 0 {
        sealed.swap_remove(number);
    } else if sparse(&sealed[number])
        && let Some(other) = (0..sealed.len()).find(|&other| other != number && sparse(&sealed[other]))
    {
        sealed[number] = sealed[number].merged(&sealed[other]);
        sealed.swap_remove(other);
    }
}

#[cfg(test)]
mod tests;

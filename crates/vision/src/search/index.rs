//! The index of one map: searched and changed at the same time.

use super::block::{Block, CAPACITY};
use super::entry::{IndexEntry, LocatedReference, Neighbour};
use super::filter::PreparedFilter;
use super::list::BlockList;
use super::near::{Circles, thinned};
use super::nearest::{Nearest, squared_distance};
use super::quantised::QuantisedVector;
use super::scan::{Candidates, Query};
use super::sealed::SealedBlock;
use placeformer_core::types::{GLOBAL_DIM, GeoCircle, ReferenceFilter, ReferenceId};
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::{PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// Least number of blocks that one thread scans at a time. For fewer, handing them to another
/// thread would take longer than scanning them.
const BLOCKS_PER_TASK: usize = 4;

/// The global descriptors of one map in memory. Searched and changed through `&self` from many
/// threads.
///
/// Takes about 1.35 kB for each reference.
#[derive(Default)]
pub struct MapIndex {
    state: RwLock<State>,
}

#[derive(Default)]
struct State {
    /// Shared with the searches that are running.
    sealed: BlockList,
    /// The newest references, unsorted.
    tail: Block,
    /// The row of each reference in the tail.
    tail_rows: HashMap<ReferenceId, u32>,
    /// No id that was ever inserted is above this one; `None` if none was inserted.
    highest: Option<ReferenceId>,
    /// Number of references, in sealed blocks and in the tail.
    len: usize,
}

impl MapIndex {
    /// Builds an index of all `entries` at once, in parallel. If several have one id, the last one
    /// counts.
    ///
    /// # Panics
    /// If a descriptor's length is not 256.
    pub fn build(mut entries: Vec<IndexEntry>) -> Self {
        entries.iter().for_each(IndexEntry::assert_length);
        entries.par_sort_by_key(|entry| entry.id);
        keep_last_of_each_id(&mut entries);
        let len = entries.len();
        let highest = entries.last().map(|entry| entry.id);
        let tail = Block::of(entries.drain(len - len % CAPACITY..));
        let sealed: Vec<SealedBlock> = entries
            .into_par_iter()
            .chunks(CAPACITY)
            .map(|chunk| SealedBlock::new(Block::of(chunk)))
            .collect();
        Self::of(BlockList::new(sealed), tail, highest, len)
    }

    /// An index of `len` references in sealed blocks and a tail.
    pub(super) fn of(
        sealed: BlockList,
        tail: Block,
        highest: Option<ReferenceId>,
        len: usize,
    ) -> Self {
        let tail_rows = tail.ids.iter().copied().zip(0..).collect();
        let state = State {
            sealed,
            tail,
            tail_rows,
            highest,
            len,
        };
        Self {
            state: RwLock::new(state),
        }
    }

    /// Adds a reference, or replaces the one with the same id.
    ///
    /// # Panics
    /// If the descriptor's length is not 256.
    pub fn insert(&self, entry: IndexEntry) {
        entry.assert_length();
        let quantised = QuantisedVector::new(&entry.global);
        self.write().insert(&entry, quantised);
    }

    /// Removes a reference; false if it was not there.
    pub fn remove(&self, id: ReferenceId) -> bool {
        self.write().remove(id)
    }

    /// The global descriptor of a reference, `[256]`; `None` if it is not there.
    pub fn global(&self, id: ReferenceId) -> Option<Vec<f32>> {
        let state = self.read();
        let (block, row) = state.row(id)?;
        Some(block.vector(row).to_vec())
    }

    /// Where each of these references was taken; `None` for one that has no location or is not
    /// there.
    pub fn located(&self, ids: &[ReferenceId]) -> Vec<Option<LocatedReference>> {
        let state = self.read();
        let located = |&id: &ReferenceId| {
            let (block, row) = state.row(id)?;
            block.places[row].located(id)
        };
        ids.iter().map(located).collect()
    }

    /// These references with their distances to `query` (`[256]`), without those that are not
    /// there.
    ///
    /// # Panics
    /// If the query's length is not 256.
    pub fn compare(&self, query: &[f32], ids: &[ReferenceId]) -> Vec<Neighbour> {
        assert_eq!(query.len(), GLOBAL_DIM, "length of a query");
        let state = self.read();
        let compare = |&id: &ReferenceId| {
            let (block, row) = state.row(id)?;
            let distance = squared_distance(query, block.vector(row)).sqrt();
            Some(Neighbour { id, distance })
        };
        ids.iter().filter_map(compare).collect()
    }

    /// The references in any of these circles that pass `filter`, by ascending id. Where there are
    /// more than `limit`, as many of them, spread over the map.
    pub fn near(
        &self,
        circles: &[GeoCircle],
        filter: &ReferenceFilter,
        limit: usize,
    ) -> Vec<LocatedReference> {
        let circles = Circles::new(circles);
        let filter = PreparedFilter::new(filter);
        let (mut found, sealed) = {
            let state = self.read();
            let in_tail = circles.collect(&state.tail, &filter, |_| true, limit);
            (in_tail, state.sealed.clone())
        };
        let in_block = |number: usize| {
            let block = sealed.get(number)?;
            Some(circles.collect(&block.block, &filter, |row| block.is_live(row), limit))
        };
        let in_sealed: Vec<Vec<LocatedReference>> = (0..sealed.end())
            .into_par_iter()
            .with_min_len(BLOCKS_PER_TASK)
            .filter_map(in_block)
            .collect();
        found.extend(in_sealed.into_iter().flatten());
        thinned(found, limit)
    }

    /// The `k` references nearest to `query` (`[256]`) that pass `filter`: nearest first, equally
    /// near ones by ascending id. Exact (see `scan`).
    ///
    /// # Panics
    /// If the query's length is not 256.
    pub fn search(&self, query: &[f32], k: usize, filter: &ReferenceFilter) -> Vec<Neighbour> {
        assert_eq!(query.len(), GLOBAL_DIM, "length of a query");
        if k == 0 {
            return Vec::new();
        }
        let query = Query::new(query, k, PreparedFilter::new(filter));
        let mut nearest = Nearest::new(k);
        let sealed = {
            let state = self.read();
            search_tail(&query, &state.tail, &mut nearest);
            state.sealed.clone()
        };
        if let Some(distance) = nearest.worst() {
            // Only what is nearer than the k-th of the tail can still be among the k nearest.
            query.lower_threshold(distance);
        }
        let candidates = scan_sealed(&query, &sealed);
        candidates.rank(&query, |number| sealed.block(number), &mut nearest);
        nearest.into_neighbours()
    }

    /// Number of references.
    pub fn len(&self) -> usize {
        self.read().len
    }

    /// Whether it holds no reference.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes on the heap.
    pub fn memory_bytes(&self) -> usize {
        let state = self.read();
        // A hash table has one control byte for each slot, and keeps an eighth of the slots free.
        let slots = state.tail_rows.capacity() * 8 / 7;
        let tail_rows = slots * (size_of::<(ReferenceId, u32)>() + 1);
        state.sealed.memory_bytes() + state.tail.memory_bytes() + tail_rows
    }

    // The lock can only be poisoned by a panic for lack of memory. What is there remains consistent
    // enough to be searched.
    fn read(&self) -> RwLockReadGuard<'_, State> {
        self.state.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, State> {
        self.state.write().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Removes all but the last of several entries with one id. They are adjacent and, because the sort
/// was stable, in the order in which they were given.
fn keep_last_of_each_id(entries: &mut Vec<IndexEntry>) {
    entries.dedup_by(|later, kept| {
        let is_same = later.id == kept.id;
        if is_same {
            // The first argument is the one that is dropped.
            std::mem::swap(later, kept);
        }
        is_same
    });
}

/// Searches the tail completely, so that its lock can be released.
fn search_tail(query: &Query<'_>, tail: &Block, nearest: &mut Nearest) {
    let mut candidates = Candidates::default();
    candidates.scan_rows(query, tail, 0, |_| true);
    candidates.rank(query, |_| tail, nearest);
}

/// The references in sealed blocks that may be among the nearest.
fn scan_sealed(query: &Query<'_>, sealed: &BlockList) -> Candidates {
    let scan = |mut candidates: Candidates, number: usize| {
        if let Some(block) = sealed.get(number) {
            candidates.scan(query, block, number);
        }
        candidates
    };
    let end = sealed.end();
    if end <= BLOCKS_PER_TASK {
        return (0..end).fold(Candidates::default(), scan);
    }
    (0..end)
        .into_par_iter()
        .with_min_len(BLOCKS_PER_TASK)
        .fold(Candidates::default, scan)
        .reduce(Candidates::default, |a, b| a.joined(b, query))
}

impl State {
    /// The block and the row of a reference.
    fn row(&self, id: ReferenceId) -> Option<(&Block, usize)> {
        match self.tail_rows.get(&id) {
            Some(&row) => Some((&self.tail, row as usize)),
            None => self.sealed.row(id),
        }
    }

    fn insert(&mut self, entry: &IndexEntry, quantised: QuantisedVector) {
        if self.highest.is_none_or(|highest| entry.id > highest) {
            self.highest = Some(entry.id);
        } else {
            // Only an id that is not the highest so far can be there already.
            self.remove(entry.id);
        }
        self.tail_rows.insert(entry.id, self.tail.len() as u32);
        self.tail.push(entry, quantised);
        self.len += 1;
        if self.tail.len() == CAPACITY {
            self.tail_rows.clear();
            let full = std::mem::take(&mut self.tail);
            self.sealed.push(SealedBlock::new(full));
        }
    }

    fn remove(&mut self, id: ReferenceId) -> bool {
        if let Some(row) = self.tail_rows.remove(&id) {
            let row_index = row as usize;
            self.tail.swap_remove(row_index);
            // The last row has taken the place of the removed one, unless it was the last itself.
            if let Some(&moved) = self.tail.ids.get(row_index) {
                self.tail_rows.insert(moved, row);
            }
        } else if !self.sealed.remove(id) {
            return false;
        }
        self.len -= 1;
        true
    }
}

//! Exact nearest neighbours among the global descriptors of one map.
//!
//! A query must see every reference of a map (an approximate index loses the very places that
//! re-ranking would have saved), at a million references in milliseconds, while references come and
//! go. The scan is limited by memory bandwidth, so it reads int8 codes, a quarter of the bytes;
//! `scan.rs` proves why the result is exact nevertheless.
//!
//! References live in blocks of 4096 (`block.rs`): sealed ones never change, so a search takes the
//! list of them (`list.rs`) and scans without a lock while the index moves on; the youngest
//! references are in one open block, the tail, which a search scans first, under a read lock of at
//! most some 40 microseconds. Appending fills the tail, and sealing it moves it; an id above all
//! before it, as the store's are, is not looked for. Removing copies a bitmap of 512 bytes, and
//! beside a search the names of 64 blocks. Two blocks that together fit into one are merged as soon
//! as both are at most half alive, which costs each removal a constant share of one copy. So a
//! search sees the index as it was at one instant, and nobody waits long for anyone. The order of
//! the store's ids is the order of insertion, hence blocks are mostly sorted by themselves and
//! their id ranges disjoint; neither is relied upon.

mod block;
mod build;
mod filter;
mod list;
mod scan;

use self::block::{Block, CAPACITY, Quantised, Sealed};
pub use self::build::IndexBuilder;
use self::filter::Sieve;
use self::list::BlockList;
use self::scan::{Part, Query, Top};
use placeformer_core::types::{GLOBAL_DIM, GeoPoint, ReferenceFilter, ReferenceId};
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::{PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
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

/// Blocks scanned by one thread at a time at the least; fewer are not worth sending to another
/// thread.
const BLOCKS_PER_TASK: usize = 4;

/// The global descriptors of one map in memory; searched and changed through `&self` from many
/// threads.
///
/// Takes about 1.35 kB per reference.
#[derive(Default)]
pub struct MapIndex {
    state: RwLock<State>,
}

#[derive(Default)]
struct State {
    /// Shared with searches under way.
    sealed: BlockList,
    /// The youngest references, unsorted.
    tail: Block,
    /// The row of each in the tail.
    tail_rows: HashMap<ReferenceId, u32>,
    /// Not below any id that has ever been inserted; absent as long as none was.
    highest: Option<ReferenceId>,
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
        let (len, highest) = (entries.len(), entries.last().map(|entry| entry.id));
        let tail = Block::of(entries.drain(len - len % CAPACITY..));
        let sealed: Vec<Sealed> = entries
            .into_par_iter()
            .chunks(CAPACITY)
            .map(|chunk| Sealed::new(Block::of(chunk)))
            .collect();
        Self::of(BlockList::new(sealed), tail, highest, len)
    }

    /// An index of `len` references in sealed blocks and a tail.
    fn of(sealed: BlockList, tail: Block, highest: Option<ReferenceId>, len: usize) -> Self {
        let tail_rows = tail.ids.iter().copied().zip(0..).collect();
        Self {
            state: RwLock::new(State {
                sealed,
                tail,
                tail_rows,
                highest,
                len,
            }),
        }
    }

    /// Adds a reference, or replaces the one with its id.
    ///
    /// # Panics
    /// If the descriptor's length is not 256.
    pub fn insert(&self, entry: IndexEntry) {
        check(&entry);
        let quantised = Quantised::new(&entry.global);
        let mut guard = self.write();
        let state = &mut *guard;
        if state.highest.is_none_or(|highest| entry.id > highest) {
            state.highest = Some(entry.id);
        } else {
            state.remove(entry.id);
        }
        state.tail_rows.insert(entry.id, state.tail.len() as u32);
        state.tail.push(&entry, quantised);
        state.len += 1;
        if state.tail.len() == CAPACITY {
            state.tail_rows.clear();
            state
                .sealed
                .push(Sealed::new(std::mem::take(&mut state.tail)));
        }
    }

    /// Forgets a reference; false if it was not there.
    pub fn remove(&self, id: ReferenceId) -> bool {
        self.write().remove(id)
    }

    /// The global descriptor of a reference, `[256]`; `None` if it is not there.
    pub fn global(&self, id: ReferenceId) -> Option<Vec<f32>> {
        let state = self.read();
        if let Some(&row) = state.tail_rows.get(&id) {
            return Some(state.tail.vector(row as usize).to_vec());
        }
        state.sealed.vector(id).map(<[f32]>::to_vec)
    }

    /// The `k` nearest that pass `filter`, nearest first, ties by ascending id. Exact; see the
    /// module.
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
            state.sealed.clone()
        };
        top.announce(&query);
        let scan = |mut part: Part, number: usize| {
            if let Some(block) = sealed.get(number) {
                part.scan(&query, block, number);
            }
            part
        };
        let part = if sealed.end() <= BLOCKS_PER_TASK {
            (0..sealed.end()).fold(Part::default(), scan)
        } else {
            let parts = (0..sealed.end())
                .into_par_iter()
                .with_min_len(BLOCKS_PER_TASK)
                .fold(Part::default, scan);
            parts.reduce(Part::default, |a, b| a.joined(b, &query))
        };
        part.settle(&query, |number| sealed.block(number as usize), &mut top);
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
        // Beside each entry of the table one byte of control; an eighth of the table stays free.
        let rows = state.tail_rows.capacity() * 8 / 7 * (size_of::<(ReferenceId, u32)>() + 1);
        state.sealed.memory_bytes() + state.tail.memory_bytes() + rows
    }

    // A panic while writing can only come from running out of memory; what is there stays
    // consistent enough to read.
    fn read(&self) -> RwLockReadGuard<'_, State> {
        self.state.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, State> {
        self.state.write().unwrap_or_else(PoisonError::into_inner)
    }
}

fn check(entry: &IndexEntry) {
    assert_eq!(
        entry.global.len(),
        GLOBAL_DIM,
        "length of the descriptor of {}",
        entry.id
    );
}

impl State {
    fn remove(&mut self, id: ReferenceId) -> bool {
        if let Some(row) = self.tail_rows.remove(&id) {
            self.tail.swap_remove(row as usize);
            if let Some(&moved) = self.tail.ids.get(row as usize) {
                self.tail_rows.insert(moved, row);
            }
        } else if !self.sealed.remove(id) {
            return false;
        }
        self.len -= 1;
        true
    }
}

#[cfg(test)]
mod tests;

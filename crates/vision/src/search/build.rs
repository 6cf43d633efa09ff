//! An index from references that a store gives one after another.
//!
//! Collecting a whole map before building its index would hold every vector twice, and leave all
//! threads idle but the one that reads. Here references are packed into blocks while the next ones
//! are read: as soon as there are enough for a block, a thread of the rayon pool makes one of them.
//! If too many wait for a thread, the reading thread packs a block itself, so that memory stays
//! bounded.

use super::block::{Block, CAPACITY};
use super::entry::IndexEntry;
use super::index::MapIndex;
use super::list::BlockList;
use super::sealed::SealedBlock;
use placeformer_core::types::ReferenceId;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Most batches of references that wait for a thread, for each thread of the pool.
const WAITING_PER_THREAD: usize = 2;

/// Takes references and becomes their index. If several have one id, the last one counts.
#[derive(Default)]
pub struct IndexBuilder {
    /// References for the next block, with ascending ids.
    batch: Vec<IndexEntry>,
    /// References whose id is not above all ids before, so that they may replace an earlier one.
    /// The ids of a store ascend, so there are few of these.
    out_of_order: Vec<IndexEntry>,
    highest: Option<ReferenceId>,
    /// Number of batches that were handed to the pool.
    handed_over: usize,
    /// The blocks that are done, each with its number.
    done: Arc<Mutex<Vec<(usize, SealedBlock)>>>,
}

impl IndexBuilder {
    /// Adds a reference.
    ///
    /// # Panics
    /// If the descriptor's length is not 256.
    pub fn push(&mut self, entry: IndexEntry) {
        entry.assert_length();
        if self.highest.is_some_and(|highest| entry.id <= highest) {
            self.out_of_order.push(entry);
            return;
        }
        self.highest = Some(entry.id);
        self.batch.push(entry);
        if self.batch.len() == CAPACITY {
            self.hand_over();
        }
    }

    /// Number of references taken so far; several with one id are counted each.
    pub fn len(&self) -> usize {
        self.handed_over * CAPACITY + self.batch.len() + self.out_of_order.len()
    }

    /// Whether no reference was taken.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The index of all references that were taken.
    pub fn finish(self) -> MapIndex {
        let len = self.handed_over * CAPACITY + self.batch.len();
        let tail = Block::of(self.batch);
        wait_for(self.handed_over, &self.done);
        let mut numbered = std::mem::take(&mut *lock(&self.done));
        numbered.sort_unstable_by_key(|(number, _)| *number);
        let blocks = numbered.into_iter().map(|(_, block)| block).collect();
        let index = MapIndex::of(BlockList::new(blocks), tail, self.highest, len);
        for entry in self.out_of_order {
            index.insert(entry);
        }
        index
    }

    /// Makes a block of the batch: in another thread, or here if too many are waiting.
    fn hand_over(&mut self) {
        let entries = std::mem::take(&mut self.batch);
        let number = self.handed_over;
        let waiting = self.handed_over - lock(&self.done).len();
        self.handed_over += 1;
        let done = Arc::clone(&self.done);
        let pack = move || {
            let block = SealedBlock::new(Block::of(entries));
            lock(&done).push((number, block));
        };
        if waiting < WAITING_PER_THREAD * rayon::current_num_threads() {
            rayon::spawn(pack);
        } else {
            pack();
        }
    }
}

/// Waits until `count` blocks are done.
///
/// This may be a thread of the pool itself, and the only one that can pack the waiting batches. So
/// it executes what is waiting, and sleeps only if there is nothing.
fn wait_for(count: usize, done: &Mutex<Vec<(usize, SealedBlock)>>) {
    while lock(done).len() < count {
        if rayon::yield_now() != Some(rayon::Yield::Executed) {
            std::thread::sleep(Duration::from_micros(100));
        }
    }
}

// A push to a vector is complete or has not happened, so a poisoned lock does not matter.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::{GLOBAL_DIM, ReferenceFilter};
    use proptest::prelude::*;

    fn entry(number: u64, value: u64) -> IndexEntry {
        let global = (0..GLOBAL_DIM as u64)
            .map(|i| ((value * 31 + i * i * 7) % 101) as f32 / 101.0)
            .collect();
        let id = ReferenceId::from_bytes(u128::from(number).to_be_bytes());
        IndexEntry {
            id,
            global,
            location: None,
            alt: None,
            heading: None,
            captured_at: None,
        }
    }

    fn assert_same(a: &MapIndex, b: &MapIndex) {
        assert_eq!(a.len(), b.len());
        for value in 0..3 {
            let query = entry(0, 1000 + value).global;
            let filter = ReferenceFilter::default();
            assert_eq!(
                a.search(&query, usize::MAX, &filter),
                b.search(&query, usize::MAX, &filter)
            );
        }
    }

    fn built(entries: &[IndexEntry]) -> MapIndex {
        let mut builder = IndexBuilder::default();
        entries
            .iter()
            .cloned()
            .for_each(|entry| builder.push(entry));
        assert_eq!(
            (builder.len(), builder.is_empty()),
            (entries.len(), entries.is_empty())
        );
        builder.finish()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn whatever_the_order_the_index_is_that_of_building_at_once(
            ids in prop::collection::vec(0u64..300, 0..40),
            ascending in 0u64..400,
            at in 0usize..400,
        ) {
            let ascending = (0..ascending).map(|number| entry(number * 2, number));
            let mut entries: Vec<_> = ascending.collect();
            let more = (500..).zip(&ids).map(|(value, &number)| entry(number, value));
            let at = at.min(entries.len());
            entries.splice(at..at, more);
            assert_same(&built(&entries), &MapIndex::build(entries));
        }
    }

    #[test]
    fn a_pool_of_one_thread_builds_from_within_and_from_without() {
        let entries: Vec<_> = (0..20 * CAPACITY as u64 + 5)
            .map(|number| entry(number, number))
            .collect();
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .unwrap();
        let index = pool.install(|| built(&entries));
        assert_same(&index, &built(&entries));
        // An index that was built this way can be changed like any other.
        index.insert(entry(3, 7));
        assert!(index.remove(entries[4].id) && !index.remove(entries[4].id));
        assert_eq!(index.len(), entries.len() - 1);
        index.insert(entry(1 << 40, 1));
        assert_eq!(index.len(), entries.len());
    }
}

//! An index from references as a store gives them, one after another.
//!
//! Collecting a map first and building then would hold every vector twice and leave all threads but
//! the reader's idle. Here references are packed into blocks while the next ones are read: whenever
//! a block's worth has come, a thread of the rayon pool turns it into one. If the others do not
//! keep up, the reader lends a hand instead of piling up more.

use super::block::{Block, CAPACITY, Sealed};
use super::list::BlockList;
use super::{IndexEntry, MapIndex, check};
use placeformer_core::types::ReferenceId;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Block's worths waiting for a thread at most, for each thread.
const WAITING_PER_THREAD: usize = 2;

/// Takes references and becomes their index; of those with one id the last counts.
#[derive(Default)]
pub struct IndexBuilder {
    filling: Vec<IndexEntry>,
    /// Those whose id is not above all before, which may replace an earlier one. The store's ids
    /// ascend, so that they are few.
    late: Vec<IndexEntry>,
    highest: Option<ReferenceId>,
    /// Blocks handed to the pool, by their order.
    handed: usize,
    sealed: Arc<Mutex<Vec<(usize, Sealed)>>>,
}

impl IndexBuilder {
    /// Adds a reference.
    ///
    /// # Panics
    /// If the descriptor's length is not 256.
    pub fn push(&mut self, entry: IndexEntry) {
        check(&entry);
        if self.highest.is_some_and(|highest| entry.id <= highest) {
            self.late.push(entry);
            return;
        }
        self.highest = Some(entry.id);
        self.filling.push(entry);
        if self.filling.len() == CAPACITY {
            self.hand_over();
        }
    }

    /// References taken so far, those with the id of an earlier one among them.
    pub fn len(&self) -> usize {
        self.handed * CAPACITY + self.filling.len() + self.late.len()
    }

    /// Whether none was taken.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The index of all that was taken.
    pub fn finish(self) -> MapIndex {
        let len = self.handed * CAPACITY + self.filling.len();
        let tail = Block::of(self.filling);
        while lock(&self.sealed).len() < self.handed {
            // Within the pool, this thread may be the one that has the blocks waiting.
            if rayon::yield_now() != Some(rayon::Yield::Executed) {
                std::thread::sleep(Duration::from_micros(100));
            }
        }
        let mut sealed = std::mem::take(&mut *lock(&self.sealed));
        sealed.sort_unstable_by_key(|(number, _)| *number);
        let blocks = BlockList::new(sealed.into_iter().map(|(_, block)| block).collect());
        let index = MapIndex::of(blocks, tail, self.highest, len);
        self.late.into_iter().for_each(|entry| index.insert(entry));
        index
    }

    fn hand_over(&mut self) {
        let (entries, number) = (std::mem::take(&mut self.filling), self.handed);
        let waiting = self.handed - lock(&self.sealed).len();
        self.handed += 1;
        let sealed = Arc::clone(&self.sealed);
        let pack = move || {
            let block = Sealed::new(Block::of(entries));
            lock(&sealed).push((number, block));
        };
        if waiting < WAITING_PER_THREAD * rayon::current_num_threads() {
            rayon::spawn(pack)
        } else {
            pack()
        }
    }
}

// Pushing to a vector leaves nothing half done that matters.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
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
            captured_at: None,
        }
    }

    fn same(a: &MapIndex, b: &MapIndex) {
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
            ids in prop::collection::vec(0u64..300, 0..40), ascending in 0u64..400, at in 0usize..400,
        ) {
            let mut entries: Vec<_> = (0..ascending).map(|number| entry(number * 2, number)).collect();
            let more = ids.iter().enumerate().map(|(i, &number)| entry(number, 500 + i as u64));
            let at = at.min(entries.len());
            entries.splice(at..at, more);
            same(&built(&entries), &MapIndex::build(entries));
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
        same(&index, &built(&entries));
        // What was built goes on changing like any other.
        index.insert(entry(3, 7));
        assert!(index.remove(entries[4].id) && !index.remove(entries[4].id));
        assert_eq!(index.len(), entries.len() - 1);
        index.insert(entry(1 << 40, 1));
        assert_eq!(index.len(), entries.len());
    }
}

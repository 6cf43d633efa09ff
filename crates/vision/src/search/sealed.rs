//! A full block that no longer changes, and which of its rows are still valid.

use super::block::Block;
use placeformer_core::types::ReferenceId;
use std::sync::Arc;

/// A block that is shared with searches and therefore never changes. References are removed by
/// marking their rows. Cheap to clone.
#[derive(Debug, Clone)]
pub(super) struct SealedBlock {
    pub block: Arc<Block>,
    /// One bit for each row, set if the row is removed; `None` while no row is.
    removed: Option<Arc<[u64]>>,
    /// Number of rows that are not removed.
    pub live: usize,
    /// The lowest and the highest id. They are kept here, because reading them from the block would
    /// load memory that a look-up mostly does not need.
    pub id_range: (ReferenceId, ReferenceId),
}

impl SealedBlock {
    /// Seals a block, sorting it by id.
    ///
    /// # Panics
    /// If it has no rows.
    pub(super) fn new(block: Block) -> Self {
        let block = block.sorted();
        let live = block.len();
        let id_range = (block.ids[0], block.ids[live - 1]);
        Self {
            block: Arc::new(block),
            removed: None,
            live,
            id_range,
        }
    }

    /// Whether a row is not removed.
    pub(super) fn is_live(&self, row: usize) -> bool {
        match &self.removed {
            Some(bits) => bits[row / 64] >> (row % 64) & 1 == 0,
            None => true,
        }
    }

    /// The row of a reference, if it is here and not removed.
    pub(super) fn find(&self, id: ReferenceId) -> Option<usize> {
        let (lowest, highest) = self.id_range;
        if id < lowest || id > highest {
            return None;
        }
        let row = self.block.ids.binary_search(&id).ok()?;
        self.is_live(row).then_some(row)
    }

    /// Removes a row, which must be live. Searches that hold a clone of this block still see it.
    pub(super) fn remove(&mut self, row: usize) {
        let mut bits: Vec<u64> = match &self.removed {
            Some(bits) => bits.to_vec(),
            None => vec![0; self.block.len().div_ceil(64)],
        };
        bits[row / 64] |= 1 << (row % 64);
        self.removed = Some(bits.into());
        self.live -= 1;
    }

    /// One block of the rows of both that are not removed.
    pub(super) fn merged(&self, other: &Self) -> Self {
        let mut merged = Block::with_full_capacity();
        for sealed in [self, other] {
            for row in 0..sealed.block.len() {
                if sealed.is_live(row) {
                    merged.push_row(&sealed.block, row);
                }
            }
        }
        let mut merged = merged.sorted();
        merged.shrink_to_fit();
        Self::new(merged)
    }

    /// Bytes on the heap.
    pub(super) fn memory_bytes(&self) -> usize {
        let removed = self.removed.as_ref().map_or(0, |bits| bits.len() * 8);
        self.block.memory_bytes() + removed
    }
}

//! The sealed blocks of a map: shared with searches, found by id, merged as they become empty.
//!
//! A search keeps the list of the blocks that it scans. A change during that time must not alter
//! this list, and so has to copy it. To keep the copy small, the list is divided into groups of 64
//! blocks, each shared through a pointer of its own: a search copies one pointer for every quarter
//! of a million references, and a change copies one group at most.
//!
//! Groups and blocks know the range of their ids, so that looking up an id reads hardly any block
//! but the right one. The ids of the store ascend, which makes the ranges mostly disjoint; nothing
//! depends on that.

use super::block::{Block, CAPACITY};
use super::sealed::SealedBlock;
use placeformer_core::types::ReferenceId;
use std::sync::Arc;

/// Number of blocks in a full group.
#[cfg(not(test))]
const GROUP: usize = 64;
/// Small in unit tests, so that they have many borders between groups.
#[cfg(test)]
const GROUP: usize = 4;

/// Sealed blocks. Cheap to clone.
#[derive(Debug, Clone, Default)]
pub(super) struct BlockList {
    groups: Vec<Arc<Group>>,
}

/// Some blocks of a list.
#[derive(Debug, Clone)]
struct Group {
    blocks: Vec<SealedBlock>,
    /// The lowest and the highest id. Removals do not narrow it.
    id_range: (ReferenceId, ReferenceId),
    /// Number of blocks that are sparse; see [`is_sparse`].
    sparse: usize,
}

/// Where a block is in a list.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct BlockPosition {
    group: usize,
    /// Within the group.
    block: usize,
}

/// Where a reference is in a list.
#[derive(Debug, Clone, Copy)]
struct RowPosition {
    block: BlockPosition,
    row: usize,
}

/// Whether at most half of a block's capacity is in use. Two such blocks fit into one.
fn is_sparse(sealed: &SealedBlock) -> bool {
    sealed.live <= CAPACITY / 2
}

/// The smallest range that contains both.
fn union(
    a: (ReferenceId, ReferenceId),
    b: (ReferenceId, ReferenceId),
) -> (ReferenceId, ReferenceId) {
    (a.0.min(b.0), a.1.max(b.1))
}

impl Group {
    fn new(blocks: Vec<SealedBlock>) -> Self {
        let ranges = blocks.iter().map(|block| block.id_range);
        let lowest_id = ReferenceId::from_bytes([0; 16]);
        let id_range = ranges.reduce(union).unwrap_or((lowest_id, lowest_id));
        let sparse = blocks.iter().filter(|block| is_sparse(block)).count();
        Self {
            blocks,
            id_range,
            sparse,
        }
    }

    /// The block and the row of a reference.
    fn find(&self, id: ReferenceId) -> Option<(usize, usize)> {
        let (lowest, highest) = self.id_range;
        if id < lowest || id > highest {
            return None;
        }
        let mut blocks = self.blocks.iter().enumerate();
        blocks.find_map(|(block, sealed)| Some((block, sealed.find(id)?)))
    }

    fn push(&mut self, sealed: SealedBlock) {
        self.id_range = union(self.id_range, sealed.id_range);
        self.sparse += usize::from(is_sparse(&sealed));
        self.blocks.push(sealed);
    }

    /// Whether at most half of the group is in use. Two such groups fit into one.
    fn is_small(&self) -> bool {
        self.blocks.len() <= GROUP / 2
    }

    /// Bytes on the heap.
    fn memory_bytes(&self) -> usize {
        let blocks: usize = self.blocks.iter().map(SealedBlock::memory_bytes).sum();
        let list = self.blocks.capacity() * size_of::<SealedBlock>();
        blocks + list + size_of::<Self>()
    }
}

impl BlockList {
    /// A list of `blocks`, none of which is empty.
    pub(super) fn new(blocks: Vec<SealedBlock>) -> Self {
        let mut list = Self::default();
        let mut blocks = blocks.into_iter().peekable();
        while blocks.peek().is_some() {
            let group = Group::new(blocks.by_ref().take(GROUP).collect());
            list.groups.push(Arc::new(group));
        }
        list
    }

    /// Appends a block.
    pub(super) fn push(&mut self, sealed: SealedBlock) {
        match self.groups.last_mut() {
            Some(last) if last.blocks.len() < GROUP => Arc::make_mut(last).push(sealed),
            _ => self.groups.push(Arc::new(Group::new(vec![sealed]))),
        }
    }

    /// The lowest number that is above those of all blocks. Not every number below it is that of a
    /// block.
    pub(super) fn end(&self) -> usize {
        match self.groups.last() {
            Some(last) => (self.groups.len() - 1) * GROUP + last.blocks.len(),
            None => 0,
        }
    }

    /// The block of that number, if there is one.
    pub(super) fn get(&self, number: usize) -> Option<&SealedBlock> {
        let group = self.groups.get(number / GROUP)?;
        group.blocks.get(number % GROUP)
    }

    /// The rows of the block of that number.
    ///
    /// # Panics
    /// If there is none: the number must be one for which [`get`](Self::get) gave a block.
    pub(super) fn block(&self, number: usize) -> &Block {
        let group = &self.groups[number / GROUP];
        &group.blocks[number % GROUP].block
    }

    /// The block and the row of a reference; `None` if it is not there or removed.
    pub(super) fn row(&self, id: ReferenceId) -> Option<(&Block, usize)> {
        let found = self.find(id)?;
        Some((&self.at(found.block).block, found.row))
    }

    /// Removes a reference; false if it is not there.
    pub(super) fn remove(&mut self, id: ReferenceId) -> bool {
        let Some(found) = self.find(id) else {
            return false;
        };
        let group = Arc::make_mut(&mut self.groups[found.block.group]);
        let sealed = &mut group.blocks[found.block.block];
        let was_sparse = is_sparse(sealed);
        sealed.remove(found.row);
        if !was_sparse && is_sparse(sealed) {
            group.sparse += 1;
        }
        self.compact(found.block);
        true
    }

    /// Bytes on the heap.
    pub(super) fn memory_bytes(&self) -> usize {
        let groups: usize = self.groups.iter().map(|group| group.memory_bytes()).sum();
        groups + self.groups.capacity() * size_of::<Arc<Group>>()
    }

    fn at(&self, position: BlockPosition) -> &SealedBlock {
        &self.groups[position.group].blocks[position.block]
    }

    fn find(&self, id: ReferenceId) -> Option<RowPosition> {
        let mut groups = self.groups.iter().enumerate();
        groups.find_map(|(group, content)| {
            let (block, row) = content.find(id)?;
            let block = BlockPosition { group, block };
            Some(RowPosition { block, row })
        })
    }

    /// After a removal from this block: drops it if it is empty, or merges it with another one if
    /// both are sparse.
    fn compact(&mut self, position: BlockPosition) {
        let sealed = self.at(position);
        if sealed.live == 0 {
            self.take(position);
        } else if is_sparse(sealed)
            && let Some(other) = self.other_sparse(position)
        {
            let merged = sealed.merged(self.at(other));
            let group = Arc::make_mut(&mut self.groups[position.group]);
            if !is_sparse(&merged) {
                group.sparse -= 1;
            }
            group.id_range = union(group.id_range, merged.id_range);
            group.blocks[position.block] = merged;
            self.take(other);
        }
    }

    /// A sparse block other than the one at `position`.
    fn other_sparse(&self, position: BlockPosition) -> Option<BlockPosition> {
        for (group, content) in self.groups.iter().enumerate() {
            let own = usize::from(group == position.group);
            if content.sparse <= own {
                // No other block of this group is sparse; there is no need to look at them.
                continue;
            }
            for (block, sealed) in content.blocks.iter().enumerate() {
                let candidate = BlockPosition { group, block };
                if candidate != position && is_sparse(sealed) {
                    return Some(candidate);
                }
            }
        }
        None
    }

    /// Takes a sparse block out of the list, and merges its group with another one if both are
    /// small.
    fn take(&mut self, position: BlockPosition) {
        let number = position.group;
        let group = Arc::make_mut(&mut self.groups[number]);
        group.blocks.swap_remove(position.block);
        group.sparse -= 1;
        if group.blocks.is_empty() {
            self.groups.swap_remove(number);
            return;
        }
        if !group.is_small() {
            return;
        }
        let mut others = (0..self.groups.len()).filter(|&other| other != number);
        if let Some(other) = others.find(|&other| self.groups[other].is_small()) {
            let mut blocks = self.groups[number].blocks.clone();
            blocks.extend_from_slice(&self.groups[other].blocks);
            self.groups[number] = Arc::new(Group::new(blocks));
            self.groups.swap_remove(other);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::entry::IndexEntry;
    use placeformer_core::types::GLOBAL_DIM;

    fn id(number: usize) -> ReferenceId {
        ReferenceId::from_bytes((number as u128).to_be_bytes())
    }

    fn sealed(numbers: std::ops::Range<usize>) -> SealedBlock {
        let entry = |number| IndexEntry {
            id: id(number),
            global: vec![number as f32; GLOBAL_DIM],
            location: None,
            alt: None,
            heading: None,
            captured_at: None,
        };
        SealedBlock::new(Block::of(numbers.map(entry)))
    }

    /// Blocks of consecutive ids.
    fn list(blocks: usize) -> BlockList {
        let blocks = (0..blocks).map(|block| sealed(block * CAPACITY..(block + 1) * CAPACITY));
        BlockList::new(blocks.collect())
    }

    fn check(list: &BlockList, there: impl Fn(usize) -> bool, end: usize) {
        for number in 0..end {
            let found = list
                .row(id(number))
                .map(|(block, row)| block.vector(row)[0]);
            assert_eq!(found, there(number).then_some(number as f32), "{number}");
        }
        let blocks: Vec<&SealedBlock> = (0..list.end())
            .filter_map(|number| list.get(number))
            .collect();
        let live: usize = blocks.iter().map(|block| block.live).sum();
        assert_eq!(live, (0..end).filter(|&number| there(number)).count());
        let sparse = blocks.iter().filter(|block| is_sparse(block)).count();
        assert!(sparse <= 1);
        let counted: usize = list.groups.iter().map(|group| group.sparse).sum();
        assert_eq!(counted, sparse);
        let small = list.groups.iter().filter(|group| group.is_small()).count();
        assert!(small <= 1 + usize::from(end > 0));
    }

    #[test]
    fn blocks_and_groups_merge_as_they_empty_until_nothing_is_left() {
        let end = 3 * GROUP * CAPACITY;
        let mut list = list(3 * GROUP);
        check(&list, |_| true, end);
        let mut removed = Vec::new();
        for step in [3, 2, 5, 1] {
            for number in (0..end).step_by(step) {
                let there = list.row(id(number)).is_some();
                assert_eq!(list.remove(id(number)), there);
                assert!(!list.remove(id(number)));
            }
            removed.push(step);
            check(
                &list,
                |n| !removed.iter().any(|&step| n.is_multiple_of(step)),
                end,
            );
        }
        assert!(list.groups.is_empty());
    }

    #[test]
    fn a_list_taken_before_a_change_keeps_what_it_had() {
        let mut list = list(2 * GROUP);
        let before = list.clone();
        assert!(list.remove(id(5)));
        list.push(sealed(9_000..9_001));
        assert!(before.row(id(5)).is_some() && before.row(id(9_000)).is_none());
        assert!(list.row(id(5)).is_none() && list.row(id(9_000)).is_some());
        // The group that did not change is still shared.
        assert!(Arc::ptr_eq(&before.groups[1], &list.groups[1]));
        assert!(!Arc::ptr_eq(&before.groups[0], &list.groups[0]));
    }
}

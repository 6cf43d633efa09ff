//! The sealed blocks of a map: shared with searches, found by id, merged when they empty.
//!
//! A search holds on to what it scans, so whoever changes a block meanwhile must copy the list that
//! names it. The list is therefore kept in groups, each behind its own pointer: taking a list
//! copies one pointer for 64 blocks (a quarter of a million references), and a change copies one
//! group at most. Groups and blocks know the range of their ids, so that looking one up reads
//! hardly any block but its own; the store's ids ascend, which makes ranges mostly disjoint, but
//! nothing relies on it.

use super::block::{Block, CAPACITY, Sealed};
use placeformer_core::types::ReferenceId;
use std::sync::Arc;

/// Blocks in a full group.
#[cfg(not(test))]
const GROUP: usize = 64;
/// Small, so that unit tests pass many borders between groups.
#[cfg(test)]
const GROUP: usize = 4;

/// Sealed blocks; cheap to clone.
#[derive(Debug, Clone, Default)]
pub(super) struct BlockList {
    groups: Vec<Arc<Group>>,
}

#[derive(Debug, Clone)]
struct Group {
    blocks: Vec<Sealed>,
    /// Holds every id; may be larger than needed after removals.
    range: (ReferenceId, ReferenceId),
    /// Blocks that are at most half alive.
    sparse: usize,
}

/// Where a block is: its group and its place there.
type Place = (usize, usize);

impl Group {
    fn new(blocks: Vec<Sealed>) -> Self {
        let first = blocks
            .iter()
            .map(|block| block.range.0)
            .min()
            .unwrap_or(ReferenceId::from_bytes([0; 16]));
        let last = blocks
            .iter()
            .map(|block| block.range.1)
            .max()
            .unwrap_or(first);
        let sparse = blocks.iter().filter(|block| is_sparse(block)).count();
        Self {
            blocks,
            range: (first, last),
            sparse,
        }
    }

    fn find(&self, id: ReferenceId) -> Option<(usize, usize)> {
        if id < self.range.0 || id > self.range.1 {
            return None;
        }
        self.blocks
            .iter()
            .enumerate()
            .find_map(|(block, sealed)| Some((block, sealed.find(id)?)))
    }
}

fn is_sparse(sealed: &Sealed) -> bool {
    sealed.live <= CAPACITY / 2
}

impl BlockList {
    /// A list of `blocks`, none of which is empty.
    pub(super) fn new(blocks: Vec<Sealed>) -> Self {
        let mut list = Self::default();
        let mut blocks = blocks.into_iter().peekable();
        while blocks.peek().is_some() {
            list.groups
                .push(Arc::new(Group::new(blocks.by_ref().take(GROUP).collect())));
        }
        list
    }

    /// Appends a block.
    pub(super) fn push(&mut self, sealed: Sealed) {
        match self.groups.last_mut() {
            Some(last) if last.blocks.len() < GROUP => {
                let group = Arc::make_mut(last);
                group.range = (
                    group.range.0.min(sealed.range.0),
                    group.range.1.max(sealed.range.1),
                );
                group.sparse += usize::from(is_sparse(&sealed));
                group.blocks.push(sealed);
            }
            _ => self.groups.push(Arc::new(Group::new(vec![sealed]))),
        }
    }

    /// Above the number of every block, and the least such.
    pub(super) fn end(&self) -> usize {
        self.groups.last().map_or(0, |last| {
            (self.groups.len() - 1) * GROUP + last.blocks.len()
        })
    }

    /// The block of that number, if there is one.
    pub(super) fn get(&self, number: usize) -> Option<&Sealed> {
        self.groups.get(number / GROUP)?.blocks.get(number % GROUP)
    }

    /// The block of that number.
    ///
    /// # Panics
    /// If there is none: the number must be one that [`get`](Self::get) found.
    pub(super) fn block(&self, number: usize) -> &Block {
        &self.groups[number / GROUP].blocks[number % GROUP].block
    }

    /// The full vector of a reference that counts.
    pub(super) fn vector(&self, id: ReferenceId) -> Option<&[f32]> {
        let (number, (block, row)) = self.find(id)?;
        Some(self.groups[number].blocks[block].block.vector(row))
    }

    /// Removes a reference; false if none of that id counts.
    pub(super) fn remove(&mut self, id: ReferenceId) -> bool {
        let Some((number, (block, row))) = self.find(id) else {
            return false;
        };
        let group = Arc::make_mut(&mut self.groups[number]);
        let was_sparse = is_sparse(&group.blocks[block]);
        group.blocks[block].remove(row);
        group.sparse += usize::from(!was_sparse && is_sparse(&group.blocks[block]));
        self.compact((number, block));
        true
    }

    /// Bytes on the heap.
    pub(super) fn memory_bytes(&self) -> usize {
        let of_group = |group: &Arc<Group>| {
            let blocks: usize = group.blocks.iter().map(Sealed::memory_bytes).sum();
            blocks + group.blocks.capacity() * size_of::<Sealed>() + size_of::<Group>()
        };
        self.groups.capacity() * size_of::<Arc<Group>>()
            + self.groups.iter().map(of_group).sum::<usize>()
    }

    fn find(&self, id: ReferenceId) -> Option<(usize, (usize, usize))> {
        self.groups
            .iter()
            .enumerate()
            .find_map(|(number, group)| Some((number, group.find(id)?)))
    }

    /// Drops the block a row was removed from if it is empty, or merges it with another if both are
    /// at most half alive.
    fn compact(&mut self, place: Place) {
        let sealed = &self.groups[place.0].blocks[place.1];
        if sealed.live == 0 {
            self.take(place);
        } else if is_sparse(sealed)
            && let Some(other) = self.other_sparse(place)
        {
            let merged = sealed.merged(&self.groups[other.0].blocks[other.1]);
            let group = Arc::make_mut(&mut self.groups[place.0]);
            group.sparse -= usize::from(!is_sparse(&merged));
            group.range = (
                group.range.0.min(merged.range.0),
                group.range.1.max(merged.range.1),
            );
            group.blocks[place.1] = merged;
            self.take(other);
        }
    }

    /// A block at most half alive, other than the one at `place`.
    fn other_sparse(&self, place: Place) -> Option<Place> {
        let within = |(number, group): (usize, &Arc<Group>)| {
            let here = usize::from(number == place.0);
            // Of most groups the count says enough.
            if group.sparse <= here {
                return None;
            }
            let other =
                |&block: &usize| (number, block) != place && is_sparse(&group.blocks[block]);
            (0..group.blocks.len())
                .find(other)
                .map(|block| (number, block))
        };
        self.groups.iter().enumerate().find_map(within)
    }

    /// Takes a sparse block out of the list, and merges its group with another if both are at most
    /// half full.
    fn take(&mut self, (number, block): Place) {
        let group = Arc::make_mut(&mut self.groups[number]);
        group.blocks.swap_remove(block);
        group.sparse -= 1;
        let small = |group: &Group| group.blocks.len() <= GROUP / 2;
        if group.blocks.is_empty() {
            self.groups.swap_remove(number);
        } else if small(group)
            && let Some(other) =
                (0..self.groups.len()).find(|&other| other != number && small(&self.groups[other]))
        {
            let both = [number, other]
                .into_iter()
                .flat_map(|number| self.groups[number].blocks.iter().cloned());
            self.groups[number] = Arc::new(Group::new(both.collect()));
            self.groups.swap_remove(other);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::IndexEntry;
    use super::*;
    use placeformer_core::types::GLOBAL_DIM;

    fn id(number: usize) -> ReferenceId {
        ReferenceId::from_bytes((number as u128).to_be_bytes())
    }

    fn sealed(numbers: std::ops::Range<usize>) -> Sealed {
        let entry = |number| IndexEntry {
            id: id(number),
            global: vec![number as f32; GLOBAL_DIM],
            location: None,
            captured_at: None,
        };
        Sealed::new(Block::of(numbers.map(entry)))
    }

    /// Blocks of consecutive ids.
    fn list(blocks: usize) -> BlockList {
        BlockList::new(
            (0..blocks)
                .map(|block| sealed(block * CAPACITY..(block + 1) * CAPACITY))
                .collect(),
        )
    }

    fn check(list: &BlockList, there: impl Fn(usize) -> bool, end: usize) {
        for number in 0..end {
            let found = list.vector(id(number)).map(|vector| vector[0]);
            assert_eq!(found, there(number).then_some(number as f32), "{number}");
        }
        let blocks: Vec<&Sealed> = (0..list.end())
            .filter_map(|number| list.get(number))
            .collect();
        assert_eq!(
            blocks.iter().map(|block| block.live).sum::<usize>(),
            (0..end).filter(|&n| there(n)).count()
        );
        assert!(blocks.iter().filter(|block| is_sparse(block)).count() <= 1);
        let counted: usize = list.groups.iter().map(|group| group.sparse).sum();
        assert_eq!(
            counted,
            blocks.iter().filter(|block| is_sparse(block)).count()
        );
        assert!(
            list.groups
                .iter()
                .filter(|group| group.blocks.len() <= GROUP / 2)
                .count()
                <= 1 + usize::from(end > 0)
        );
    }

    #[test]
    fn blocks_and_groups_merge_as_they_empty_until_nothing_is_left() {
        let end = 3 * GROUP * CAPACITY;
        let mut list = list(3 * GROUP);
        check(&list, |_| true, end);
        let mut removed = Vec::new();
        for step in [3, 2, 5, 1] {
            for number in (0..end).step_by(step) {
                let there = list.vector(id(number)).is_some();
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
        assert!(before.vector(id(5)).is_some() && before.vector(id(9_000)).is_none());
        assert!(list.vector(id(5)).is_none() && list.vector(id(9_000)).is_some());
        // The group that did not change is still shared.
        assert!(
            Arc::ptr_eq(&before.groups[1], &list.groups[1])
                && !Arc::ptr_eq(&before.groups[0], &list.groups[0])
        );
    }
}

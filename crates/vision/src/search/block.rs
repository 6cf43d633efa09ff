//! A few thousand references, column by column: what one thread scans at a time.

use super::IndexEntry;
use super::filter::{Extent, PlaceAndTime};
use placeformer_core::types::{GLOBAL_DIM, ReferenceId};
use placeformer_kernels::scan::{Codes, LENGTH, ScanRows};
use placeformer_kernels::{quantise, simd};

const _: () = assert!(LENGTH == GLOBAL_DIM);

/// References in a full block: a megabyte of codes, some 40 microseconds of scanning.
#[cfg(not(test))]
pub(super) const CAPACITY: usize = 4096;
/// Small, so that unit tests pass many borders between blocks; tests of the public interface use
/// the real one.
#[cfg(test)]
pub(super) const CAPACITY: usize = 64;

/// A vector as int8 codes and what is lost thereby.
#[derive(Debug, Clone)]
pub(super) struct Quantised {
    pub codes: Codes,
    /// Factor of the codes.
    pub scale: f32,
    /// Length of what the codes miss, rounded up.
    pub error: f32,
    /// Squared length of the vector itself.
    pub square: f32,
}

impl Quantised {
    /// Quantises symmetrically, the largest magnitude becoming 127.
    pub(super) fn new(vector: &[f32]) -> Self {
        let simd = simd::selected();
        let scale = quantise::largest(simd, vector) / 127.0;
        // A factor that is zero, subnormal or not finite would make the codes meaningless: all is
        // error then.
        let scale = if scale.is_normal() { scale } else { 0.0 };
        let mut codes = [0; LENGTH];
        if scale != 0.0 {
            quantise::quantise(simd, vector, scale, 1.0, &mut codes);
        }
        let (missed, square) = quantise::squared_lengths(simd, vector, &codes, scale);
        let error = missed.sqrt();
        Self {
            codes: Codes::new(codes),
            scale,
            error: (error * (1.0 + 1e-6)) as f32,
            square: square as f32,
        }
    }
}

/// References as columns. Sorted by id once sealed.
#[derive(Debug, Clone, Default)]
pub(super) struct Block {
    pub ids: Vec<ReferenceId>,
    pub codes: Vec<Codes>,
    pub scales: Vec<f32>,
    pub errors: Vec<f32>,
    pub squares: Vec<f32>,
    /// Full vectors, `[len, 256]` row-major.
    pub vectors: Vec<f32>,
    pub places: Vec<PlaceAndTime>,
    /// Holds every place; may be larger than needed after removals.
    pub extent: Extent,
    /// At least the length of the longest quantised vector.
    pub longest: f32,
}

impl Block {
    /// Quantises `entries`, in their order.
    pub(super) fn of(entries: impl IntoIterator<Item = IndexEntry>) -> Self {
        let mut block = Self::default();
        block.reserve();
        entries
            .into_iter()
            .for_each(|entry| block.push(&entry, Quantised::new(&entry.global)));
        block.fit();
        block
    }

    pub(super) fn len(&self) -> usize {
        self.ids.len()
    }

    /// What a scan reads.
    pub(super) fn rows(&self) -> ScanRows<'_> {
        let Self {
            codes,
            scales,
            errors,
            squares,
            longest,
            ..
        } = self;
        ScanRows {
            codes,
            scales,
            errors,
            squares,
            longest: *longest,
        }
    }

    /// Appends one reference, of which `quantised` is the vector.
    pub(super) fn push(&mut self, entry: &IndexEntry, quantised: Quantised) {
        if self.ids.is_empty() {
            self.reserve();
        }
        self.ids.push(entry.id);
        self.codes.push(quantised.codes);
        self.scales.push(quantised.scale);
        self.errors.push(quantised.error);
        self.squares.push(quantised.square);
        self.vectors.extend_from_slice(&entry.global);
        let place = PlaceAndTime::new(entry.location, entry.captured_at);
        self.places.push(place);
        self.extent.add(&place);
        self.longest = self
            .longest
            .max(quantised.square.sqrt() * (1.0 + 1e-6) + quantised.error);
    }

    /// Appends a row of another block.
    pub(super) fn push_row(&mut self, other: &Self, row: usize) {
        self.ids.push(other.ids[row]);
        self.codes.push(other.codes[row]);
        self.scales.push(other.scales[row]);
        self.errors.push(other.errors[row]);
        self.squares.push(other.squares[row]);
        self.vectors.extend_from_slice(other.vector(row));
        self.places.push(other.places[row]);
        self.extent.add(&other.places[row]);
        self.longest = self.longest.max(other.longest);
    }

    /// Removes a row; the last takes its place.
    pub(super) fn swap_remove(&mut self, row: usize) {
        let last = self.len() - 1;
        self.vectors.copy_within(last * LENGTH.., row * LENGTH);
        self.vectors.truncate(last * LENGTH);
        self.ids.swap_remove(row);
        self.codes.swap_remove(row);
        self.scales.swap_remove(row);
        self.errors.swap_remove(row);
        self.squares.swap_remove(row);
        self.places.swap_remove(row);
    }

    /// The full vector of a row.
    pub(super) fn vector(&self, row: usize) -> &[f32] {
        &self.vectors[row * LENGTH..(row + 1) * LENGTH]
    }

    /// The same references sorted by id.
    pub(super) fn sorted(self) -> Self {
        if self.ids.is_sorted() {
            return self;
        }
        let mut order: Vec<usize> = (0..self.len()).collect();
        order.sort_unstable_by_key(|&row| self.ids[row]);
        let mut sorted = Self::default();
        sorted.reserve();
        order
            .into_iter()
            .for_each(|row| sorted.push_row(&self, row));
        sorted
    }

    /// Bytes on the heap.
    pub(super) fn memory_bytes(&self) -> usize {
        let numbers = self.scales.capacity()
            + self.errors.capacity()
            + self.squares.capacity()
            + self.vectors.capacity();
        self.ids.capacity() * size_of::<ReferenceId>()
            + self.codes.capacity() * size_of::<Codes>()
            + self.places.capacity() * size_of::<PlaceAndTime>()
            + numbers * size_of::<f32>()
    }

    /// Makes room for a full block at once, so that rows never move while it fills.
    fn reserve(&mut self) {
        self.ids.reserve_exact(CAPACITY);
        self.codes.reserve_exact(CAPACITY);
        self.scales.reserve_exact(CAPACITY);
        self.errors.reserve_exact(CAPACITY);
        self.squares.reserve_exact(CAPACITY);
        self.vectors.reserve_exact(CAPACITY * LENGTH);
        self.places.reserve_exact(CAPACITY);
    }

    /// Gives back what a block that is not full does not need.
    pub(super) fn fit(&mut self) {
        self.ids.shrink_to_fit();
        self.codes.shrink_to_fit();
        self.scales.shrink_to_fit();
        self.errors.shrink_to_fit();
        self.squares.shrink_to_fit();
        self.vectors.shrink_to_fit();
        self.places.shrink_to_fit();
    }
}

/// A full block that changes no more, and which of its rows still count. Cheap to clone.
#[derive(Debug, Clone)]
pub(super) struct Sealed {
    pub block: std::sync::Arc<Block>,
    /// One bit per row, set where the row is removed; absent while none is.
    removed: Option<std::sync::Arc<[u64]>>,
    /// Rows that still count.
    pub live: usize,
    /// The lowest and the highest id. Here rather than read from the block, which would have to be
    /// fetched for it.
    pub range: (ReferenceId, ReferenceId),
}

impl Sealed {
    /// Seals a block whose rows all count.
    ///
    /// # Panics
    /// If there is no row.
    pub(super) fn new(block: Block) -> Self {
        let block = block.sorted();
        let (live, range) = (block.len(), (block.ids[0], block.ids[block.len() - 1]));
        Self {
            block: std::sync::Arc::new(block),
            removed: None,
            live,
            range,
        }
    }

    /// Whether a row still counts.
    pub(super) fn is_live(&self, row: usize) -> bool {
        self.removed
            .as_ref()
            .is_none_or(|bits| bits[row / 64] >> (row % 64) & 1 == 0)
    }

    /// The row of a reference that still counts.
    pub(super) fn find(&self, id: ReferenceId) -> Option<usize> {
        if id < self.range.0 || id > self.range.1 {
            return None;
        }
        self.block
            .ids
            .binary_search(&id)
            .ok()
            .filter(|&row| self.is_live(row))
    }

    /// Removes a row that counts. Searches that hold a clone of the block still see it.
    pub(super) fn remove(&mut self, row: usize) {
        let mut bits: Vec<u64> = match &self.removed {
            Some(bits) => bits.to_vec(),
            None => vec![0; self.block.len().div_ceil(64)],
        };
        bits[row / 64] |= 1 << (row % 64);
        self.removed = Some(bits.into());
        self.live -= 1;
    }

    /// One block with the rows of both that still count.
    pub(super) fn merged(&self, other: &Self) -> Self {
        let mut merged = Block::default();
        merged.reserve();
        for sealed in [self, other] {
            (0..sealed.block.len())
                .filter(|&row| sealed.is_live(row))
                .for_each(|row| merged.push_row(&sealed.block, row));
        }
        let mut sealed = merged.sorted();
        sealed.fit();
        Self::new(sealed)
    }

    /// Bytes on the heap.
    pub(super) fn memory_bytes(&self) -> usize {
        self.block.memory_bytes() + self.removed.as_ref().map_or(0, |bits| bits.len() * 8)
    }
}

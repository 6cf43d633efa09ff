//! A few thousand references, stored column by column: what one thread scans at a time.

use super::entry::IndexEntry;
use super::filter::{Extent, PlaceAndTime};
use super::quantised::QuantisedVector;
use placeformer_core::types::{GLOBAL_DIM, ReferenceId};
use placeformer_kernels::scan::{Codes, LENGTH, ScanRows};

const _: () = assert!(LENGTH == GLOBAL_DIM);

/// Number of references in a full block: a megabyte of codes, which takes some 40 microseconds to
/// scan.
#[cfg(not(test))]
pub(super) const CAPACITY: usize = 4096;
/// Small in unit tests, so that they have many borders between blocks. Tests of the public
/// interface use the real capacity.
#[cfg(test)]
pub(super) const CAPACITY: usize = 64;

/// References as columns of equal length. Sorted by id once the block is sealed.
#[derive(Debug, Clone, Default)]
pub(super) struct Block {
    pub ids: Vec<ReferenceId>,
    pub codes: Vec<Codes>,
    pub scales: Vec<f32>,
    pub errors: Vec<f32>,
    pub squares: Vec<f32>,
    /// Global descriptors in full precision, `[len, 256]` row-major.
    pub vectors: Vec<f32>,
    pub places: Vec<PlaceAndTime>,
    /// Contains every place and time. Removals do not shrink it.
    pub extent: Extent,
    /// Upper bound of the lengths of all quantised vectors.
    pub longest: f32,
}

impl Block {
    /// A block of `entries`, in their order.
    pub(super) fn of(entries: impl IntoIterator<Item = IndexEntry>) -> Self {
        let mut block = Self::with_full_capacity();
        for entry in entries {
            block.push(&entry, QuantisedVector::new(&entry.global));
        }
        block.shrink_to_fit();
        block
    }

    /// An empty block with memory for [`CAPACITY`] references, so that rows never move while it
    /// fills.
    pub(super) fn with_full_capacity() -> Self {
        let mut block = Self::default();
        block.reserve();
        block
    }

    pub(super) fn len(&self) -> usize {
        self.ids.len()
    }

    /// The columns that the scan kernels read.
    pub(super) fn rows(&self) -> ScanRows<'_> {
        ScanRows {
            codes: &self.codes,
            scales: &self.scales,
            errors: &self.errors,
            squares: &self.squares,
            longest: self.longest,
        }
    }

    /// Appends one reference; `quantised` is its descriptor.
    pub(super) fn push(&mut self, entry: &IndexEntry, quantised: QuantisedVector) {
        if self.ids.is_empty() {
            self.reserve();
        }
        self.ids.push(entry.id);
        self.codes.push(quantised.codes);
        self.scales.push(quantised.scale);
        self.errors.push(quantised.error);
        self.squares.push(quantised.square);
        self.vectors.extend_from_slice(&entry.global);
        let place = PlaceAndTime::of(entry);
        self.places.push(place);
        self.extent.add(&place);
        self.longest = self.longest.max(quantised.length_bound());
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

    /// The descriptor of a row in full precision, `[256]`.
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
        let mut sorted = Self::with_full_capacity();
        for row in order {
            sorted.push_row(&self, row);
        }
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

    fn reserve(&mut self) {
        self.ids.reserve_exact(CAPACITY);
        self.codes.reserve_exact(CAPACITY);
        self.scales.reserve_exact(CAPACITY);
        self.errors.reserve_exact(CAPACITY);
        self.squares.reserve_exact(CAPACITY);
        self.vectors.reserve_exact(CAPACITY * LENGTH);
        self.places.reserve_exact(CAPACITY);
    }

    /// Gives back the memory that a block with fewer rows does not need.
    pub(super) fn shrink_to_fit(&mut self) {
        self.ids.shrink_to_fit();
        self.codes.shrink_to_fit();
        self.scales.shrink_to_fit();
        self.errors.shrink_to_fit();
        self.squares.shrink_to_fit();
        self.vectors.shrink_to_fit();
        self.places.shrink_to_fit();
    }
}

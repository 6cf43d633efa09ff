//! The columns of the matrix, packed as the instructions of a level read them.

use super::scalar;
use super::{Int8Descriptors, SECTIONS};
#[cfg(target_arch = "x86_64")]
use super::{avx2, avx512};
use crate::Simd;
use crate::dispatch::dispatch;

/// 64 bytes on a cache line of their own.
#[cfg(target_arch = "x86_64")]
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct CacheLine<T: Copy, const N: usize>(pub(super) [T; N]);

/// The descriptors of the query, packed for one level. The memory is kept when they are replaced.
#[derive(Debug, Clone)]
pub struct PackedColumns {
    simd: Simd,
    dim: usize,
    pub(super) counts: [usize; SECTIONS],
    /// Scalar: `[n, dim]`, the codes as given.
    pub(super) codes: Vec<i8>,
    /// AVX2: `[panels][dim / 2]`; a panel is 16 columns wide, and a line holds two successive
    /// values of each column.
    #[cfg(target_arch = "x86_64")]
    pub(super) pairs: Vec<CacheLine<i16, 32>>,
    /// AVX-512: `[panels][dim / 4]`; a panel is 32 columns wide, and two lines hold four successive
    /// values of each column, increased by 128.
    #[cfg(target_arch = "x86_64")]
    pub(super) quads: Vec<[CacheLine<u8, 64>; 2]>,
    /// One for each column; sections are filled up to whole panels with NaN, which never wins a
    /// comparison.
    pub(super) factors: Vec<f32>,
}

impl PackedColumns {
    /// No columns, to be packed for `simd`.
    pub fn new(simd: Simd) -> Self {
        Self {
            simd,
            dim: 1,
            counts: [0; SECTIONS],
            codes: Vec::new(),
            #[cfg(target_arch = "x86_64")]
            pairs: Vec::new(),
            #[cfg(target_arch = "x86_64")]
            quads: Vec::new(),
            factors: Vec::new(),
        }
    }

    /// The level they are packed for.
    pub fn simd(&self) -> Simd {
        self.simd
    }

    /// Replaces the columns.
    ///
    /// # Panics
    /// If the lengths in `columns` contradict each other.
    pub fn pack(&mut self, columns: Int8Descriptors<'_>) {
        columns.validate();
        self.dim = columns.dim;
        self.counts = columns.counts;
        let simd = self.simd;
        let packed = self;
        dispatch!(simd, pack(packed, columns));
    }

    /// Length of a descriptor.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Number of columns.
    pub fn len(&self) -> usize {
        self.counts.iter().sum()
    }

    /// Whether there is no column.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Replaces the factors, every section filled up to a multiple of `panel` columns.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn pack_factors(&mut self, columns: Int8Descriptors<'_>, panel: usize) {
        self.factors.clear();
        for section in 0..SECTIONS {
            let start = columns.start(section);
            let factors = &columns.factors[start..start + columns.counts[section]];
            self.factors.extend_from_slice(factors);
            let padded = self.factors.len().next_multiple_of(panel);
            self.factors.resize(padded, f32::NAN);
        }
    }
}

/// The codes of every column, with the number of its panel and its place in it, when panels are
/// `width` columns wide and every section starts a new one.
#[cfg(target_arch = "x86_64")]
pub(super) fn for_each_column(
    columns: Int8Descriptors<'_>,
    width: usize,
    mut pack: impl FnMut(usize, usize, &[i8]),
) {
    let mut first_panel = 0;
    let mut all_codes = columns.codes.chunks_exact(columns.dim);
    for count in columns.counts {
        for (column, codes) in all_codes.by_ref().take(count).enumerate() {
            pack(first_panel + column / width, column % width, codes);
        }
        first_panel += count.div_ceil(width);
    }
}

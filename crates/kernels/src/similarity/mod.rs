//! The best partners among the int8 descriptors of two images: for every row the most similar
//! column, for every column the most similar row.
//!
//! Key patches are matched by mutual nearest neighbours (paper III-D), which needs the maxima of
//! all rows and columns of the matrix of similarities, and the sum s11 + s12 + s23 needs them for
//! several pairs of patch scales. The matrix is cut into blocks, one for each pair (scale of the
//! rows, scale of the columns). Each block is computed once, tile by tile in registers, and only
//! the running maxima of its rows and columns are kept. The caller combines the maxima of blocks.
//!
//! A descriptor is `codes * factor`. A row's best column is the one with the largest
//! `dot(codes) as f32 * factor of the column`, and a column's best row the one with the largest
//! `dot(codes) as f32 * factor of the row`: the descriptor's own factor is the same for all it is
//! compared with. Dot products of integers are exact, so every level gives the same bits. Of equal
//! partners the one with the lowest index wins. Columns are packed once for a query; rows are
//! those of one candidate after another.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod check;
mod packed;
#[cfg(target_arch = "x86_64")]
mod panels;
mod scalar;
mod scratch;
#[cfg(test)]
mod tests;

#[cfg(test)]
use crate::Simd;
use crate::dispatch::dispatch;
pub(crate) use check::check;
pub use packed::PackedColumns;
pub use scratch::Scratch;

/// Number of sections (patch scales) that rows and columns are divided into.
pub const SECTIONS: usize = 3;

/// The largest length of a descriptor: a sum of more products could overflow i32.
pub const MAX_DIM: usize = 1 << 16;

/// Which blocks are wanted: `[section of the rows][section of the columns]`.
pub type Blocks = [[bool; SECTIONS]; SECTIONS];

/// The quantised descriptors of one image, section after section.
#[derive(Debug, Clone, Copy)]
pub struct Int8Descriptors<'a> {
    /// Length of a descriptor.
    pub dim: usize,
    /// Number of descriptors in each section; n is their sum.
    pub counts: [usize; SECTIONS],
    /// `[n, dim]` row-major, each in -127..=127.
    pub codes: &'a [i8],
    /// `[n]`: value of one code unit of each descriptor.
    pub factors: &'a [f32],
}

impl Int8Descriptors<'_> {
    /// Number of descriptors.
    pub fn len(&self) -> usize {
        self.counts.iter().sum()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// # Panics
    /// If the lengths contradict each other.
    fn validate(&self) {
        assert!(
            (1..=MAX_DIM).contains(&self.dim),
            "descriptors of {} values cannot be compared",
            self.dim
        );
        // The sum must not wrap around, since the counts decide what is read.
        let mut counts = self.counts.iter();
        let total = counts.try_fold(0usize, |total, &count| total.checked_add(count));
        let values = total.and_then(|total| total.checked_mul(self.dim));
        assert_eq!(
            values,
            Some(self.codes.len()),
            "codes do not fill the descriptors announced"
        );
        assert_eq!(
            self.factors.len(),
            self.len(),
            "every descriptor needs one factor"
        );
    }

    /// Index of the first descriptor of a section.
    fn start(&self, section: usize) -> usize {
        self.counts[..section].iter().sum()
    }
}

/// The best partner of a descriptor within one block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Best {
    /// Similarity; it can be compared only with other partners of the same descriptor.
    pub value: f32,
    /// Index of the partner over all sections of its image.
    pub index: u32,
}

impl Best {
    /// No partner: every partner is better.
    pub const NONE: Self = Self {
        value: f32::NEG_INFINITY,
        index: u32::MAX,
    };

    /// Replaces the partner by another one that is strictly better, so that of equal partners the
    /// earlier one stays.
    #[inline(always)]
    pub fn challenge(&mut self, value: f32, index: u32) {
        if value > self.value {
            *self = Self { value, index };
        }
    }
}

/// The maxima of every wanted block; [`Best::NONE`] for blocks that are not wanted or empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BlockMaxima {
    /// `[section of the columns][row]`: the best column of each row.
    pub rows: [Vec<Best>; SECTIONS],
    /// `[section of the rows][column]`: the best row of each column.
    pub columns: [Vec<Best>; SECTIONS],
}

impl BlockMaxima {
    fn reset(&mut self, rows: usize, columns: usize) {
        for bests in &mut self.rows {
            bests.clear();
            bests.resize(rows, Best::NONE);
        }
        for bests in &mut self.columns {
            bests.clear();
            bests.resize(columns, Best::NONE);
        }
    }
}

/// Computes the maxima of the wanted blocks at the level that `columns` were packed for.
///
/// # Panics
/// If the lengths in `rows` contradict each other, or rows and columns differ in length.
pub fn block_maxima(
    columns: &PackedColumns,
    rows: Int8Descriptors<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    rows.validate();
    assert_eq!(
        rows.dim,
        columns.dim(),
        "descriptors of different lengths cannot be compared"
    );
    out.reset(rows.len(), columns.len());
    dispatch!(
        columns.simd(),
        block_maxima(columns, rows, wanted, scratch, out)
    );
}

//! Word by word, as the definition says.

use super::SourceBlock;
use std::ops::Range;

/// See [`super::transpose`].
pub(super) fn transpose(source: SourceBlock<'_>, out: &mut [u32], out_stride: usize) {
    for row in 0..source.rows {
        transpose_row(&source, row, 0..source.columns, out, out_stride);
    }
}

/// Some columns of one row.
#[inline(always)]
pub(super) fn transpose_row(
    source: &SourceBlock<'_>,
    row: usize,
    columns: Range<usize>,
    out: &mut [u32],
    out_stride: usize,
) {
    for column in columns {
        out[column * out_stride + row] = source.words[row * source.stride + column];
    }
}

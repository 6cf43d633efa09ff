//! Transposing blocks of 32-bit words.
//!
//! What one matrix product writes as a row, the next one may have to read as a column of a packed
//! panel: the keys of attention are projected token by token and then multiplied dimension by
//! dimension.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod scalar;
#[cfg(test)]
mod tests;

use crate::Simd;
use crate::dispatch::dispatch;
use crate::gemm::covers;

/// A block of words, `[rows, columns]`, inside a larger row-major matrix.
#[derive(Clone, Copy)]
pub(crate) struct SourceBlock<'a> {
    /// From the block's first word on.
    pub words: &'a [u32],
    /// Words from one row to the next.
    pub stride: usize,
    pub rows: usize,
    pub columns: usize,
}

/// Writes `source` transposed: the word in row `i` and column `j` goes to
/// `out[j * out_stride + i]`.
///
/// # Panics
/// If a slice is too short.
pub(crate) fn transpose(simd: Simd, source: SourceBlock<'_>, out: &mut [u32], out_stride: usize) {
    let SourceBlock {
        words,
        stride,
        rows,
        columns,
    } = source;
    if rows == 0 || columns == 0 {
        return;
    }
    assert!(
        covers(words.len(), rows, stride, columns),
        "source too short"
    );
    assert!(
        covers(out.len(), columns, out_stride, rows),
        "result too short"
    );
    dispatch!(simd, transpose(source, out, out_stride));
}

//! What a transformer computes between its matrix products: LayerNorm, softmax, and the epilogues.
//!
//! An epilogue adds bias, GELU or residual to a block of a product directly after the block was
//! computed, while it is still in the first-level cache: a pass over the whole product would have
//! to fetch it from memory again.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod check;
mod epilogue;
mod polynomials;
mod rows;
mod scalar;
#[cfg(test)]
mod tests;

use crate::Simd;
use crate::dispatch::dispatch;
use crate::operand::Format;
pub(crate) use check::check;
pub use epilogue::{Epilogue, Product, finish_block, finish_words};

/// LayerNorm without its scale and shift, which belong into the linear layer that follows: shifts
/// and scales every row to zero mean and unit variance. `epsilon` is added to the variance.
/// `input` and `out` are `[rows, dim]`.
///
/// # Panics
/// If `out` is not as long as `input`.
pub fn normalize_rows(simd: Simd, dim: usize, epsilon: f32, input: &[f32], out: &mut [f32]) {
    assert_eq!(input.len(), out.len(), "rows must have a place each");
    for (row, out) in input.chunks_exact(dim).zip(out.chunks_exact_mut(dim)) {
        dispatch!(simd, normalize(row, epsilon, out));
    }
}

/// Softmax of one row of scores up to a factor: replaces the scores, which are already multiplied
/// by log2(e), by `2^(score - maximum)` and returns the reciprocal of their sum. The caller applies
/// it after the next product, where fewer numbers have to be multiplied.
///
/// In bf16 the results take the first half of the row, two to a word; an odd last one is followed
/// by zero.
///
/// # Panics
/// If the format is int8, or bf16 at [`SimdLevel::Avx512`](crate::SimdLevel) on a CPU without
/// AVX-512 BF16.
pub fn exponentiate_row(simd: Simd, format: Format, scores: &mut [f32]) -> f32 {
    match format {
        Format::F32 => dispatch!(simd, exponentiate_f32(scores)),
        Format::Bf16 => dispatch!(simd, exponentiate_bf16(scores)),
        Format::Int8 => panic!("weights of attention are f32 or bf16"),
    }
}

/// Multiplies `columns` elements of row `i` by `factors[i]`, for every factor; row `i` of `out`
/// starts at `i * stride`.
///
/// # Panics
/// If `out` is too short.
pub fn scale_rows(factors: &[f32], columns: usize, out: &mut [f32], stride: usize) {
    for (row, &factor) in factors.iter().enumerate() {
        let row = &mut out[row * stride..row * stride + columns];
        for value in row {
            *value *= factor;
        }
    }
}

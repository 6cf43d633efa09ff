//! The generic kernels instantiated in portable code: the reference for the other instruction sets.

use super::epilogue::{self, Epilogue, Product};
use super::rows;
use crate::registers::scalar::ScalarIsa;

/// See [`rows::normalize`].
pub(super) fn normalize(row: &[f32], epsilon: f32, out: &mut [f32]) {
    rows::normalize(ScalarIsa, row, epsilon, out);
}

/// See [`rows::exponentiate_f32`].
pub(super) fn exponentiate_f32(scores: &mut [f32]) -> f32 {
    rows::exponentiate_f32(ScalarIsa, scores)
}

/// See [`rows::exponentiate_bf16`].
pub(super) fn exponentiate_bf16(scores: &mut [f32]) -> f32 {
    rows::exponentiate_bf16(ScalarIsa, scores)
}

/// See [`epilogue::finish_f32`].
pub(super) fn finish_f32(
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [f32],
    out_stride: usize,
) {
    epilogue::finish_f32(ScalarIsa, epilogue, product, columns, out, out_stride);
}

/// See [`epilogue::finish_bf16`].
pub(super) fn finish_bf16(
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [u32],
    out_stride: usize,
) {
    epilogue::finish_bf16(ScalarIsa, epilogue, product, columns, out, out_stride);
}

//! The generic kernels instantiated for AVX2.

use super::epilogue::{self, Epilogue, Product};
use super::rows;
use crate::registers::avx2::Avx2Isa;

/// See [`rows::normalize`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn normalize(row: &[f32], epsilon: f32, out: &mut [f32]) {
    rows::normalize(Avx2Isa::new(), row, epsilon, out);
}

/// See [`rows::exponentiate_f32`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn exponentiate_f32(scores: &mut [f32]) -> f32 {
    rows::exponentiate_f32(Avx2Isa::new(), scores)
}

/// See [`rows::exponentiate_bf16`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn exponentiate_bf16(scores: &mut [f32]) -> f32 {
    rows::exponentiate_bf16(Avx2Isa::new(), scores)
}

/// See [`epilogue::finish_f32`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn finish_f32(
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [f32],
    out_stride: usize,
) {
    epilogue::finish_f32(Avx2Isa::new(), epilogue, product, columns, out, out_stride);
}

/// See [`epilogue::finish_bf16`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn finish_bf16(
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [u32],
    out_stride: usize,
) {
    epilogue::finish_bf16(Avx2Isa::new(), epilogue, product, columns, out, out_stride);
}

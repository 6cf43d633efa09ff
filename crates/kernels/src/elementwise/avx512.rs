//! The generic kernels instantiated for AVX-512.

use super::epilogue::{self, Epilogue, Product};
use super::rows;
use crate::registers::avx512::{Avx512Bf16Isa, Avx512Isa, require_bf16};

/// See [`rows::normalize`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn normalize(row: &[f32], epsilon: f32, out: &mut [f32]) {
    rows::normalize(Avx512Isa::new(), row, epsilon, out);
}

/// See [`rows::exponentiate_f32`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn exponentiate_f32(scores: &mut [f32]) -> f32 {
    rows::exponentiate_f32(Avx512Isa::new(), scores)
}

/// See [`rows::exponentiate_bf16`].
///
/// # Panics
/// If the CPU lacks AVX-512 BF16.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn exponentiate_bf16(scores: &mut [f32]) -> f32 {
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx512bf16,popcnt")]
    fn with_bf16(scores: &mut [f32]) -> f32 {
        rows::exponentiate_bf16(Avx512Bf16Isa::new(), scores)
    }

    require_bf16();
    // SAFETY: the line above has found AVX-512 BF16; this function has the other instructions.
    unsafe { with_bf16(scores) }
}

/// See [`epilogue::finish_f32`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn finish_f32(
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [f32],
    out_stride: usize,
) {
    epilogue::finish_f32(
        Avx512Isa::new(),
        epilogue,
        product,
        columns,
        out,
        out_stride,
    );
}

/// See [`epilogue::finish_bf16`].
///
/// # Panics
/// If the CPU lacks AVX-512 BF16.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn finish_bf16(
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [u32],
    out_stride: usize,
) {
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx512bf16,popcnt")]
    fn with_bf16(
        epilogue: Epilogue,
        product: &Product<'_>,
        columns: usize,
        out: &mut [u32],
        out_stride: usize,
    ) {
        epilogue::finish_bf16(
            Avx512Bf16Isa::new(),
            epilogue,
            product,
            columns,
            out,
            out_stride,
        );
    }

    require_bf16();
    // SAFETY: the line above has found AVX-512 BF16; this function has the other instructions.
    unsafe { with_bf16(epilogue, product, columns, out, out_stride) }
}

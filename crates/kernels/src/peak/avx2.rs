//! AVX2 with FMA.

use crate::registers::avx2::Avx2Isa;

/// See [`super::f32_operations`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn f32_loop(seed: f32) -> f32 {
    super::f32_loop::f32_loop(Avx2Isa::new(), seed)
}

/// There is no instruction to measure.
#[target_feature(enable = "avx2")]
pub(super) fn bf16_loop(_: i16) -> f32 {
    unreachable!("not asked for at this level")
}

/// There is no instruction to measure.
#[target_feature(enable = "avx2")]
pub(super) fn int8_loop(_: i8) -> f32 {
    unreachable!("not asked for at this level")
}

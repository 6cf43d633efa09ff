//! AVX2: tiles of 6 rows by 16 columns; twelve registers of sums, two of columns and one of a row's
//! word are fifteen of sixteen.
//!
//! There are no instructions for bf16 and int8: portable code is compiled for AVX2.

use super::dot::F32Dot;
use super::dot::scalar::{ScalarBf16Dot, ScalarInt8Dot};
use super::job::PanelJob;
use super::tile;
use crate::registers::avx2::Avx2Isa;

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn multiply_f32(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 6, 2, 2>(F32Dot(Avx2Isa::new()), job);
}

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn multiply_bf16(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 6, 2, 2>(ScalarBf16Dot, job);
}

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn multiply_int8(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 6, 2, 2>(ScalarInt8Dot, job);
}

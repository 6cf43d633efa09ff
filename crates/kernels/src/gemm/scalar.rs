//! In portable code: the reference for the other instruction sets. Tiles of 4 rows by 8 columns.

use super::dot::F32Dot;
use super::dot::scalar::{ScalarBf16Dot, ScalarInt8Dot};
use super::job::PanelJob;
use super::tile;
use crate::registers::scalar::ScalarIsa;

/// See [`super::multiply_panel`].
pub(super) fn multiply_f32(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 4, 4, 1>(F32Dot(ScalarIsa), job);
}

/// See [`super::multiply_panel`].
pub(super) fn multiply_bf16(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 4, 4, 1>(ScalarBf16Dot, job);
}

/// See [`super::multiply_panel`].
pub(super) fn multiply_int8(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 4, 4, 1>(ScalarInt8Dot, job);
}

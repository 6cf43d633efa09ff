//! The generic kernels instantiated in portable code: the reference for the other instruction sets.

use super::ChannelScaling;
use super::packing::{self, SourceRows};
use crate::registers::scalar::ScalarIsa;

/// See [`packing::round_rows`].
pub(super) fn round_rows(rows: SourceRows<'_>, packed: &mut [u32]) {
    packing::round_rows(ScalarIsa, rows, packed);
}

/// See [`packing::quantise_rows`].
pub(super) fn quantise_rows(
    rows: SourceRows<'_>,
    scaling: ChannelScaling<'_>,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    packing::quantise_rows(ScalarIsa, rows, scaling, packed, stride, factors);
}

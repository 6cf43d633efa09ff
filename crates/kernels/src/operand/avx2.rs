//! The generic kernels instantiated for AVX2.

use super::ChannelScaling;
use super::packing::{self, SourceRows};
use crate::registers::avx2::Avx2Isa;

/// See [`packing::round_rows`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn round_rows(rows: SourceRows<'_>, packed: &mut [u32]) {
    packing::round_rows(Avx2Isa::new(), rows, packed);
}

/// See [`packing::quantise_rows`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn quantise_rows(
    rows: SourceRows<'_>,
    scaling: ChannelScaling<'_>,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    packing::quantise_rows(Avx2Isa::new(), rows, scaling, packed, stride, factors);
}

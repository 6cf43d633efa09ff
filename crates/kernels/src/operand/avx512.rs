//! The generic kernels instantiated for AVX-512.

use super::ChannelScaling;
use super::packing::{self, SourceRows};
use crate::registers::avx512::{Avx512Bf16Isa, Avx512Isa, require_bf16};

/// See [`packing::round_rows`].
///
/// # Panics
/// If the CPU lacks AVX-512 BF16.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn round_rows(rows: SourceRows<'_>, packed: &mut [u32]) {
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx512bf16,popcnt")]
    fn with_bf16(rows: SourceRows<'_>, packed: &mut [u32]) {
        packing::round_rows(Avx512Bf16Isa::new(), rows, packed);
    }

    require_bf16();
    // SAFETY: the line above has found AVX-512 BF16; this function has the other instructions.
    unsafe { with_bf16(rows, packed) }
}

/// See [`packing::quantise_rows`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn quantise_rows(
    rows: SourceRows<'_>,
    scaling: ChannelScaling<'_>,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    packing::quantise_rows(Avx512Isa::new(), rows, scaling, packed, stride, factors);
}

//! AVX-512: tiles of 12 rows by 32 columns; 24 registers of sums, two of columns and one of a row's
//! word are 27 of 32.

use super::dot::F32Dot;
use super::dot::avx512::{Avx512Bf16Dot, Avx512Int8Dot};
use super::job::PanelJob;
use super::tile;
use crate::registers::avx512::{Avx512Bf16Isa, Avx512Isa, require_bf16};

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn multiply_f32(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 12, 4, 2>(F32Dot(Avx512Isa::new()), job);
}

/// See [`super::multiply_panel`].
///
/// # Panics
/// If the CPU lacks AVX-512 BF16.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn multiply_bf16(job: &mut PanelJob<'_>) {
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx512bf16,popcnt")]
    fn with_bf16(job: &mut PanelJob<'_>) {
        tile::multiply::<_, 12, 4, 2>(Avx512Bf16Dot(Avx512Bf16Isa::new()), job);
    }

    require_bf16();
    // SAFETY: the line above has found AVX-512 BF16; this function has the other instructions.
    unsafe { with_bf16(job) }
}

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn multiply_int8(job: &mut PanelJob<'_>) {
    tile::multiply::<_, 12, 4, 2>(Avx512Int8Dot(Avx512Isa::new()), job);
}

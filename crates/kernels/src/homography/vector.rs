//! What the kernels of homographies need of a vector of f32 beyond [`Lanes`], at each level beyond
//! the portable one.

use super::Sample;
use crate::lanes::{Avx2, Avx512, Lanes};
use std::arch::x86_64::*;

/// Division, bits, and masks of one bit per element.
///
/// # Safety
/// Every method may be called only where the level's instructions are available; pointers must be
/// valid for `COUNT` elements.
pub(super) trait Vector: Lanes {
    unsafe fn div(self, other: Self) -> Self;
    unsafe fn abs(self) -> Self;
    unsafe fn xor(self, other: Self) -> Self;
    unsafe fn or(self, other: Self) -> Self;
    /// Negated where `sign` has its sign bit set.
    unsafe fn flipped_by(self, sign: Self) -> Self;
    /// Where the sign bit is set.
    unsafe fn sign_bits(self) -> u32;
    /// Where `self > other`.
    unsafe fn greater(self, other: Self) -> u32;
    /// Where `self <= other` and `factor > 0`.
    unsafe fn within_and_positive(self, other: Self, factor: Self) -> u32;
    /// One corner of `COUNT` samples: x, y, u, v.
    ///
    /// # Safety
    /// Besides, the samples' positions must lie within what `pairs` points at.
    unsafe fn corners(pairs: *const [f32; 4], samples: *const Sample, corner: usize) -> [Self; 4];
}

/// The correspondence at one corner of a sample. A macro, since the compiler may leave a closure
/// out of line, where it lacks the level's instructions.
macro_rules! pair {
    ($pairs:ident, $samples:ident, $sample:expr, $corner:ident) => {
        _mm_loadu_ps(
            $pairs
                .add(usize::from((*$samples.add($sample))[$corner]))
                .cast(),
        )
    };
}

impl Vector for Avx2 {
    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        // SAFETY: AVX2 is available.
        Self(unsafe { _mm256_div_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn abs(self) -> Self {
        // SAFETY: AVX2 is available.
        Self(unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    unsafe fn xor(self, other: Self) -> Self {
        // SAFETY: AVX2 is available.
        Self(unsafe { _mm256_xor_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn or(self, other: Self) -> Self {
        // SAFETY: AVX2 is available.
        Self(unsafe { _mm256_or_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn flipped_by(self, sign: Self) -> Self {
        // SAFETY: AVX2 is available.
        Self(unsafe { _mm256_xor_ps(self.0, _mm256_and_ps(_mm256_set1_ps(-0.0), sign.0)) })
    }
    #[inline(always)]
    unsafe fn sign_bits(self) -> u32 {
        // SAFETY: AVX2 is available.
        unsafe { _mm256_movemask_ps(self.0) as u32 }
    }
    #[inline(always)]
    unsafe fn greater(self, other: Self) -> u32 {
        // SAFETY: AVX2 is available.
        unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(self.0, other.0)) as u32 }
    }
    #[inline(always)]
    unsafe fn within_and_positive(self, other: Self, factor: Self) -> u32 {
        // SAFETY: AVX2 is available.
        unsafe {
            let within = _mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0);
            let positive = _mm256_cmp_ps::<_CMP_GT_OQ>(factor.0, _mm256_setzero_ps());
            _mm256_movemask_ps(_mm256_and_ps(within, positive)) as u32
        }
    }
    #[inline(always)]
    unsafe fn corners(pairs: *const [f32; 4], samples: *const Sample, corner: usize) -> [Self; 4] {
        // SAFETY: AVX2 is available; the caller vouches for eight samples and for the positions in
        // them.
        unsafe {
            // Register `i` holds the pairs of samples i and i + 4, so that transposing within
            // halves is enough.
            macro_rules! two {
                ($i:literal) => {
                    _mm256_insertf128_ps::<1>(
                        _mm256_castps128_ps256(pair!(pairs, samples, $i, corner)),
                        pair!(pairs, samples, $i + 4, corner),
                    )
                };
            }
            let (a, b, c, d) = (two!(0), two!(1), two!(2), two!(3));
            let (ab_low, ab_high) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
            let (cd_low, cd_high) = (_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
            [
                Self(_mm256_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low)),
                Self(_mm256_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low)),
                Self(_mm256_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high)),
                Self(_mm256_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high)),
            ]
        }
    }
}

impl Vector for Avx512 {
    #[inline(always)]
    unsafe fn div(self, other: Self) -> Self {
        // SAFETY: AVX-512 is available.
        Self(unsafe { _mm512_div_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn abs(self) -> Self {
        // SAFETY: AVX-512 is available.
        Self(unsafe { _mm512_andnot_ps(_mm512_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    unsafe fn xor(self, other: Self) -> Self {
        // SAFETY: AVX-512 is available.
        Self(unsafe { _mm512_xor_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn or(self, other: Self) -> Self {
        // SAFETY: AVX-512 is available.
        Self(unsafe { _mm512_or_ps(self.0, other.0) })
    }
    #[inline(always)]
    unsafe fn flipped_by(self, sign: Self) -> Self {
        // SAFETY: AVX-512 is available.
        Self(unsafe { _mm512_xor_ps(self.0, _mm512_and_ps(_mm512_set1_ps(-0.0), sign.0)) })
    }
    #[inline(always)]
    unsafe fn sign_bits(self) -> u32 {
        // SAFETY: AVX-512 is available.
        unsafe { u32::from(_mm512_movepi32_mask(_mm512_castps_si512(self.0))) }
    }
    #[inline(always)]
    unsafe fn greater(self, other: Self) -> u32 {
        // SAFETY: AVX-512 is available.
        unsafe { u32::from(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(self.0, other.0)) }
    }
    #[inline(always)]
    unsafe fn within_and_positive(self, other: Self, factor: Self) -> u32 {
        // SAFETY: AVX-512 is available.
        unsafe {
            let positive = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(factor.0, _mm512_setzero_ps());
            u32::from(_mm512_mask_cmp_ps_mask::<_CMP_LE_OQ>(
                positive, self.0, other.0,
            ))
        }
    }
    #[inline(always)]
    unsafe fn corners(pairs: *const [f32; 4], samples: *const Sample, corner: usize) -> [Self; 4] {
        // SAFETY: AVX-512 is available; the caller vouches for sixteen samples and for the
        // positions in them.
        unsafe {
            // Register `i` holds the pairs of samples i, i + 4, i + 8 and i + 12, so that
            // transposing within quarters is enough.
            macro_rules! four {
                ($i:literal) => {{
                    let one = _mm512_castps128_ps512(pair!(pairs, samples, $i, corner));
                    let two = _mm512_insertf32x4::<1>(one, pair!(pairs, samples, $i + 4, corner));
                    let three = _mm512_insertf32x4::<2>(two, pair!(pairs, samples, $i + 8, corner));
                    _mm512_insertf32x4::<3>(three, pair!(pairs, samples, $i + 12, corner))
                }};
            }
            let (a, b, c, d) = (four!(0), four!(1), four!(2), four!(3));
            let (ab_low, ab_high) = (_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
            let (cd_low, cd_high) = (_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
            [
                Self(_mm512_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low)),
                Self(_mm512_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low)),
                Self(_mm512_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high)),
                Self(_mm512_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high)),
            ]
        }
    }
}

//! AVX-512: sixteen samples or points at a time.

use super::pairs::CheckedSamples;
use super::vectors::{self, HomographyIsa};
use super::{Hypotheses, LANES, PointPairs, Sample};
use crate::registers::avx512::{Avx512Floats, Avx512Isa};
use std::arch::x86_64::*;

/// See [`super::proper`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn proper(pairs: &PointPairs, samples: &[Sample; LANES], min_area: f32) -> u32 {
    vectors::proper(Avx512Isa::new(), pairs, samples, min_area)
}

/// See [`super::solve`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn solve(pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
    vectors::solve(Avx512Isa::new(), pairs, samples)
}

/// See [`super::count_inliers`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn count_inliers(pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    vectors::count_inliers(Avx512Isa::new(), pairs, homography, floor)
}

impl HomographyIsa for Avx512Isa {
    #[inline(always)]
    fn divide(self, dividend: Avx512Floats, divisor: Avx512Floats) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats::new(self, unsafe {
            _mm512_div_ps(dividend.register(), divisor.register())
        })
    }

    #[inline(always)]
    fn xor(self, a: Avx512Floats, b: Avx512Floats) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats::new(self, unsafe { _mm512_xor_ps(a.register(), b.register()) })
    }

    #[inline(always)]
    fn or(self, a: Avx512Floats, b: Avx512Floats) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats::new(self, unsafe { _mm512_or_ps(a.register(), b.register()) })
    }

    #[inline(always)]
    fn negate_by_sign(self, values: Avx512Floats, sign: Avx512Floats) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats::new(self, unsafe {
            negate_by_sign(values.register(), sign.register())
        })
    }

    #[inline(always)]
    fn abs(self, values: Avx512Floats) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats::new(self, unsafe { abs(values.register()) })
    }

    #[inline(always)]
    fn sign_bits(self, values: Avx512Floats) -> u32 {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { sign_bits(values.register()) }
    }

    #[inline(always)]
    fn greater(self, a: Avx512Floats, b: Avx512Floats) -> u32 {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { greater(a.register(), b.register()) }
    }

    #[inline(always)]
    fn at_most_and_positive(self, a: Avx512Floats, b: Avx512Floats, factor: Avx512Floats) -> u32 {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { at_most_and_positive(a.register(), b.register(), factor.register()) }
    }

    #[inline(always)]
    fn corner(self, samples: &CheckedSamples<'_>, from: usize, corner: usize) -> [Avx512Floats; 4] {
        // SAFETY: `self` proves that the CPU has AVX-512.
        let [x, y, u, v] = unsafe { load_corner(samples, from, corner) };
        [
            Avx512Floats::new(self, x),
            Avx512Floats::new(self, y),
            Avx512Floats::new(self, u),
            Avx512Floats::new(self, v),
        ]
    }
}

#[inline]
#[target_feature(enable = "avx512f,avx512dq")]
fn abs(values: __m512) -> __m512 {
    _mm512_andnot_ps(_mm512_set1_ps(-0.0), values)
}

#[inline]
#[target_feature(enable = "avx512f,avx512dq")]
fn negate_by_sign(values: __m512, sign: __m512) -> __m512 {
    let sign_bit = _mm512_and_ps(_mm512_set1_ps(-0.0), sign);
    _mm512_xor_ps(values, sign_bit)
}

#[inline]
#[target_feature(enable = "avx512f,avx512dq")]
fn sign_bits(values: __m512) -> u32 {
    u32::from(_mm512_movepi32_mask(_mm512_castps_si512(values)))
}

#[inline]
#[target_feature(enable = "avx512f")]
fn greater(a: __m512, b: __m512) -> u32 {
    u32::from(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(a, b))
}

#[inline]
#[target_feature(enable = "avx512f")]
fn at_most_and_positive(a: __m512, b: __m512, factor: __m512) -> u32 {
    let positive = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(factor, _mm512_setzero_ps());
    u32::from(_mm512_mask_cmp_ps_mask::<_CMP_LE_OQ>(positive, a, b))
}

/// Loads the pairs of sixteen samples and transposes them: x, y, u and v of all samples.
#[inline]
#[target_feature(enable = "avx512f,avx512dq")]
fn load_corner(samples: &CheckedSamples<'_>, from: usize, corner: usize) -> [__m512; 4] {
    // Each register holds the pairs of four samples that are four apart, so that it is enough to
    // transpose within the quarters of registers.
    let a = load_four_pairs(samples, from, corner);
    let b = load_four_pairs(samples, from + 1, corner);
    let c = load_four_pairs(samples, from + 2, corner);
    let d = load_four_pairs(samples, from + 3, corner);
    let ab_low = _mm512_unpacklo_ps(a, b);
    let ab_high = _mm512_unpackhi_ps(a, b);
    let cd_low = _mm512_unpacklo_ps(c, d);
    let cd_high = _mm512_unpackhi_ps(c, d);
    [
        _mm512_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low),
        _mm512_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low),
        _mm512_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high),
        _mm512_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high),
    ]
}

/// The pairs of a sample and of every fourth one after it.
#[inline]
#[target_feature(enable = "avx512f,avx512dq")]
fn load_four_pairs(samples: &CheckedSamples<'_>, sample: usize, corner: usize) -> __m512 {
    let one = _mm512_castps128_ps512(load_pair(samples.pair(sample, corner)));
    let two = _mm512_insertf32x4::<1>(one, load_pair(samples.pair(sample + 4, corner)));
    let three = _mm512_insertf32x4::<2>(two, load_pair(samples.pair(sample + 8, corner)));
    _mm512_insertf32x4::<3>(three, load_pair(samples.pair(sample + 12, corner)))
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load_pair(pair: &[f32; 4]) -> __m128 {
    // SAFETY: the array holds the four floats read, at any address.
    unsafe { _mm_loadu_ps(pair.as_ptr()) }
}

//! AVX2: eight samples or points at a time.

use super::pairs::CheckedSamples;
use super::vectors::{self, HomographyIsa};
use super::{Hypotheses, LANES, PointPairs, Sample};
use crate::registers::avx2::{Avx2Floats, Avx2Isa};
use std::arch::x86_64::*;

/// See [`super::proper`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn proper(pairs: &PointPairs, samples: &[Sample; LANES], min_area: f32) -> u32 {
    vectors::proper(Avx2Isa::new(), pairs, samples, min_area)
}

/// See [`super::solve`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn solve(pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
    vectors::solve(Avx2Isa::new(), pairs, samples)
}

/// See [`super::count_inliers`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn count_inliers(pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    vectors::count_inliers(Avx2Isa::new(), pairs, homography, floor)
}

impl HomographyIsa for Avx2Isa {
    #[inline(always)]
    fn divide(self, dividend: Avx2Floats, divisor: Avx2Floats) -> Avx2Floats {
        // SAFETY: `self` proves that the CPU has AVX2.
        Avx2Floats::new(self, unsafe {
            _mm256_div_ps(dividend.register(), divisor.register())
        })
    }

    #[inline(always)]
    fn xor(self, a: Avx2Floats, b: Avx2Floats) -> Avx2Floats {
        // SAFETY: `self` proves that the CPU has AVX2.
        Avx2Floats::new(self, unsafe { _mm256_xor_ps(a.register(), b.register()) })
    }

    #[inline(always)]
    fn or(self, a: Avx2Floats, b: Avx2Floats) -> Avx2Floats {
        // SAFETY: `self` proves that the CPU has AVX2.
        Avx2Floats::new(self, unsafe { _mm256_or_ps(a.register(), b.register()) })
    }

    #[inline(always)]
    fn negate_by_sign(self, values: Avx2Floats, sign: Avx2Floats) -> Avx2Floats {
        // SAFETY: `self` proves that the CPU has AVX2.
        Avx2Floats::new(self, unsafe {
            negate_by_sign(values.register(), sign.register())
        })
    }

    #[inline(always)]
    fn abs(self, values: Avx2Floats) -> Avx2Floats {
        // SAFETY: `self` proves that the CPU has AVX2.
        Avx2Floats::new(self, unsafe { abs(values.register()) })
    }

    #[inline(always)]
    fn sign_bits(self, values: Avx2Floats) -> u32 {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { sign_bits(values.register()) }
    }

    #[inline(always)]
    fn greater(self, a: Avx2Floats, b: Avx2Floats) -> u32 {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { greater(a.register(), b.register()) }
    }

    #[inline(always)]
    fn at_most_and_positive(self, a: Avx2Floats, b: Avx2Floats, factor: Avx2Floats) -> u32 {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { at_most_and_positive(a.register(), b.register(), factor.register()) }
    }

    #[inline(always)]
    fn corner(self, samples: &CheckedSamples<'_>, from: usize, corner: usize) -> [Avx2Floats; 4] {
        // SAFETY: `self` proves that the CPU has AVX2.
        let [x, y, u, v] = unsafe { load_corner(samples, from, corner) };
        [
            Avx2Floats::new(self, x),
            Avx2Floats::new(self, y),
            Avx2Floats::new(self, u),
            Avx2Floats::new(self, v),
        ]
    }
}

#[inline]
#[target_feature(enable = "avx2")]
fn abs(values: __m256) -> __m256 {
    _mm256_andnot_ps(_mm256_set1_ps(-0.0), values)
}

#[inline]
#[target_feature(enable = "avx2")]
fn negate_by_sign(values: __m256, sign: __m256) -> __m256 {
    let sign_bit = _mm256_and_ps(_mm256_set1_ps(-0.0), sign);
    _mm256_xor_ps(values, sign_bit)
}

#[inline]
#[target_feature(enable = "avx2")]
fn sign_bits(values: __m256) -> u32 {
    _mm256_movemask_ps(values) as u32
}

#[inline]
#[target_feature(enable = "avx2")]
fn greater(a: __m256, b: __m256) -> u32 {
    _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(a, b)) as u32
}

#[inline]
#[target_feature(enable = "avx2")]
fn at_most_and_positive(a: __m256, b: __m256, factor: __m256) -> u32 {
    let at_most = _mm256_cmp_ps::<_CMP_LE_OQ>(a, b);
    let positive = _mm256_cmp_ps::<_CMP_GT_OQ>(factor, _mm256_setzero_ps());
    _mm256_movemask_ps(_mm256_and_ps(at_most, positive)) as u32
}

/// Loads the pairs of eight samples and transposes them: x, y, u and v of all samples.
#[inline]
#[target_feature(enable = "avx2")]
fn load_corner(samples: &CheckedSamples<'_>, from: usize, corner: usize) -> [__m256; 4] {
    // Each register holds the pairs of two samples that are four apart, so that it is enough to
    // transpose within the halves of registers.
    let a = load_two_pairs(samples, from, corner);
    let b = load_two_pairs(samples, from + 1, corner);
    let c = load_two_pairs(samples, from + 2, corner);
    let d = load_two_pairs(samples, from + 3, corner);
    let ab_low = _mm256_unpacklo_ps(a, b);
    let ab_high = _mm256_unpackhi_ps(a, b);
    let cd_low = _mm256_unpacklo_ps(c, d);
    let cd_high = _mm256_unpackhi_ps(c, d);
    [
        _mm256_shuffle_ps::<0b01_00_01_00>(ab_low, cd_low),
        _mm256_shuffle_ps::<0b11_10_11_10>(ab_low, cd_low),
        _mm256_shuffle_ps::<0b01_00_01_00>(ab_high, cd_high),
        _mm256_shuffle_ps::<0b11_10_11_10>(ab_high, cd_high),
    ]
}

/// The pairs of a sample and of the fourth one after it.
#[inline]
#[target_feature(enable = "avx2")]
fn load_two_pairs(samples: &CheckedSamples<'_>, sample: usize, corner: usize) -> __m256 {
    let low = _mm256_castps128_ps256(load_pair(samples.pair(sample, corner)));
    _mm256_insertf128_ps::<1>(low, load_pair(samples.pair(sample + 4, corner)))
}

#[inline]
#[target_feature(enable = "avx2")]
fn load_pair(pair: &[f32; 4]) -> __m128 {
    // SAFETY: the array holds the four floats read, at any address.
    unsafe { _mm_loadu_ps(pair.as_ptr()) }
}

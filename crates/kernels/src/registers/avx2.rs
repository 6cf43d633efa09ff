//! Eight floats in an AVX register.

use super::{Bf16Isa, FloatVector, ROUNDING, VectorIsa, first, first_mut};
use std::arch::x86_64::*;

/// Whether the CPU has the instructions of this level.
pub(crate) fn is_available() -> bool {
    is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("fma")
        && is_x86_feature_detected!("f16c")
        && is_x86_feature_detected!("popcnt")
}

/// Proof that the CPU has AVX2, FMA and POPCNT.
#[derive(Clone, Copy)]
pub(crate) struct Avx2Isa(());

impl Avx2Isa {
    /// The proof. The compiler accepts this call without `unsafe` only inside a function that was
    /// compiled for the same instructions, which runs nowhere else.
    #[inline]
    #[target_feature(enable = "avx2,fma,popcnt")]
    pub(crate) fn new() -> Self {
        Self(())
    }
}

/// Eight floats. Values are made through [`Avx2Isa`] or from other values only, so each proves
/// that the CPU has AVX2 and FMA.
#[derive(Clone, Copy)]
pub(crate) struct Avx2Floats(__m256);

impl Avx2Floats {
    /// Takes a register over.
    #[inline(always)]
    pub(crate) fn new(_isa: Avx2Isa, register: __m256) -> Self {
        Self(register)
    }

    /// The register.
    #[inline(always)]
    pub(crate) fn register(self) -> __m256 {
        self.0
    }
}

impl VectorIsa for Avx2Isa {
    type Floats = Avx2Floats;

    #[inline(always)]
    fn splat(self, value: f32) -> Avx2Floats {
        // SAFETY: `self` proves that the CPU has AVX2.
        Avx2Floats(unsafe { _mm256_set1_ps(value) })
    }

    #[inline(always)]
    fn load(self, from: &[f32]) -> Avx2Floats {
        let from: &[f32; 8] = first(from);
        // SAFETY: the array holds the eight floats that this instruction reads, from any address;
        // `self` proves that the CPU has it.
        Avx2Floats(unsafe { _mm256_loadu_ps(from.as_ptr()) })
    }
}

impl Bf16Isa for Avx2Isa {}

/// Methods that are one instruction.
macro_rules! instructions {
    ($($method:ident($($argument:ident),*) = $intrinsic:ident;)*) => {$(
        #[inline(always)]
        fn $method(self, $($argument: Self),*) -> Self {
            // SAFETY: `self` proves that the CPU has AVX2 and FMA.
            Self(unsafe { $intrinsic(self.0 $(, $argument.0)*) })
        }
    )*};
}

impl FloatVector for Avx2Floats {
    const COUNT: usize = 8;

    instructions! {
        add(other) = _mm256_add_ps;
        sub(other) = _mm256_sub_ps;
        mul(other) = _mm256_mul_ps;
        mul_add(factor, term) = _mm256_fmadd_ps;
        min(other) = _mm256_min_ps;
        max(other) = _mm256_max_ps;
        scale(n) = scale;
        integer_difference(other) = integer_difference;
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { sum(self.0) }
    }

    #[inline(always)]
    fn maximum(self) -> f32 {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { maximum(self.0) }
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to: &mut [f32; 8] = first_mut(to);
        // SAFETY: the array has room for the eight floats that this instruction writes, at any
        // address; `self` proves that the CPU has it.
        unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) }
    }
}

#[inline]
#[target_feature(enable = "avx2")]
fn scale(values: __m256, n: __m256) -> __m256 {
    // The integer n stands in the lowest bits of the sum's mantissa; shifted into the exponent
    // with the bias of 127 it makes the float 2^n.
    let shifted = _mm256_castps_si256(_mm256_add_ps(n, _mm256_set1_ps(ROUNDING)));
    let biased = _mm256_add_epi32(shifted, _mm256_set1_epi32(127));
    let power = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(biased));
    _mm256_mul_ps(values, power)
}

#[inline]
#[target_feature(enable = "avx2")]
fn integer_difference(a: __m256, b: __m256) -> __m256 {
    let difference = _mm256_sub_epi32(_mm256_castps_si256(a), _mm256_castps_si256(b));
    _mm256_cvtepi32_ps(difference)
}

#[inline]
#[target_feature(enable = "avx2")]
fn sum(values: __m256) -> f32 {
    let low = _mm256_castps256_ps128(values);
    let half = _mm_add_ps(low, _mm256_extractf128_ps::<1>(values));
    let quarter = _mm_add_ps(half, _mm_movehl_ps(half, half));
    _mm_cvtss_f32(_mm_add_ss(quarter, _mm_movehdup_ps(quarter)))
}

#[inline]
#[target_feature(enable = "avx2")]
fn maximum(values: __m256) -> f32 {
    let low = _mm256_castps256_ps128(values);
    let half = _mm_max_ps(low, _mm256_extractf128_ps::<1>(values));
    let quarter = _mm_max_ps(half, _mm_movehl_ps(half, half));
    _mm_cvtss_f32(_mm_max_ss(quarter, _mm_movehdup_ps(quarter)))
}

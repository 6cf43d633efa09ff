//! AVX-512 with VNNI and, where the CPU has it, BF16.

use super::{ROUNDS, SUMS};
use crate::registers::avx512::{Avx512Isa, require_bf16};
use std::arch::x86_64::*;

/// See [`super::f32_operations`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn f32_loop(seed: f32) -> f32 {
    super::f32_loop::f32_loop(Avx512Isa::new(), seed)
}

/// See [`super::bf16_operations`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn bf16_loop(seed: i16) -> f32 {
    require_bf16();
    // SAFETY: the line above has found AVX-512 BF16; this function has the other instructions.
    unsafe { with_bf16(seed) }
}

#[target_feature(enable = "avx512f,avx512bf16")]
fn with_bf16(seed: i16) -> f32 {
    let words = _mm512_set1_epi16(seed);
    // SAFETY: both types are 512 bits, every pattern of which is a vector of bf16.
    let factor = unsafe { std::mem::transmute::<__m512i, __m512bh>(words) };
    let mut sums = [_mm512_setzero_ps(); SUMS];
    for _ in 0..ROUNDS {
        for sum in &mut sums {
            *sum = _mm512_dpbf16_ps(*sum, factor, factor);
        }
    }
    sums.into_iter().map(|sum| _mm512_reduce_add_ps(sum)).sum()
}

/// See [`super::int8_operations`].
#[target_feature(enable = "avx512f,avx512vnni")]
pub(super) fn int8_loop(seed: i8) -> f32 {
    let factor = _mm512_set1_epi32(i32::from(seed));
    let mut sums = [_mm512_setzero_si512(); SUMS];
    for _ in 0..ROUNDS {
        for sum in &mut sums {
            *sum = _mm512_dpbusd_epi32(*sum, factor, factor);
        }
    }
    sums.into_iter()
        .map(|sum| _mm512_reduce_add_epi32(sum) as f32)
        .sum()
}

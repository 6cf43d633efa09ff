//! Products of bf16 by `vdpbf16ps` and of int8 by `vpdpbusd`, sixteen words at a time.

use super::DotIsa;
use crate::registers::avx512::{Avx512Bf16Isa, Avx512Isa};
use crate::registers::{first, first_mut};
use std::arch::x86_64::*;

/// Pairs of bf16 with f32 sums.
#[derive(Clone, Copy)]
pub(in crate::gemm) struct Avx512Bf16Dot(pub(in crate::gemm) Avx512Bf16Isa);

/// Unsigned bytes on the left, signed bytes on the right, i32 sums.
#[derive(Clone, Copy)]
pub(in crate::gemm) struct Avx512Int8Dot(pub(in crate::gemm) Avx512Isa);

/// All that the two have in common: registers of sixteen words. The field of each type proves that
/// the CPU has the instructions.
macro_rules! dot_of_registers {
    ($name:ident, $add_products:ident) => {
        impl DotIsa for $name {
            const COUNT: usize = 16;
            type Register = __m512i;

            #[inline(always)]
            fn zero(self) -> __m512i {
                // SAFETY: `self` proves that the CPU has AVX-512.
                unsafe { _mm512_setzero_si512() }
            }

            #[inline(always)]
            fn load(self, from: &[u32]) -> __m512i {
                let from: &[u32; 16] = first(from);
                // SAFETY: the array holds the 64 bytes that this instruction reads, from any
                // address; `self` proves that the CPU has it.
                unsafe { _mm512_loadu_si512(from.as_ptr().cast()) }
            }

            #[inline(always)]
            fn broadcast(self, word: u32) -> __m512i {
                // SAFETY: `self` proves that the CPU has AVX-512.
                unsafe { _mm512_set1_epi32(word.cast_signed()) }
            }

            #[inline(always)]
            fn store(self, register: __m512i, to: &mut [u32]) {
                let to: &mut [u32; 16] = first_mut(to);
                // SAFETY: the array has room for the 64 bytes that this instruction writes, at any
                // address; `self` proves that the CPU has it.
                unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), register) }
            }

            #[inline(always)]
            fn add_products(self, sums: __m512i, left: __m512i, right: __m512i) -> __m512i {
                // SAFETY: `self` proves that the CPU has the instruction.
                unsafe { $add_products(sums, left, right) }
            }
        }
    };
}

dot_of_registers!(Avx512Bf16Dot, add_bf16_products);
dot_of_registers!(Avx512Int8Dot, _mm512_dpbusd_epi32);

#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn add_bf16_products(sums: __m512i, left: __m512i, right: __m512i) -> __m512i {
    let sums = _mm512_castsi512_ps(sums);
    let sums = _mm512_dpbf16_ps(sums, as_bf16(left), as_bf16(right));
    _mm512_castps_si512(sums)
}

#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn as_bf16(words: __m512i) -> __m512bh {
    // SAFETY: both types are 512 bits, every pattern of which is a vector of bf16.
    unsafe { std::mem::transmute::<__m512i, __m512bh>(words) }
}

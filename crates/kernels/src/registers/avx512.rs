//! Sixteen floats in an AVX-512 register.

use super::{Bf16Isa, FloatVector, VectorIsa, first, first_mut};
use std::arch::x86_64::*;

/// Whether the CPU has the instructions of this level.
pub(crate) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512vnni")
}

/// Whether the CPU has AVX-512 BF16, which not every CPU with the rest of AVX-512 has.
pub(crate) fn has_bf16() -> bool {
    is_x86_feature_detected!("avx512bf16")
}

/// Proof that the CPU has AVX-512 F, BW, DQ, VL and VNNI, and POPCNT.
#[derive(Clone, Copy)]
pub(crate) struct Avx512Isa(());

impl Avx512Isa {
    /// The proof. The compiler accepts this call without `unsafe` only inside a function that was
    /// compiled for the same instructions, which runs nowhere else.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
    pub(crate) fn new() -> Self {
        Self(())
    }
}

/// As [`Avx512Isa`], on a CPU that has AVX-512 BF16 too.
#[derive(Clone, Copy)]
pub(crate) struct Avx512Bf16Isa(Avx512Isa);

impl Avx512Bf16Isa {
    /// The proof, as [`Avx512Isa::new`].
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx512bf16,popcnt")]
    pub(crate) fn new() -> Self {
        Self(Avx512Isa::new())
    }
}

/// Stops unless the CPU has AVX-512 BF16: callers ask
/// [`Format::is_available`](crate::operand::Format::is_available) first.
///
/// # Panics
/// If it lacks them.
pub(crate) fn require_bf16() {
    assert!(has_bf16(), "this CPU has no AVX-512 BF16");
}

/// Sixteen floats. Values are made through [`Avx512Isa`] or from other values only, so each proves
/// that the CPU has AVX-512.
#[derive(Clone, Copy)]
pub(crate) struct Avx512Floats(__m512);

impl Avx512Floats {
    /// Takes a register over.
    #[inline(always)]
    pub(crate) fn new(_isa: Avx512Isa, register: __m512) -> Self {
        Self(register)
    }

    /// The register.
    #[inline(always)]
    pub(crate) fn register(self) -> __m512 {
        self.0
    }
}

/// The mask of the first `count` of sixteen elements.
#[inline(always)]
fn first_lanes(count: usize) -> __mmask16 {
    ((1u32 << count.min(16)) - 1) as __mmask16
}

impl VectorIsa for Avx512Isa {
    type Floats = Avx512Floats;

    #[inline(always)]
    fn splat(self, value: f32) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats(unsafe { _mm512_set1_ps(value) })
    }

    #[inline(always)]
    fn load(self, from: &[f32]) -> Avx512Floats {
        let from: &[f32; 16] = first(from);
        // SAFETY: the array holds the sixteen floats that this instruction reads, from any
        // address; `self` proves that the CPU has it.
        Avx512Floats(unsafe { _mm512_loadu_ps(from.as_ptr()) })
    }

    #[inline(always)]
    fn load_partial(self, from: &[f32], fill: f32) -> Avx512Floats {
        let fill = self.splat(fill).0;
        let lanes = first_lanes(from.len());
        // SAFETY: the mask lets no more elements be read than the slice holds; `self` proves that
        // the CPU has the instruction.
        Avx512Floats(unsafe { _mm512_mask_loadu_ps(fill, lanes, from.as_ptr()) })
    }

    #[inline(always)]
    fn keep_first(self, values: Avx512Floats, count: usize) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats(unsafe { _mm512_maskz_mov_ps(first_lanes(count), values.0) })
    }
}

impl VectorIsa for Avx512Bf16Isa {
    type Floats = Avx512Floats;

    #[inline(always)]
    fn splat(self, value: f32) -> Avx512Floats {
        self.0.splat(value)
    }

    #[inline(always)]
    fn load(self, from: &[f32]) -> Avx512Floats {
        self.0.load(from)
    }

    #[inline(always)]
    fn load_partial(self, from: &[f32], fill: f32) -> Avx512Floats {
        self.0.load_partial(from, fill)
    }

    #[inline(always)]
    fn keep_first(self, values: Avx512Floats, count: usize) -> Avx512Floats {
        self.0.keep_first(values, count)
    }
}

impl Bf16Isa for Avx512Bf16Isa {
    #[inline(always)]
    fn store_bf16(self, vector: Avx512Floats, to: &mut [u32]) {
        // SAFETY: `self` proves that the CPU has AVX-512 BF16.
        unsafe { store_bf16(vector.0, first_mut(to)) }
    }
}

/// Methods that are one instruction.
macro_rules! instructions {
    ($($method:ident($($argument:ident),*) = $intrinsic:ident;)*) => {$(
        #[inline(always)]
        fn $method(self, $($argument: Self),*) -> Self {
            // SAFETY: `self` proves that the CPU has AVX-512.
            Self(unsafe { $intrinsic(self.0 $(, $argument.0)*) })
        }
    )*};
}

impl FloatVector for Avx512Floats {
    const COUNT: usize = 16;

    instructions! {
        add(other) = _mm512_add_ps;
        sub(other) = _mm512_sub_ps;
        mul(other) = _mm512_mul_ps;
        mul_add(factor, term) = _mm512_fmadd_ps;
        min(other) = _mm512_min_ps;
        max(other) = _mm512_max_ps;
        scale(n) = _mm512_scalef_ps;
        integer_difference(other) = integer_difference;
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { _mm512_reduce_add_ps(self.0) }
    }

    #[inline(always)]
    fn maximum(self) -> f32 {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { _mm512_reduce_max_ps(self.0) }
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to: &mut [f32; 16] = first_mut(to);
        // SAFETY: the array has room for the sixteen floats that this instruction writes, at any
        // address; `self` proves that the CPU has it.
        unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
    }

    #[inline(always)]
    fn store_partial(self, to: &mut [f32]) {
        let lanes = first_lanes(to.len());
        // SAFETY: the mask lets no more elements be written than the slice holds; `self` proves
        // that the CPU has the instruction.
        unsafe { _mm512_mask_storeu_ps(to.as_mut_ptr(), lanes, self.0) }
    }

    #[inline(always)]
    fn store_u8(self, to: &mut [u8]) {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { store_u8(self.0, first_mut(to)) }
    }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn integer_difference(a: __m512, b: __m512) -> __m512 {
    let difference = _mm512_sub_epi32(_mm512_castps_si512(a), _mm512_castps_si512(b));
    _mm512_cvtepi32_ps(difference)
}

#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn store_bf16(values: __m512, to: &mut [u32; 8]) {
    let rounded = _mm512_cvtneps_pbh(values);
    // SAFETY: both types are 256 bits, every pattern of which is a vector of integers.
    let words = unsafe { std::mem::transmute::<__m256bh, __m256i>(rounded) };
    // SAFETY: the array has room for the 32 bytes written, at any address.
    unsafe { _mm256_storeu_si256(to.as_mut_ptr().cast(), words) }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn store_u8(values: __m512, to: &mut [u8; 16]) {
    let bytes = _mm512_cvtusepi32_epi8(_mm512_cvtps_epi32(values));
    // SAFETY: the array has room for the 16 bytes written, at any address.
    unsafe { _mm_storeu_si128(to.as_mut_ptr().cast(), bytes) }
}

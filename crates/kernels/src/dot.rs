//! Sums of products over 32-bit words: one f32, two bf16 or four int8 to a word, so that one
//! register tile serves every [`Format`](super::operand::Format).
//!
//! A word of the left-hand side meets the words of a row of the panel; each lane adds the products
//! of the numbers inside its word. Sums are f32, for int8 i32.

use super::lanes::Lanes;
#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// A vector of words, or of sums.
///
/// # Safety
/// Every method may be called only where the instructions are available that the type stands for;
/// pointers must be valid for `COUNT` words.
pub(super) trait Dot: Copy {
    /// Words per vector.
    const COUNT: usize;

    unsafe fn zero() -> Self;
    unsafe fn load(from: *const u32) -> Self;
    /// One word in every place.
    unsafe fn broadcast(from: *const u32) -> Self;
    unsafe fn store(self, to: *mut u32);
    /// `self` plus, lane by lane, the products of the numbers in the words of `left` and `right`.
    unsafe fn add_dot(self, left: Self, right: Self) -> Self;
}

// SAFETY (every block): the contract is that of `Lanes`.
impl<V: Lanes> Dot for V {
    const COUNT: usize = <V as Lanes>::COUNT;

    #[inline(always)]
    unsafe fn zero() -> Self {
        unsafe { V::splat(0.0) }
    }
    #[inline(always)]
    unsafe fn load(from: *const u32) -> Self {
        unsafe { <V as Lanes>::load(from.cast()) }
    }
    #[inline(always)]
    unsafe fn broadcast(from: *const u32) -> Self {
        unsafe { <V as Lanes>::broadcast(from.cast()) }
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut u32) {
        unsafe { <V as Lanes>::store(self, to.cast()) }
    }
    #[inline(always)]
    unsafe fn add_dot(self, left: Self, right: Self) -> Self {
        unsafe { left.mul_add(right, self) }
    }
}

/// The scalar twins: eight words in an array, by what is in a word.
macro_rules! portable {
    ($(#[$doc:meta])* $name:ident, $dot:expr) => {
        $(#[$doc])*
        #[derive(Clone, Copy)]
        pub(super) struct $name([u32; 8]);

        // SAFETY (every block): the caller vouches for eight words; reads and writes need not be
        // aligned.
        impl Dot for $name {
            const COUNT: usize = 8;

            #[inline(always)]
            unsafe fn zero() -> Self {
                Self([0; 8])
            }
            #[inline(always)]
            unsafe fn load(from: *const u32) -> Self {
                Self(unsafe { from.cast::<[u32; 8]>().read_unaligned() })
            }
            #[inline(always)]
            unsafe fn broadcast(from: *const u32) -> Self {
                Self([unsafe { from.read_unaligned() }; 8])
            }
            #[inline(always)]
            unsafe fn store(self, to: *mut u32) {
                unsafe { to.cast::<[u32; 8]>().write_unaligned(self.0) }
            }
            #[inline(always)]
            unsafe fn add_dot(self, left: Self, right: Self) -> Self {
                let dot: fn(u32, u32, u32) -> u32 = $dot;
                Self(std::array::from_fn(|lane| dot(self.0[lane], left.0[lane], right.0[lane])))
            }
        }
    };
}

portable!(
    /// Pairs of bf16, f32 sums.
    PortableBf16,
    |sum, left, right| {
        let low = |word: u32| f32::from_bits(word << 16);
        let high = |word: u32| f32::from_bits(word & 0xffff_0000);
        (f32::from_bits(sum) + high(left) * high(right) + low(left) * low(right)).to_bits()
    }
);

portable!(
    /// Unsigned bytes on the left, signed ones on the right, i32 sums.
    PortableInt8,
    |sum, left, right| {
        let products = left.to_le_bytes().into_iter().zip(right.to_le_bytes());
        products.fold(sum, |sum, (l, r)| sum.wrapping_add((i32::from(l) * i32::from(r.cast_signed())).cast_unsigned()))
    }
);

/// Sixteen pairs of bf16 for `vdpbf16ps`.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
pub(super) struct Avx512Bf16(__m512);

// SAFETY (every block): the trait's contract is that AVX-512 F and BF16 are available and pointers
// are valid.
#[cfg(target_arch = "x86_64")]
impl Dot for Avx512Bf16 {
    const COUNT: usize = 16;

    #[inline(always)]
    unsafe fn zero() -> Self {
        Self(unsafe { _mm512_setzero_ps() })
    }
    #[inline(always)]
    unsafe fn load(from: *const u32) -> Self {
        Self(unsafe { _mm512_loadu_ps(from.cast()) })
    }
    #[inline(always)]
    unsafe fn broadcast(from: *const u32) -> Self {
        Self(unsafe { _mm512_castsi512_ps(_mm512_set1_epi32(from.read_unaligned().cast_signed())) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut u32) {
        unsafe { _mm512_storeu_ps(to.cast(), self.0) }
    }
    #[inline(always)]
    unsafe fn add_dot(self, left: Self, right: Self) -> Self {
        // A bit pattern of 512 bits is a valid vector of bf16.
        let bf16 = |words: Self| unsafe { std::mem::transmute::<__m512, __m512bh>(words.0) };
        Self(unsafe { _mm512_dpbf16_ps(self.0, bf16(left), bf16(right)) })
    }
}

/// Sixteen words of four bytes for `vpdpbusd`.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
pub(super) struct Avx512Int8(__m512i);

// SAFETY (every block): the trait's contract is that AVX-512 F and VNNI are available and pointers
// are valid.
#[cfg(target_arch = "x86_64")]
impl Dot for Avx512Int8 {
    const COUNT: usize = 16;

    #[inline(always)]
    unsafe fn zero() -> Self {
        Self(unsafe { _mm512_setzero_si512() })
    }
    #[inline(always)]
    unsafe fn load(from: *const u32) -> Self {
        Self(unsafe { _mm512_loadu_si512(from.cast()) })
    }
    #[inline(always)]
    unsafe fn broadcast(from: *const u32) -> Self {
        Self(unsafe { _mm512_set1_epi32(from.read_unaligned().cast_signed()) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut u32) {
        unsafe { _mm512_storeu_si512(to.cast(), self.0) }
    }
    #[inline(always)]
    unsafe fn add_dot(self, left: Self, right: Self) -> Self {
        Self(unsafe { _mm512_dpbusd_epi32(self.0, left.0, right.0) })
    }
}

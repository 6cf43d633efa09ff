//! Sums of products over 32-bit words, which hold one f32, two bf16 or four int8, so that one
//! register tile serves every [`Format`](crate::operand::Format).
//!
//! A word of the left-hand side is multiplied with the words of a row of the panel; each lane adds
//! the products of the numbers inside its word. Sums are f32, or i32 for int8.

#[cfg(target_arch = "x86_64")]
pub(super) mod avx512;
pub(super) mod scalar;

use crate::registers::{FloatVector, VectorIsa};

/// The instructions for products in one format. A value proves that the CPU has them.
///
/// Slices are read and written from their start and may be longer than a register.
///
/// # Panics
/// Loads and stores panic if the slice is shorter than a register.
pub(super) trait DotIsa: Copy {
    /// Words, or sums, of a register.
    const COUNT: usize;
    /// A register of words or sums.
    type Register: Copy;

    /// Sums of nothing.
    fn zero(self) -> Self::Register;
    /// The first [`COUNT`](Self::COUNT) words.
    fn load(self, from: &[u32]) -> Self::Register;
    /// One word in every place.
    fn broadcast(self, word: u32) -> Self::Register;
    /// Writes the first [`COUNT`](Self::COUNT) words.
    fn store(self, register: Self::Register, to: &mut [u32]);
    /// `sums` plus, lane by lane, the products of the numbers in the words of `left` and `right`.
    fn add_products(
        self,
        sums: Self::Register,
        left: Self::Register,
        right: Self::Register,
    ) -> Self::Register;
}

/// One f32 to a word, for every instruction set.
#[derive(Clone, Copy)]
pub(super) struct F32Dot<I: VectorIsa>(pub(super) I);

impl<I: VectorIsa> DotIsa for F32Dot<I> {
    const COUNT: usize = I::Floats::COUNT;
    type Register = I::Floats;

    #[inline(always)]
    fn zero(self) -> I::Floats {
        self.0.splat(0.0)
    }

    #[inline(always)]
    fn load(self, from: &[u32]) -> I::Floats {
        self.0.load(bytemuck::cast_slice(from))
    }

    #[inline(always)]
    fn broadcast(self, word: u32) -> I::Floats {
        self.0.splat(f32::from_bits(word))
    }

    #[inline(always)]
    fn store(self, register: I::Floats, to: &mut [u32]) {
        register.store(bytemuck::cast_slice_mut(to));
    }

    #[inline(always)]
    fn add_products(self, sums: I::Floats, left: I::Floats, right: I::Floats) -> I::Floats {
        left.mul_add(right, sums)
    }
}

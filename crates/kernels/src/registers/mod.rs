//! One vector register of f32 for each instruction set, so that a kernel is written once as a
//! generic function and compiled for every set.
//!
//! Intrinsics may run only on a CPU that has them. Here the type system keeps track of that: a
//! [`VectorIsa`] value can be made only inside a function that was compiled for its instructions
//! (see [`Avx2Isa::new`](avx2::Avx2Isa::new)), and a [`FloatVector`] only through such a value. So
//! whoever holds either may use the instructions, and every method is safe to call.
//!
//! Generic kernels and all methods are `#[inline(always)]`: they carry no `#[target_feature]` of
//! their own and must become part of the function that does.
//!
//! `min` and `max` follow x86: where either operand is NaN they give the second, so a kernel
//! decides by the order of its operands whether NaN survives.

#[cfg(target_arch = "x86_64")]
pub(crate) mod amx;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
pub(crate) mod scalar;

/// Elements of the longest vector.
pub(crate) const MAX_COUNT: usize = 16;

/// Added to and then taken from a float below 2^22 in magnitude, it rounds to the nearest integer.
pub(crate) const ROUNDING: f32 = 12_582_912.0;

/// The vector instructions of one level. A value proves that the CPU has them.
pub(crate) trait VectorIsa: Copy {
    /// The vector register.
    type Floats: FloatVector;

    /// `value` in every element.
    fn splat(self, value: f32) -> Self::Floats;

    /// The first [`FloatVector::COUNT`] elements of a slice.
    ///
    /// # Panics
    /// If the slice is shorter.
    fn load(self, from: &[f32]) -> Self::Floats;

    /// All elements of a slice that is not longer than a vector, followed by `fill`.
    ///
    /// # Panics
    /// If the slice is longer.
    #[inline(always)]
    fn load_partial(self, from: &[f32], fill: f32) -> Self::Floats {
        let mut padded = [fill; MAX_COUNT];
        padded[..from.len()].copy_from_slice(from);
        self.load(&padded)
    }

    /// The first `count` elements of `values`, the others zero.
    #[inline(always)]
    fn keep_first(self, values: Self::Floats, count: usize) -> Self::Floats {
        let mut kept = [0.0f32; MAX_COUNT];
        values.store(&mut kept);
        kept[count..].fill(0.0);
        self.load(&kept)
    }
}

/// Vector instructions with which f32 are rounded to bf16: not every CPU with AVX-512 has them.
pub(crate) trait Bf16Isa: VectorIsa {
    /// Stores all elements as bf16, rounded to the nearest, two to a word: `COUNT / 2` words, the
    /// earlier element in the low half.
    ///
    /// # Panics
    /// If the slice is shorter.
    #[inline(always)]
    fn store_bf16(self, vector: Self::Floats, to: &mut [u32]) {
        let mut values = [0.0f32; MAX_COUNT];
        vector.store(&mut values);
        let bits = |value: f32| u32::from(half::bf16::from_f32(value).to_bits());
        let to = &mut to[..Self::Floats::COUNT / 2];
        for (word, pair) in to.iter_mut().zip(values.as_chunks::<2>().0) {
            *word = bits(pair[0]) | bits(pair[1]) << 16;
        }
    }

    /// As [`store_bf16`](Self::store_bf16), but only as many words as `to` is long.
    #[inline(always)]
    fn store_bf16_partial(self, vector: Self::Floats, to: &mut [u32]) {
        let mut words = [0u32; MAX_COUNT / 2];
        self.store_bf16(vector, &mut words);
        to.copy_from_slice(&words[..to.len()]);
    }
}

/// A vector of f32.
///
/// Stores write to the first elements of a slice and panic if it is too short.
pub(crate) trait FloatVector: Copy {
    /// Elements per vector.
    const COUNT: usize;

    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    /// `self * factor + term`, fused where the instruction set can.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    /// `self * 2^n` for a whole n, -126 <= n <= 127.
    fn scale(self, n: Self) -> Self;
    /// The bits of `self` less those of `other`, both taken as i32, as floats.
    fn integer_difference(self, other: Self) -> Self;
    /// The sum of all elements.
    fn sum(self) -> f32;
    /// The largest element.
    fn maximum(self) -> f32;
    /// Stores all elements.
    fn store(self, to: &mut [f32]);

    /// Stores as many of the first elements as `to` is long, at most [`COUNT`](Self::COUNT).
    #[inline(always)]
    fn store_partial(self, to: &mut [f32]) {
        let mut values = [0.0f32; MAX_COUNT];
        self.store(&mut values);
        to.copy_from_slice(&values[..to.len()]);
    }

    /// Stores the elements, which must lie in 0..=255, rounded to the nearest as `COUNT` bytes.
    #[inline(always)]
    fn store_u8(self, to: &mut [u8]) {
        let mut values = [0.0f32; MAX_COUNT];
        self.store(&mut values);
        for (byte, value) in to[..Self::COUNT].iter_mut().zip(values) {
            *byte = value.round_ties_even() as u8;
        }
    }
}

/// The first `N` elements of a slice, which is what a register loads or stores.
///
/// # Panics
/// If the slice is shorter.
#[inline(always)]
pub(crate) fn first<T, const N: usize>(slice: &[T]) -> &[T; N] {
    match slice.first_chunk() {
        Some(chunk) => chunk,
        None => shorter_than_a_vector(),
    }
}

/// As [`first`], to be written to.
///
/// # Panics
/// If the slice is shorter.
#[inline(always)]
pub(crate) fn first_mut<T, const N: usize>(slice: &mut [T]) -> &mut [T; N] {
    match slice.first_chunk_mut() {
        Some(chunk) => chunk,
        None => shorter_than_a_vector(),
    }
}

#[cold]
#[inline(never)]
fn shorter_than_a_vector() -> ! {
    panic!("a slice is shorter than a vector")
}

//! Eight floats in an array: portable Rust, and the reference for the other instruction sets.

use super::{Bf16Isa, FloatVector, ROUNDING, VectorIsa, first, first_mut};

/// No instructions beyond what every CPU of the target has.
#[derive(Clone, Copy)]
pub(crate) struct ScalarIsa;

/// Eight floats.
#[derive(Clone, Copy)]
pub(crate) struct ScalarFloats([f32; 8]);

impl ScalarFloats {
    #[inline(always)]
    fn zip(self, other: Self, apply: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| {
            apply(self.0[lane], other.0[lane])
        }))
    }
}

impl VectorIsa for ScalarIsa {
    type Floats = ScalarFloats;

    #[inline(always)]
    fn splat(self, value: f32) -> ScalarFloats {
        ScalarFloats([value; 8])
    }

    #[inline(always)]
    fn load(self, from: &[f32]) -> ScalarFloats {
        ScalarFloats(*first(from))
    }
}

impl Bf16Isa for ScalarIsa {}

impl FloatVector for ScalarFloats {
    const COUNT: usize = 8;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        self.mul(factor).add(term)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn scale(self, n: Self) -> Self {
        self.zip(n, |value, n| {
            // The integer n stands in the lowest bits of the sum's mantissa; shifted into the
            // exponent with the bias of 127 it makes the float 2^n.
            let exponent = (n + ROUNDING).to_bits().wrapping_add(127);
            value * f32::from_bits(exponent << 23)
        })
    }

    #[inline(always)]
    fn integer_difference(self, other: Self) -> Self {
        self.zip(other, |a, b| {
            a.to_bits().wrapping_sub(b.to_bits()).cast_signed() as f32
        })
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        self.0.iter().sum()
    }

    #[inline(always)]
    fn maximum(self) -> f32 {
        let larger = |a: f32, b: f32| if a > b { a } else { b };
        self.0.into_iter().fold(f32::NEG_INFINITY, larger)
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        *first_mut(to) = self.0;
    }
}

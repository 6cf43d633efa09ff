//! `exp2` and GELU by polynomials, in vectors.
//!
//! Calls of the mathematical library take one number at a time and would cost more than the matrix
//! products. Polynomials need only multiplications and additions.
//!
//! `2^x` is `2^n 2^f` with a whole n and f in [-0.5, 0.5], where 2^f is a polynomial of degree 5
//! (relative error 1e-7), or of degree 4 (3e-6) if the result is rounded to eight bits anyway.
//!
//! GELU needs the normal distribution, which is `1/2 + x P(x^2)` up to a limit, and 0 or 1 beyond
//! it. P has degree 13 and the limit is 5.3 (absolute error of GELU 8e-7), or degree 7 and 4.2
//! (8e-5) if the next product has eight bits. P is a polynomial in x^2 mapped linearly to [-1, 1].
//!
//! All polynomials were fitted for the smallest maximal error. P was constrained to 1 / (2 limit)
//! at the limit, so that `1/2 + x P(x^2)` is exactly 0 or 1 there and clamping x is enough.

use crate::registers::{FloatVector, ROUNDING, VectorIsa};

/// 2^f on [-0.5, 0.5], highest power first.
pub(super) const EXP2: [f32; 6] = [
    0.001_327_647,
    0.009_675_541,
    0.055_507_135,
    0.240_221_2,
    0.693_146_94,
    1.000_000_1,
];

/// The same for results that are rounded to eight bits.
pub(super) const EXP2_SHORT: [f32; 5] = [
    0.009_570_101,
    0.055_917_86,
    0.240_247_44,
    0.693_121_8,
    0.999_999_3,
];

/// 2^x for x up to 127, by a polynomial of 2^f for the fraction f. What is smaller than -126 gives
/// 2^-126, NaN stays NaN.
#[inline(always)]
pub(super) fn exp2<I: VectorIsa>(isa: I, x: I::Floats, polynomial: &[f32]) -> I::Floats {
    let x = isa.splat(-126.0).max(x);
    let whole = x.add(isa.splat(ROUNDING)).sub(isa.splat(ROUNDING));
    horner(isa, x.sub(whole), polynomial).scale(whole)
}

/// GELU: x times the normal distribution's share below x, which is `x (1/2 + c P(c^2))` with c the
/// value x clamped to the limit and P a polynomial.
#[inline(always)]
pub(super) fn gelu<I: VectorIsa, const N: usize>(
    isa: I,
    x: I::Floats,
    (limit, polynomial): &(f32, [f32; N]),
) -> I::Floats {
    let clamped = isa.splat(-limit).max(isa.splat(*limit).min(x));
    let square = clamped.mul(clamped);
    let mapped = square.mul_add(isa.splat(2.0 / (limit * limit)), isa.splat(-1.0));
    let share = clamped.mul_add(horner(isa, mapped, polynomial), isa.splat(0.5));
    x.mul(share)
}

/// The limit, and P of the normal distribution 1/2 + x P(2 x^2 / limit^2 - 1), highest power first.
pub(super) const GELU: (f32, [f32; 14]) = (
    5.3,
    [
        -0.000_412_507_88,
        0.001_493_334_7,
        -0.002_088_212_1,
        0.002_374_939_9,
        -0.004_785_631,
        0.009_172_573,
        -0.013_726_092,
        0.018_858_41,
        -0.025_166_757,
        0.032_083_21,
        -0.039_602_4,
        0.049_264_32,
        -0.066_518_12,
        0.133_392_56,
    ],
);

/// The same for results that are rounded to eight bits.
pub(super) const GELU_SHORT: (f32, [f32; 8]) = (
    4.2,
    [
        -0.003_744_275_2,
        0.011_175_75,
        -0.016_467_191,
        0.023_777_725,
        -0.037_926_184,
        0.055_948_712,
        -0.081_571_475,
        0.167_854_56,
    ],
);

/// The value of a polynomial at x; coefficients, at least one, from the highest power on.
#[inline(always)]
fn horner<I: VectorIsa>(isa: I, x: I::Floats, coefficients: &[f32]) -> I::Floats {
    let mut value = isa.splat(coefficients[0]);
    for &coefficient in &coefficients[1..] {
        value = value.mul_add(x, isa.splat(coefficient));
    }
    value
}

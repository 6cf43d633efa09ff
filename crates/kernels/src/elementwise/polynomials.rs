//! `exp2` and GELU by polynomials, in vectors.
//!
//! 2^f on [-0.5, 0.5] is a polynomial of degree 5 (relative error 1e-7), or 4 (3e-6) where the
//! result is rounded to eight bits anyway. The normal distribution in GELU is 1/2 + x P(x^2) up to
//! a limit, 0 or 1 beyond, with P of degree 13 in x^2 mapped to [-1, 1] up to 5.3 (absolute error
//! of GELU 8e-7), or 7 up to 4.2 (8e-5) where the next product has eight bits. All were fitted for
//! the smallest maximal error; P is just 1 / (2 limit) at the limit, so that nothing has to be cut
//! off there.

use crate::lanes::{Lanes, ROUNDING};

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

/// 2^x for x up to 127 by a polynomial of 2^f; smaller than -126 gives 2^-126, NaN stays NaN.
#[inline(always)]
pub(super) unsafe fn exp2<V: Lanes>(x: V, polynomial: &[f32]) -> V {
    // SAFETY: arithmetic only; the caller's level is available.
    unsafe {
        let x = V::splat(-126.0).max(x);
        let whole = x.add(V::splat(ROUNDING)).sub(V::splat(ROUNDING));
        horner(x.sub(whole), polynomial).scale(whole)
    }
}

/// x times the normal distribution's share below x: x/2 + x^2 P(x^2), with x in P and before it
/// kept to the limit.
#[inline(always)]
pub(super) unsafe fn gelu<V: Lanes, const N: usize>(
    x: V,
    (limit, polynomial): &(f32, [f32; N]),
) -> V {
    // SAFETY: as in `exp2`.
    unsafe {
        let kept = V::splat(-limit).max(V::splat(*limit).min(x));
        let mapped = kept
            .mul(kept)
            .mul_add(V::splat(2.0 / (limit * limit)), V::splat(-1.0));
        x.mul(kept.mul_add(horner(mapped, polynomial), V::splat(0.5)))
    }
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

/// A polynomial, highest power first.
#[inline(always)]
unsafe fn horner<V: Lanes>(x: V, coefficients: &[f32]) -> V {
    // SAFETY: as in `exp2`; every caller passes at least one coefficient.
    unsafe {
        let mut value = V::splat(coefficients[0]);
        for &coefficient in &coefficients[1..] {
            value = value.mul_add(x, V::splat(coefficient));
        }
        value
    }
}

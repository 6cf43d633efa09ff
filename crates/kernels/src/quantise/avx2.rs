//! The loops of [`scalar`] compiled for AVX2.

use super::scalar;

/// See [`super::largest`].
#[target_feature(enable = "avx2")]
pub(super) fn largest(values: &[f32]) -> f32 {
    scalar::largest(values)
}

/// See [`super::quantise`].
#[target_feature(enable = "avx2")]
pub(super) fn quantise(values: &[f32], divisor: f32, factor: f32, codes: &mut [i8]) {
    scalar::quantise(values, divisor, factor, codes);
}

/// See [`super::squared_lengths`].
#[target_feature(enable = "avx2")]
pub(super) fn squared_lengths(values: &[f32], codes: &[i8], scale: f32) -> (f64, f64) {
    scalar::squared_lengths(values, codes, scale)
}

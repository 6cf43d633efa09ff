//! Quantising f32 vectors to int8 codes, and measuring what the codes lose.
//!
//! Every descriptor that is extracted from an image (some 300 vectors of 384 values for each) is
//! stored as int8 codes with a factor, and every reference's global descriptor is quantised while
//! an index is built. The search needs the length of the quantisation error to bound distances.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod check;
mod scalar;
#[cfg(test)]
mod tests;

use crate::Simd;
use crate::dispatch::dispatch;
pub(crate) use check::check;

/// The largest magnitude among `values`, zero if there are none; NaN is ignored.
pub fn largest(simd: Simd, values: &[f32]) -> f32 {
    dispatch!(simd, largest(values))
}

/// Writes `value / divisor * factor` for each of `n` values as a code in -127..=127 to `codes`,
/// `[n]`: rounded to the nearest integer, halves away from zero. NaN becomes 0.
///
/// # Panics
/// If `values` and `codes` differ in length.
pub fn quantise(simd: Simd, values: &[f32], divisor: f32, factor: f32, codes: &mut [i8]) {
    assert_eq!(values.len(), codes.len(), "one code per value");
    dispatch!(simd, quantise(values, divisor, factor, codes));
}

/// The squared length of the quantisation error `values - scale * codes`, and that of `values`.
///
/// # Panics
/// If `values` and `codes` differ in length.
pub fn squared_lengths(simd: Simd, values: &[f32], codes: &[i8], scale: f32) -> (f64, f64) {
    assert_eq!(values.len(), codes.len(), "one code per value");
    dispatch!(simd, squared_lengths(values, codes, scale))
}

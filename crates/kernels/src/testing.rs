//! Inputs and comparisons for the self-checks and tests of kernels.

/// `len` values in about [-1, 1], the same for the same seed.
pub(super) fn ramp(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        (state >> 8) as f32 / 8_388_608.0 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

/// Whether `actual` is NaN, or differs from `expected` by more than `tolerance`.
pub(super) fn differ(actual: f32, expected: f64, tolerance: f64) -> bool {
    let difference = (f64::from(actual) - expected).abs();
    difference.is_nan() || difference > tolerance
}

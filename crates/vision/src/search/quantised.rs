//! A global descriptor as int8 codes, with a bound on what the codes lose.

use placeformer_kernels::scan::{Codes, LENGTH};
use placeformer_kernels::{quantise, simd};

/// Widens lengths and errors that were rounded to f32, so that they are upper bounds.
const ROUND_UP: f64 = 1.0 + 1e-6;

/// A vector as int8 codes.
#[derive(Debug, Clone)]
pub(super) struct QuantisedVector {
    pub codes: Codes,
    /// The vector is about `scale` times the codes.
    pub scale: f32,
    /// Upper bound of the length of the difference between the vector and `scale` times the codes.
    pub error: f32,
    /// Squared length of the vector itself.
    pub square: f32,
}

impl QuantisedVector {
    /// Quantises symmetrically: the largest magnitude becomes 127.
    pub(super) fn new(vector: &[f32]) -> Self {
        let simd = simd::selected();
        let mut scale = quantise::largest(simd, vector) / 127.0;
        let mut codes = [0; LENGTH];
        if scale.is_normal() {
            quantise::quantise(simd, vector, scale, 1.0, &mut codes);
        } else {
            // Codes times a scale that is zero, subnormal or not finite mean nothing. With all
            // codes zero, the error is the length of the whole vector, and the bounds stay true.
            scale = 0.0;
        }
        let (missed, square) = quantise::squared_lengths(simd, vector, &codes, scale);
        Self {
            codes: Codes::new(codes),
            scale,
            error: (missed.sqrt() * ROUND_UP) as f32,
            square: square as f32,
        }
    }

    /// Upper bound of the length of `scale` times the codes.
    pub(super) fn length_bound(&self) -> f32 {
        self.square.sqrt() * (1.0 + 1e-6) + self.error
    }
}

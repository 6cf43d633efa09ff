//! The self-check: codes and lengths of a level against those of the scalar reference.

use super::scalar;
use super::{largest, quantise, squared_lengths};
use crate::Simd;
use crate::testing::ramp;

/// Compares a level with the scalar reference, bit for bit.
pub(crate) fn check(simd: Simd) -> Result<(), String> {
    for len in [0, 1, 15, 16, 17, 100, 384] {
        let mut values = ramp(len, len as u32 + 1);
        if len > 20 {
            values[7] = f32::NAN;
            values[len - 3] = f32::INFINITY;
        }
        for divisor in [0.0, 1e-3, 0.9, scalar::largest(&values)] {
            let mut expected = vec![0; len];
            let mut found = vec![0; len];
            scalar::quantise(&values, divisor, 127.0, &mut expected);
            quantise(simd, &values, divisor, 127.0, &mut found);
            let bits = |(missed, whole): (f64, f64)| (missed.to_bits(), whole.to_bits());
            let finite = values.iter().all(|value| value.is_finite());
            let sums = [
                squared_lengths(simd, &values, &found, divisor),
                scalar::squared_lengths(&values, &found, divisor),
            ];
            if found != expected
                || largest(simd, &values).to_bits() != scalar::largest(&values).to_bits()
                || finite && bits(sums[0]) != bits(sums[1])
            {
                return Err(format!("{len} values divided by {divisor}"));
            }
        }
    }
    Ok(())
}

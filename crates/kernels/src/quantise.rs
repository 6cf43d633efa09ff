//! f32 vectors to int8 codes, and how much the codes miss.
//!
//! Every extracted image passes here (some 300 descriptors of 384 values), and every reference
//! while an index is built. Written as plain loops over lanes, which the compiler turns into
//! vectors at each level: nothing is fused and sums have a fixed order, so the bits are the same
//! everywhere. The portable instance is the scalar twin.

use super::Simd;
#[cfg(target_arch = "x86_64")]
use super::SimdLevel;

/// Lanes that are added up side by side.
const LANES: usize = 16;

/// Compiles a loop for each level and picks among the instances by a token.
macro_rules! at_each_level {
    ($simd:expr, $loop:ident($($name:ident: $type:ty),*) $(-> $return:ty)?) => {{
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2")]
        fn avx2($($name: $type),*) $(-> $return)? {
            $loop($($name),*)
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
        fn avx512($($name: $type),*) $(-> $return)? {
            $loop($($name),*)
        }
        match $simd.level() {
            // SAFETY: the token proves that the CPU has the level's instructions.
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx512 | SimdLevel::Amx => unsafe { avx512($($name),*) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx2 => unsafe { avx2($($name),*) },
            _ => $loop($($name),*),
        }
    }};
}

/// The largest magnitude, zero of none; what is not a number is passed over.
pub fn largest(simd: Simd, values: &[f32]) -> f32 {
    at_each_level!(simd, largest_of(values: &[f32]) -> f32)
}

#[inline(always)]
fn largest_of(values: &[f32]) -> f32 {
    let larger = |held: f32, value: f32| {
        if value.abs() > held {
            value.abs()
        } else {
            held
        }
    };
    let mut lanes = [0f32; LANES];
    let (groups, rest) = values.as_chunks::<LANES>();
    for group in groups {
        for lane in 0..LANES {
            lanes[lane] = larger(lanes[lane], group[lane]);
        }
    }
    rest.iter()
        .chain(&lanes)
        .fold(0.0, |held, &value| larger(held, value))
}

/// Writes `value / divisor * factor` as codes in -127..=127, rounded to the nearest, halves away
/// from zero; what is not a number becomes 0.
///
/// # Panics
/// If `values` and `codes` differ in length.
pub fn quantise(simd: Simd, values: &[f32], divisor: f32, factor: f32, codes: &mut [i8]) {
    assert_eq!(values.len(), codes.len(), "one code per value");
    at_each_level!(simd, quantise_all(values: &[f32], divisor: f32, factor: f32, codes: &mut [i8]));
}

#[inline(always)]
fn quantise_all(values: &[f32], divisor: f32, factor: f32, codes: &mut [i8]) {
    for (code, value) in codes.iter_mut().zip(values) {
        let scaled = value / divisor * factor;
        let scaled = if scaled.is_nan() {
            0.0
        } else {
            scaled.clamp(-127.0, 127.0)
        };
        // SAFETY: a number within -127..=127. A plain cast would saturate, which the compiler does
        // lane by lane.
        let whole: i32 = unsafe { scaled.to_int_unchecked() };
        // Exact, so that a half is told from what lies beside it.
        let left = scaled - whole as f32;
        *code = (whole + i32::from(left >= 0.5) - i32::from(left <= -0.5)) as i8;
    }
}

/// Squared lengths: of what the codes (times `scale`) miss, and of the vector itself.
///
/// # Panics
/// If `values` and `codes` differ in length.
pub fn squared_lengths(simd: Simd, values: &[f32], codes: &[i8], scale: f32) -> (f64, f64) {
    assert_eq!(values.len(), codes.len(), "one code per value");
    at_each_level!(simd, sum_squares(values: &[f32], codes: &[i8], scale: f32) -> (f64, f64))
}

#[inline(always)]
fn sum_squares(values: &[f32], codes: &[i8], scale: f32) -> (f64, f64) {
    let (mut missed, mut whole) = ([0f64; LANES], [0f64; LANES]);
    for (values, codes) in values.chunks(LANES).zip(codes.chunks(LANES)) {
        if let (Some(values), Some(codes)) =
            (values.first_chunk::<LANES>(), codes.first_chunk::<LANES>())
        {
            for lane in 0..LANES {
                let value = f64::from(values[lane]);
                let error = value - f64::from(scale) * f64::from(codes[lane]);
                missed[lane] += error * error;
                whole[lane] += value * value;
            }
        } else {
            for (lane, (&value, &code)) in values.iter().zip(codes).enumerate() {
                let value = f64::from(value);
                let error = value - f64::from(scale) * f64::from(code);
                missed[lane] += error * error;
                whole[lane] += value * value;
            }
        }
    }
    (missed.iter().sum(), whole.iter().sum())
}

/// Compares the level with the portable instance.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    for len in [0, 1, 15, 16, 17, 100, 384] {
        let mut values = super::testing::ramp(len, len as u32 + 1);
        if len > 20 {
            values[7] = f32::NAN;
            values[len - 3] = f32::INFINITY;
        }
        for divisor in [0.0, 1e-3, 0.9, largest_of(&values)] {
            let (mut expected, mut found) = (vec![0; len], vec![0; len]);
            quantise_all(&values, divisor, 127.0, &mut expected);
            quantise(simd, &values, divisor, 127.0, &mut found);
            let bits = |(missed, whole): (f64, f64)| (missed.to_bits(), whole.to_bits());
            let finite = values.iter().all(|value| value.is_finite());
            let sums = [
                squared_lengths(simd, &values, &found, divisor),
                sum_squares(&values, &found, divisor),
            ];
            if found != expected
                || largest(simd, &values).to_bits() != largest_of(&values).to_bits()
                || finite && bits(sums[0]) != bits(sums[1])
            {
                return Err(format!("{len} values divided by {divisor}"));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn halves_go_away_from_zero_and_excess_to_the_ends() {
        let values = [
            0.5,
            -0.5,
            0.49999997,
            -0.49999997,
            1.5,
            -2.5,
            126.5,
            300.0,
            -300.0,
            f32::NAN,
            f32::INFINITY,
            0.0,
        ];
        for simd in Simd::all() {
            let mut codes = [0; 12];
            quantise(simd, &values, 1.0, 1.0, &mut codes);
            assert_eq!(codes, [1, -1, 0, 0, 2, -3, 127, 127, -127, 0, 127, 0]);
            assert_eq!(largest(simd, &values[..10]), 300.0);
            assert_eq!(largest(simd, &[]), 0.0);
        }
    }

    proptest! {
        #[test]
        fn codes_are_those_of_rounding_and_every_level_gives_the_same_bits(
            values in prop::collection::vec(any::<f32>(), 0..100), divisor: f32, factor in prop_oneof![Just(1f32), Just(127f32)],
        ) {
            let plain = |value: &f32| (value / divisor * factor).round().clamp(-127.0, 127.0) as i8;
            let expected: Vec<i8> = values.iter().map(plain).collect();
            let finite: Vec<f32> = values.iter().map(|value| if value.is_finite() { *value } else { 1.0 }).collect();
            for simd in Simd::all() {
                let mut codes = vec![0; values.len()];
                quantise(simd, &values, divisor, factor, &mut codes);
                prop_assert_eq!(&codes, &expected);
                let peak = values.iter().fold(0f32, |peak, value| peak.max(value.abs()));
                prop_assert_eq!(largest(simd, &values), peak);
                prop_assert_eq!(
                    squared_lengths(simd, &finite, &codes, 0.5),
                    squared_lengths(Simd::SCALAR, &finite, &codes, 0.5)
                );
            }
        }

        #[test]
        fn squared_lengths_are_those_of_the_plain_sums(values in prop::collection::vec(-1f32..1.0, 0..300)) {
            let mut codes = vec![0; values.len()];
            quantise(Simd::best(), &values, 1.0, 127.0, &mut codes);
            let (missed, whole) = squared_lengths(Simd::best(), &values, &codes, 1.0 / 127.0);
            let errors = values.iter().zip(&codes).map(|(v, c)| f64::from(*v) - f64::from(1f32 / 127.0) * f64::from(*c));
            prop_assert!((missed - errors.map(|error| error * error).sum::<f64>()).abs() < 1e-9);
            prop_assert!((whole - values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>()).abs() < 1e-9);
        }
    }
}

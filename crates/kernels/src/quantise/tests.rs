//! Rounding rules, and every instruction set against plain arithmetic.

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
        values in prop::collection::vec(any::<f32>(), 0..100),
        divisor: f32,
        factor in prop_oneof![Just(1f32), Just(127f32)],
    ) {
        let plain = |value: &f32| (value / divisor * factor).round().clamp(-127.0, 127.0) as i8;
        let expected: Vec<i8> = values.iter().map(plain).collect();
        let finite: Vec<f32> = values
            .iter()
            .map(|value| if value.is_finite() { *value } else { 1.0 })
            .collect();
        for simd in Simd::all() {
            let mut codes = vec![0; values.len()];
            quantise(simd, &values, divisor, factor, &mut codes);
            prop_assert_eq!(&codes, &expected);
            let peak = values
                .iter()
                .fold(0f32, |peak, value| peak.max(value.abs()));
            prop_assert_eq!(largest(simd, &values), peak);
            prop_assert_eq!(
                squared_lengths(simd, &finite, &codes, 0.5),
                squared_lengths(Simd::SCALAR, &finite, &codes, 0.5)
            );
        }
    }

    #[test]
    fn squared_lengths_are_those_of_the_plain_sums(
        values in prop::collection::vec(-1f32..1.0, 0..300),
    ) {
        let mut codes = vec![0; values.len()];
        quantise(Simd::best(), &values, 1.0, 127.0, &mut codes);
        let (missed, whole) = squared_lengths(Simd::best(), &values, &codes, 1.0 / 127.0);
        let errors = values
            .iter()
            .zip(&codes)
            .map(|(v, c)| f64::from(*v) - f64::from(1f32 / 127.0) * f64::from(*c));
        prop_assert!((missed - errors.map(|error| error * error).sum::<f64>()).abs() < 1e-9);
        prop_assert!(
            (whole - values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>()).abs() < 1e-9
        );
    }
}

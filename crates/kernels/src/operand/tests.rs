//! Packed rows stand for their source, within the format's precision, at every level.

use super::*;
use crate::testing::ramp;
use proptest::prelude::*;

/// The numbers that packed rows stand for, `[rows, width]`.
fn unpack(format: Format, left: LeftOperand<'_>, rows: usize, width: usize) -> Vec<f32> {
    let value = |row: usize, column: usize| {
        let word = left.rows.data[row * left.rows.stride + column / format.per_word()];
        let part = column % format.per_word();
        match format {
            Format::F32 => f32::from_bits(word),
            Format::Bf16 => f32::from_bits((word >> (16 * part)) << 16),
            Format::Int8 => (f32::from(word.to_le_bytes()[part]) - 128.0) * left.factors[row],
        }
    };
    (0..rows * width)
        .map(|at| value(at / width, at % width))
        .collect()
}

proptest! {
    #[test]
    fn packing_keeps_values_within_the_formats_step(
        rows in 1usize..5,
        steps in 1usize..9,
        scale in 1e-3f32..1e3,
    ) {
        let width = steps * 16;
        let stride = steps * 16 + 5;
        let source: Vec<f32> = ramp(rows * stride, 3)
            .iter()
            .map(|value| value * scale)
            .collect();
        for simd in Simd::all() {
            for format in Format::ALL
                .into_iter()
                .filter(|format| format.is_available(simd))
            {
                let mut buffer = OperandBuffer::default();
                let left = buffer.pack(simd, format, rows, width, (&source, stride));
                for (at, actual) in unpack(format, left, rows, width).into_iter().enumerate() {
                    let expected = source[at / width * stride + at % width];
                    let step = match format {
                        Format::F32 => 0.0,
                        Format::Bf16 => expected.abs() / 256.0,
                        Format::Int8 => scale / 253.0,
                    };
                    prop_assert!(
                        (actual - expected).abs() <= step,
                        "{format:?}: {actual} for {expected}"
                    );
                }
            }
        }
    }
}

proptest! {
    #[test]
    fn codes_are_those_of_what_the_channels_make_of_a_value(
        rows in 1usize..4,
        steps in 1usize..5,
        seed in 0u32..99,
    ) {
        let width = steps * 16;
        let source = ramp(rows * width, seed);
        let gain = ramp(width, seed + 1);
        let shift = ramp(width, seed + 2);
        let scaled: Vec<f32> = source
            .iter()
            .enumerate()
            .map(|(at, value)| value * gain[at % width] + shift[at % width])
            .collect();
        for simd in Simd::all() {
            let mut ours = OperandBuffer::default();
            let mut plain = OperandBuffer::default();
            let channels = ChannelScaling {
                gain: &gain,
                shift: &shift,
            };
            let ours =
                ours.pack_scaled(simd, Format::Int8, rows, width, (&source, width), channels);
            let plain = plain.pack(simd, Format::Int8, rows, width, (&scaled, width));
            prop_assert_eq!(
                (ours.rows.data, ours.factors),
                (plain.rows.data, plain.factors)
            );
        }
    }
}

#[test]
#[should_panic(expected = "every column needs its gain and shift")]
fn channels_that_are_too_few_are_refused() {
    let channels = ChannelScaling {
        gain: &[1.0; 16],
        shift: &[0.0; 15],
    };
    OperandBuffer::default().pack_scaled(
        Simd::SCALAR,
        Format::Int8,
        1,
        16,
        (&[1.0; 16], 16),
        channels,
    );
}

#[test]
fn rows_of_zeros_and_of_no_numbers_are_packed_as_such() {
    for simd in Simd::all().filter(|&simd| Format::Int8.is_available(simd)) {
        let mut buffer = OperandBuffer::default();
        let left = buffer.pack(simd, Format::Int8, 1, 16, (&[0.0; 16], 16));
        assert_eq!(unpack(Format::Int8, left, 1, 16), [0.0; 16]);
    }
    for simd in Simd::all().filter(|&simd| Format::Bf16.is_available(simd)) {
        let mut nan = OperandBuffer::default();
        let left = nan.pack(simd, Format::Bf16, 1, 16, (&[f32::NAN; 16], 16));
        assert!(
            unpack(Format::Bf16, left, 1, 16)
                .iter()
                .all(|value| value.is_nan())
        );
    }
}

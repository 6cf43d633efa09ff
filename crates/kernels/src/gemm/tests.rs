//! Every level against the scalar reference, at odd sizes.

use super::check::compare_with_plain_sums;
use super::*;
use crate::operand::OperandBuffer;
use crate::testing::ramp;
use proptest::prelude::*;

proptest! {
    #[test]
    fn equals_the_plain_sum(
        steps in 1usize..7,
        n in 1usize..70,
        tiles in 1usize..4,
        slice in 1usize..4,
    ) {
        for simd in Simd::all() {
            for format in Format::ALL
                .into_iter()
                .filter(|format| format.is_available(simd))
            {
                let compared =
                    compare_with_plain_sums(simd, format, tiles, (16 * steps, n), 16 * slice);
                prop_assert_eq!(compared, Ok(()));
            }
        }
    }

    #[test]
    fn sums_of_integers_equal_the_scalar_references_bit_for_bit(
        steps in 1usize..9,
        seed in 0u32..1000,
    ) {
        // Whole tiles of every level.
        const ROWS: usize = 48;
        let k = 16 * steps;
        let left = ramp(ROWS * k, seed);
        let right = ramp(k * 8, seed + 1);
        let run = |simd: Simd| {
            let tile = Tiling::of(simd);
            let mut buffer = OperandBuffer::default();
            let matrix = PackedMatrix::pack(simd, Format::Int8, (k, 8), k, |row, column| {
                right[row * 8 + column]
            });
            let packed = buffer.pack(simd, Format::Int8, ROWS, k, (&left, k));
            let mut out = vec![0.0; ROWS * tile.columns];
            multiply_panel(
                simd,
                Format::Int8,
                ROWS,
                packed.rows,
                matrix.panel(0, 0),
                &mut out,
                tile.columns,
            );
            (0..ROWS * 8)
                .map(|at| out[at / 8 * tile.columns + at % 8].to_bits())
                .collect::<Vec<_>>()
        };
        for simd in Simd::all() {
            prop_assert_eq!(run(simd), run(Simd::SCALAR));
        }
    }

    #[test]
    fn segments_give_bit_for_bit_what_one_piece_gives(k in 1usize..60, segment_rows in 1usize..20) {
        for simd in Simd::all() {
            let tile = Tiling::of(simd);
            let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            let left = ramp(tile.rows * k, 3);
            let right = bits(ramp(k * tile.columns, 4));
            let segment_stride = segment_rows * tile.columns + 5;
            let mut scattered = vec![f32::NAN.to_bits(); k.div_ceil(segment_rows) * segment_stride];
            for row in 0..k {
                let at = row / segment_rows * segment_stride + row % segment_rows * tile.columns;
                scattered[at..at + tile.columns]
                    .copy_from_slice(&right[row * tile.columns..(row + 1) * tile.columns]);
            }
            let run = |panel| {
                let mut out = vec![0.0; tile.rows * tile.columns];
                multiply_panel(
                    simd,
                    Format::F32,
                    tile.rows,
                    WordRows::f32(&left, k),
                    panel,
                    &mut out,
                    tile.columns,
                );
                out
            };
            let panel = RightPanel {
                data: &scattered,
                k,
                segment_rows,
                segment_stride,
            };
            prop_assert_eq!(run(panel), run(RightPanel::whole(&right, k)));
        }
    }
}

#[test]
fn a_product_over_nothing_is_zero() {
    for simd in Simd::all() {
        let tile = Tiling::of(simd);
        for format in Format::ALL
            .into_iter()
            .filter(|format| format.is_available(simd))
        {
            let mut out = vec![7.0; tile.rows * tile.columns];
            let left = WordRows {
                data: &[],
                stride: 0,
            };
            multiply_panel(
                simd,
                format,
                tile.rows,
                left,
                RightPanel::whole(&[], 0),
                &mut out,
                tile.columns,
            );
            assert!(
                out.iter().all(|&sum| sum == 0.0),
                "{format:?}, {}",
                simd.level()
            );
        }
    }
}

#[test]
#[should_panic(expected = "panel too short")]
fn segments_across_each_other_are_refused() {
    let tile = Tiling::of(Simd::SCALAR);
    let data = vec![0; 10 * tile.columns];
    let panel = RightPanel {
        data: &data,
        k: 11,
        segment_rows: 10,
        segment_stride: 0,
    };
    let mut out = vec![0.0; tile.rows * tile.columns];
    let left = vec![0.0; tile.rows * 11];
    multiply_panel(
        Simd::SCALAR,
        Format::F32,
        tile.rows,
        WordRows::f32(&left, 11),
        panel,
        &mut out,
        tile.columns,
    );
}

#[test]
#[should_panic(expected = "panel too short")]
fn a_short_panel_is_refused() {
    let tile = Tiling::of(Simd::SCALAR);
    let left = WordRows::f32(&[0.0; 64], 8);
    let panel = RightPanel::whole(&[0; 9], 8);
    multiply_panel(
        Simd::SCALAR,
        Format::F32,
        tile.rows,
        left,
        panel,
        &mut [0.0; 64],
        8,
    );
}

//! Epilogues, LayerNorm and softmax against definitions and against each other, at every level.

use super::check::{plain, reference_erf};
use super::*;
use crate::gemm::Tiling;
use crate::testing::ramp;
use proptest::prelude::*;

#[test]
fn gelu_is_within_a_millionth_everywhere_and_the_short_one_within_a_ten_thousandth() {
    for simd in Simd::all() {
        let columns = Tiling::of(simd).columns;
        for (epilogue, limit) in [(Epilogue::BiasGelu, 1e-6), (Epilogue::BiasShortGelu, 1e-4)] {
            let worst = (0..4000).step_by(columns).fold(0.0f64, |worst, start| {
                let block: Vec<f32> = (start..start + columns)
                    .map(|i| (i as f32 - 2000.0) / 250.0)
                    .collect();
                let mut out = vec![0.0; columns];
                finish_block(
                    simd,
                    epilogue,
                    plain(1, &block, &vec![0.0; columns]),
                    &mut out,
                    columns,
                );
                let error = |(&x, &y): (&f32, &f32)| {
                    let x = f64::from(x);
                    let expected = 0.5 * x * (1.0 + reference_erf(x / std::f64::consts::SQRT_2));
                    (f64::from(y) - expected).abs() / x.abs().max(1.0)
                };
                block.iter().zip(&out).map(error).fold(worst, f64::max)
            });
            assert!(worst < limit, "{epilogue:?} at {}: {worst:e}", simd.level());
        }
    }
}

#[test]
fn not_a_number_is_passed_on_and_extremes_are_not() {
    for simd in Simd::all() {
        let columns = Tiling::of(simd).columns;
        let mut block = vec![0.0; columns];
        (block[0], block[1], block[2]) = (f32::NAN, 1e30, -1e30);
        let mut out = vec![0.0; columns];
        finish_block(
            simd,
            Epilogue::BiasGelu,
            plain(1, &block, &vec![0.0; columns]),
            &mut out,
            columns,
        );
        assert!(out[0].is_nan(), "{}", out[0]);
        assert!(
            (out[1] / 1e30 - 1.0).abs() < 1e-6 && (out[2] / 1e30).abs() < 1e-6,
            "{:?}",
            &out[1..3]
        );
        let mut scores = vec![1.0; 19];
        scores[3] = f32::NAN;
        let reciprocal = exponentiate_row(simd, Format::F32, &mut scores);
        assert!(reciprocal.is_nan());
        let mut scores = vec![-3e38, 0.0, -200.0];
        assert!((exponentiate_row(simd, Format::F32, &mut scores) - 1.0).abs() < 1e-6);
    }
}

#[test]
fn bf16_weights_are_the_f32_ones_rounded() {
    for simd in Simd::all().filter(|&simd| Format::Bf16.is_available(simd)) {
        for len in [1, 2, 15, 16, 17, 33, 769] {
            let row: Vec<f32> = ramp(len, 9).iter().map(|value| value * 8.0).collect();
            let mut exact = row.clone();
            let mut rounded = row;
            let [of_exact, of_rounded] = [Format::F32, Format::Bf16].map(|format| {
                let scores = if format == Format::F32 {
                    &mut exact
                } else {
                    &mut rounded
                };
                exponentiate_row(simd, format, scores)
            });
            // The shorter polynomial is off by a thousandth of what rounding to eight bits may
            // change.
            assert!(
                (of_exact / of_rounded - 1.0).abs() < 1e-5,
                "{of_exact} and {of_rounded}"
            );
            let words: &[u32] = bytemuck::cast_slice(&rounded);
            for (at, value) in exact.iter().enumerate() {
                let bits = (words[at / 2] >> (16 * (at % 2)) & 0xffff) as u16;
                let error = (half::bf16::from_bits(bits).to_f32() / value - 1.0).abs();
                assert!(error < 1.01 / 256.0, "{at} of {len}: off by {error}");
            }
            assert!(
                len % 2 == 0 || words[len / 2] >> 16 == 0,
                "the lone last weight of {len} has a neighbour"
            );
        }
    }
}

proptest! {
    #[test]
    fn every_level_agrees_with_the_scalar_reference(
        len in 1usize..200,
        seed in 0u32..1000,
        scale in 0.1f32..40.0,
    ) {
        let row: Vec<f32> = ramp(len, seed).iter().map(|value| value * scale).collect();
        let run = |simd| {
            let mut normed = vec![0.0; len];
            let mut scores = row.clone();
            normalize_rows(simd, len, 1e-6, &row, &mut normed);
            let reciprocal = exponentiate_row(simd, Format::F32, &mut scores);
            scale_rows(&[reciprocal], len, &mut scores, len);
            (normed, scores)
        };
        let expected = run(Simd::SCALAR);
        for simd in Simd::all() {
            let actual = run(simd);
            for index in 0..len {
                prop_assert!((actual.0[index] - expected.0[index]).abs() < 1e-4);
                prop_assert!((actual.1[index] - expected.1[index]).abs() < 1e-6);
            }
        }
        prop_assert!((expected.1.iter().sum::<f32>() - 1.0).abs() < 1e-4);
    }
}

#[test]
#[should_panic(expected = "rows of the result overlap")]
fn rows_across_each_other_are_refused() {
    let columns = Tiling::of(Simd::SCALAR).columns;
    let block = vec![0.0; 2 * columns];
    let bias = vec![0.0; columns];
    let product = check::plain(2, &block, &bias);
    let mut out = vec![0.0; 2 * columns];
    finish_block(Simd::SCALAR, Epilogue::Bias, product, &mut out, columns - 1);
}

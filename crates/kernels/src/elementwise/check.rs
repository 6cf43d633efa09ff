//! The self-check: LayerNorm, softmax and the epilogues against their definitions in f64.

use super::{Epilogue, Product, exponentiate_row, finish_block, finish_words, normalize_rows};
use crate::Simd;
use crate::gemm::Tiling;
use crate::operand::Format;
use crate::testing::{differ, ramp};

/// Compares a level with the definitions, on odd sizes.
pub(crate) fn check(simd: Simd) -> Result<(), String> {
    for len in [1, 7, 16, 45] {
        let row: Vec<f32> = ramp(len, 5).iter().map(|value| value * 30.0).collect();
        check_layer_norm(simd, &row)?;
        check_softmax(simd, &row)?;
    }
    check_epilogues(simd)
}

fn check_layer_norm(simd: Simd, row: &[f32]) -> Result<(), String> {
    let len = row.len();
    let mut normed = vec![0.0; len];
    normalize_rows(simd, len, 1e-6, row, &mut normed);
    let sum: f64 = row.iter().map(|&x| f64::from(x)).sum();
    let mean = sum / len as f64;
    let squares: f64 = row.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum();
    let variance = squares / len as f64;
    for (&x, &actual) in row.iter().zip(&normed) {
        let expected = (f64::from(x) - mean) / (variance + 1e-6).sqrt();
        if differ(actual, expected, 1e-4) {
            return Err(format!("LayerNorm of {len}: {actual} is not {expected}"));
        }
    }
    Ok(())
}

fn check_softmax(simd: Simd, row: &[f32]) -> Result<(), String> {
    let len = row.len();
    let mut scores = row.to_vec();
    let reciprocal = exponentiate_row(simd, Format::F32, &mut scores);
    let highest = row.iter().copied().fold(f32::MIN, f32::max);
    let total: f64 = row.iter().map(|&x| f64::from(x - highest).exp2()).sum();
    for (&x, &score) in row.iter().zip(&scores) {
        let actual = score * reciprocal;
        let expected = f64::from(x - highest).exp2() / total;
        if differ(actual, expected, 1e-6) {
            return Err(format!("softmax of {len}: {actual} is not {expected}"));
        }
    }
    Ok(())
}

fn check_epilogues(simd: Simd) -> Result<(), String> {
    let columns = Tiling::of(simd).columns;
    let rows = 5;
    let block: Vec<f32> = ramp(rows * columns, 6)
        .iter()
        .map(|value| value * 6.0)
        .collect();
    let bias = ramp(columns, 7);
    let before = ramp(rows * (columns + 3), 8);
    for epilogue in Epilogue::ALL {
        let mut out = before.clone();
        finish_block(
            simd,
            epilogue,
            plain(rows, &block, &bias),
            &mut out,
            columns + 3,
        );
        for (index, &actual) in out.iter().enumerate() {
            let row = index / (columns + 3);
            let column = index % (columns + 3);
            let expected = if column >= columns {
                f64::from(before[index])
            } else {
                let value = f64::from(block[row * columns + column] + bias[column]);
                match epilogue {
                    Epilogue::Bias => value,
                    Epilogue::BiasGelu | Epilogue::BiasShortGelu => {
                        0.5 * value * (1.0 + reference_erf(value / std::f64::consts::SQRT_2))
                    }
                    Epilogue::BiasResidual => value + f64::from(before[index]),
                }
            };
            let tolerance = if epilogue == Epilogue::BiasShortGelu {
                1e-4
            } else {
                4e-6
            };
            if differ(actual, expected, tolerance) {
                return Err(format!(
                    "{epilogue:?} at row {row}, column {column}: {actual} is not {expected}"
                ));
            }
        }
    }
    if Format::Bf16.is_available(simd) {
        check_rounded_epilogues(simd, &block, rows)
    } else {
        Ok(())
    }
}

/// Epilogues that end in bf16 against those in f32, rounded here; rows lie apart, and what is
/// between them must stay.
fn check_rounded_epilogues(simd: Simd, block: &[f32], rows: usize) -> Result<(), String> {
    let columns = Tiling::of(simd).columns;
    let exact_stride = columns + 3;
    let stride = columns / 2 + 3;
    let untouched = 7;
    for epilogue in Epilogue::ALL
        .into_iter()
        .filter(|&epilogue| epilogue != Epilogue::BiasResidual)
    {
        let mut exact = vec![0.0; rows * exact_stride];
        let mut rounded = vec![untouched; rows * stride];
        finish_block(
            simd,
            epilogue,
            plain(rows, block, block),
            &mut exact,
            exact_stride,
        );
        finish_words(
            simd,
            Format::Bf16,
            epilogue,
            plain(rows, block, block),
            &mut rounded,
            stride,
        );
        for (at, &word) in rounded.iter().enumerate() {
            let row = at / stride;
            let column = 2 * (at % stride);
            let bits = |column: usize| {
                u32::from(half::bf16::from_f32(exact[row * exact_stride + column]).to_bits())
            };
            let expected = if column < columns {
                bits(column) | bits(column + 1) << 16
            } else {
                untouched
            };
            if word != expected {
                return Err(format!(
                    "{epilogue:?} in bf16 at row {row}, column {column}: \
                     {word:x} is not {expected:x}"
                ));
            }
        }
    }
    Ok(())
}

pub(super) fn plain<'a>(rows: usize, block: &'a [f32], bias: &'a [f32]) -> Product<'a> {
    Product {
        rows,
        block,
        codes: None,
        factors: &[],
        bias: Some(bias),
    }
}

/// erf by its Maclaurin series, whose terms f64 can hold up to about 5.
pub(super) fn reference_erf(x: f64) -> f64 {
    if x.abs() > 5.0 {
        return x.signum();
    }
    let mut term = x;
    let mut sum = x;
    for n in 1..120 {
        term *= -x * x / f64::from(n);
        sum += term / f64::from(2 * n + 1);
    }
    sum * std::f64::consts::FRAC_2_SQRT_PI
}

//! The self-check: products against plain sums.

use super::{PackedMatrix, Tiling, multiply_panel};
use crate::Simd;
use crate::elementwise::{Epilogue, Product, finish_block};
use crate::operand::{Format, OperandBuffer};
use crate::testing::{differ, ramp};

/// Compares products with plain sums on small odd sizes, in every format of the level.
pub(crate) fn check(simd: Simd) -> Result<(), String> {
    for format in Format::ALL
        .into_iter()
        .filter(|format| format.is_available(simd))
    {
        for (k, n, slice) in [(16, 1, 16), (48, 37, 32), (64, 64, 64)] {
            compare_with_plain_sums(simd, format, 2, (k, n), slice)?;
        }
    }
    Ok(())
}

/// Multiplies as the transformer does, slice by slice through the epilogue, and compares the result
/// with sums in f64. Rows of the left-hand side are `tiles` tiles and a step.
pub(super) fn compare_with_plain_sums(
    simd: Simd,
    format: Format,
    tiles: usize,
    (k, n): (usize, usize),
    slice: usize,
) -> Result<(), String> {
    let tile = Tiling::of(simd);
    let stride = k + 3;
    let rows = tiles * tile.rows + tile.row_step;
    let left = ramp(rows * stride, 1);
    let right = ramp(k * n, 2);
    let element = |row: usize, column: usize| right[row * n + column];
    let matrix = PackedMatrix::pack(simd, format, (k, n), slice, element);
    // A code is off by up to half a step. Errors have either sign, so over a sum of k products they
    // grow with the square root of k.
    let tolerance = match format {
        Format::F32 => 1e-4,
        Format::Bf16 => 4e-3 * (k as f64).sqrt() + 1e-3,
        Format::Int8 => 1e-2 * (k as f64).sqrt() + 1e-3,
    };

    for panel in 0..matrix.panels() {
        let out = multiply_by_slices(simd, &matrix, panel, slice, (&left, stride, k), rows);
        for (at, &actual) in out.iter().enumerate() {
            let row = at / tile.columns;
            let column = panel * tile.columns + at % tile.columns;
            let mut expected = START + f64::from(BIAS);
            if column < n {
                let row = left[row * stride..][..k].iter();
                let products = row
                    .enumerate()
                    .map(|(i, &value)| f64::from(value) * f64::from(right[i * n + column]));
                expected += products.sum::<f64>();
            }
            if differ(actual, expected, tolerance) {
                return Err(format!(
                    "{format:?}, k {k}, n {n}, row {row}, column {column}: \
                     {actual} is not {expected}"
                ));
            }
        }
    }
    Ok(())
}

/// What the result holds before the product is added.
const START: f64 = 0.5;

/// What is added to every column.
const BIAS: f32 = 0.25;

/// `START + BIAS + left * panel`, `[rows, columns]`, where `left` is `(values, stride, k)`.
fn multiply_by_slices(
    simd: Simd,
    matrix: &PackedMatrix,
    panel: usize,
    slice: usize,
    (left, stride, k): (&[f32], usize, usize),
    rows: usize,
) -> Vec<f32> {
    let columns = Tiling::of(simd).columns;
    let format = matrix.format();
    let bias = vec![BIAS; columns];
    let mut out = vec![START as f32; rows * columns];
    for (index, from) in (0..k).step_by(slice).enumerate() {
        let mut buffer = OperandBuffer::default();
        let width = slice.min(k - from);
        let packed = buffer.pack(simd, format, rows, width, (&left[from..], stride));
        let mut block = vec![f32::NAN; rows * columns];
        let right = matrix.panel(panel, index);
        multiply_panel(simd, format, rows, packed.rows, right, &mut block, columns);
        let product = Product {
            rows,
            block: &block,
            codes: matrix.codes(panel, index),
            factors: packed.factors,
            bias: if index == 0 { Some(&bias) } else { None },
        };
        finish_block(simd, Epilogue::BiasResidual, product, &mut out, columns);
    }
    out
}

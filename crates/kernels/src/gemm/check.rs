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

/// Multiplies as the transformer does, slice by slice through the epilogue, and compares with f64
/// sums over what both sides hold.
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
    let matrix = PackedMatrix::pack(simd, format, (k, n), slice, |row, column| {
        right[row * n + column]
    });
    let bias = vec![0.25; tile.columns];
    // A code is off by up to half a step. Errors have either sign, so over a sum of k products they
    // grow with the square root of k.
    let tolerance = match format {
        Format::F32 => 1e-4,
        Format::Bf16 => 4e-3 * (k as f64).sqrt() + 1e-3,
        Format::Int8 => 1e-2 * (k as f64).sqrt() + 1e-3,
    };
    for panel in 0..matrix.panels() {
        let mut out = vec![0.5f32; rows * tile.columns];
        for (index, from) in (0..k).step_by(slice).enumerate() {
            let mut buffer = OperandBuffer::default();
            let width = slice.min(k - from);
            let packed = buffer.pack(simd, format, rows, width, (&left[from..], stride));
            let mut block = vec![f32::NAN; rows * tile.columns];
            multiply_panel(
                simd,
                format,
                rows,
                packed.rows,
                matrix.panel(panel, index),
                &mut block,
                tile.columns,
            );
            let bias = if index == 0 { Some(&bias[..]) } else { None };
            let product = Product {
                rows,
                block: &block,
                codes: matrix.codes(panel, index),
                factors: packed.factors,
                bias,
            };
            finish_block(
                simd,
                Epilogue::BiasResidual,
                product,
                &mut out,
                tile.columns,
            );
        }
        for (at, &actual) in out.iter().enumerate() {
            let (row, column) = (at / tile.columns, panel * tile.columns + at % tile.columns);
            let term =
                |i: usize| f64::from(left[row * stride + i]) * f64::from(right[i * n + column]);
            let expected = 0.75
                + if column < n {
                    (0..k).map(term).sum::<f64>()
                } else {
                    0.0
                };
            if differ(actual, expected, tolerance) {
                return Err(format!(
                    "{format:?}, k {k}, n {n}, row {row}, column {column}: {actual} is not {expected}"
                ));
            }
        }
    }
    Ok(())
}

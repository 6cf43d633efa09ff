//! Linear layers, and sums and products of all rows with one: biases and LayerScale.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

use super::contiguous;

/// x W^T + b over the last dimension; `weight` is `[out, in]`.
pub(crate) fn linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let mut shape = x.dims().to_vec();
    let input = shape.pop().unwrap_or_default();
    let rows = x.reshape((x.elem_count() / input.max(1), input))?;
    shape.push(bias.elem_count());
    add_row(&rows.matmul(&weight.t()?)?, bias)?.reshape(shape)
}

/// Adds `row` to every row of the last dimension of `x`. Both must be contiguous.
pub(crate) fn add_row(x: &Tensor, row: &Tensor) -> Result<Tensor> {
    x.apply_op2(row, AddRow)
}

/// Multiplies every row of the last dimension of `x` by `row`. Both must be contiguous.
pub(crate) fn multiply_row(x: &Tensor, row: &Tensor) -> Result<Tensor> {
    x.apply_op2(row, MultiplyRow)
}

struct AddRow;
struct MultiplyRow;

impl CustomOp2 for AddRow {
    fn name(&self) -> &'static str {
        "add-row"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        row: &CpuStorage,
        row_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let row = contiguous(row, row_layout)?;
        let out = each_row(contiguous(x, x_layout)?, row, |value, other| value + other);
        Ok((CpuStorage::F32(out), x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        _x: &Tensor,
        row: &Tensor,
        _result: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let of_row = sum_of_rows(gradient, row)?;
        Ok((Some(gradient.clone()), Some(of_row)))
    }
}

impl CustomOp2 for MultiplyRow {
    fn name(&self) -> &'static str {
        "multiply-row"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        row: &CpuStorage,
        row_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let row = contiguous(row, row_layout)?;
        let out = each_row(contiguous(x, x_layout)?, row, |value, other| value * other);
        Ok((CpuStorage::F32(out), x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        row: &Tensor,
        _result: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let of_x = gradient.contiguous()?.apply_op2_no_bwd(row, &Self)?;
        let of_row = sum_of_rows(&(x * gradient)?, row)?;
        Ok((Some(of_x), Some(of_row)))
    }
}

fn each_row(values: &[f32], row: &[f32], combine: impl Fn(f32, f32) -> f32) -> Vec<f32> {
    let mut out = Vec::with_capacity(values.len());
    for values in values.chunks_exact(row.len().max(1)) {
        out.extend(
            values
                .iter()
                .zip(row)
                .map(|(&value, &other)| combine(value, other)),
        );
    }
    out
}

/// The sum over all rows, in the shape of `row`: a product with a row of ones, because products are
/// fast and candle's sums over outer dimensions are not.
fn sum_of_rows(rows: &Tensor, row: &Tensor) -> Result<Tensor> {
    let width = row.elem_count().max(1);
    let count = rows.elem_count() / width;
    let ones = Tensor::ones((1, count), rows.dtype(), rows.device())?;
    ones.matmul(&rows.reshape((count, width))?)?
        .reshape(row.shape())
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check_gradient, some};
    use super::*;

    #[test]
    fn sums_and_products_go_over_all_rows() {
        let x = some(&[2, 3, 4]);
        let row = some(&[4]);
        let same = |a: Tensor, b: Tensor| {
            let difference = (a - b).unwrap().abs().unwrap().max_all().unwrap();
            assert!(difference.to_scalar::<f32>().unwrap() < 1e-6);
        };
        same(add_row(&x, &row).unwrap(), x.broadcast_add(&row).unwrap());
        same(
            multiply_row(&x, &row).unwrap(),
            x.broadcast_mul(&row).unwrap(),
        );
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let x = some(&[2, 3, 4]);
        let row = some(&[4]);
        check_gradient(&x, |x| add_row(x, &row));
        check_gradient(&row, |row| add_row(&x, row));
        check_gradient(&x, |x| multiply_row(x, &row));
        check_gradient(&row, |row| multiply_row(&x, row));
        let weight = some(&[5, 4]);
        let bias = some(&[5]);
        check_gradient(&x, |x| linear(x, &weight, &bias));
        check_gradient(&weight, |weight| linear(&x, weight, &bias));
        check_gradient(&bias, |bias| linear(&x, &weight, bias));
    }
}

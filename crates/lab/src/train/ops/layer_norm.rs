//! LayerNorm over the last dimension.

use super::rows::{add_row, multiply_row};
use super::{contiguous, map_values};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use placeformer_vision::extract::LAYER_NORM_EPS;

/// Rows of the last dimension with mean zero and variance one, times `weight`, plus `bias`. `x`
/// must be contiguous.
pub(crate) fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    add_row(&multiply_row(&x.apply_op1(Normalise)?, weight)?, bias)
}

/// Rows with mean zero and variance one.
struct Normalise;

/// Mean, and one by the deviation.
fn moments(row: &[f32]) -> (f32, f32) {
    let count = row.len() as f64;
    let mean = row.iter().map(|&value| f64::from(value)).sum::<f64>() / count;
    let squares = row.iter().map(|&value| (f64::from(value) - mean).powi(2));
    let variance = squares.sum::<f64>() / count;
    let inverse = 1.0 / (variance + f64::from(LAYER_NORM_EPS)).sqrt();
    (mean as f32, inverse as f32)
}

impl CustomOp1 for Normalise {
    fn name(&self) -> &'static str {
        "normalise"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let values = contiguous(storage, layout)?;
        let width = layout.dims().last().copied().unwrap_or(1).max(1);
        let mut out = Vec::with_capacity(values.len());
        for row in values.chunks_exact(width) {
            let (mean, inverse) = moments(row);
            out.extend(row.iter().map(|&value| (value - mean) * inverse));
        }
        Ok((CpuStorage::F32(out), layout.shape().clone()))
    }

    /// With y the result and g its gradient: (g - mean(g) - y mean(g y)) by the deviation.
    fn bwd(&self, x: &Tensor, result: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let width = x.dims().last().copied().unwrap_or(1).max(1);
        let of_x = map_values([x, result, gradient], |[x, result, gradient]| {
            let mut out = Vec::with_capacity(x.len());
            let rows = x.chunks_exact(width).zip(result.chunks_exact(width));
            for ((x, y), g) in rows.zip(gradient.chunks_exact(width)) {
                let (_, inverse) = moments(x);
                let mean = g.iter().map(|&g| f64::from(g)).sum::<f64>() / width as f64;
                let products = g.iter().zip(y).map(|(&g, &y)| f64::from(g) * f64::from(y));
                let along = (products.sum::<f64>() / width as f64) as f32;
                let mean = mean as f32;
                out.extend(
                    g.iter()
                        .zip(y)
                        .map(|(g, y)| (g - mean - y * along) * inverse),
                );
            }
            out
        })?;
        Ok(Some(of_x))
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check_gradient, some};
    use super::*;

    #[test]
    fn it_is_candles_layer_norm() {
        let x = (some(&[2, 5, 24]) * 7.0).unwrap();
        let weight = some(&[24]);
        let bias = (some(&[24]) * 0.5).unwrap();
        let expected = candle_nn::ops::layer_norm_slow(&x, &weight, &bias, LAYER_NORM_EPS).unwrap();
        let difference = (layer_norm(&x, &weight, &bias).unwrap() - expected).unwrap();
        let worst: f32 = difference
            .abs()
            .unwrap()
            .max_all()
            .unwrap()
            .to_scalar()
            .unwrap();
        assert!(worst < 2e-5, "{worst}");
    }

    #[test]
    fn gradients_of_all_three_agree_with_finite_differences() {
        let x = some(&[3, 10]);
        let weight = (some(&[10]) + 1.5).unwrap();
        let bias = some(&[10]);
        check_gradient(&x, |x| layer_norm(x, &weight, &bias));
        check_gradient(&weight, |weight| layer_norm(&x, weight, &bias));
        check_gradient(&bias, |bias| layer_norm(&x, &weight, bias));
    }
}

//! Softmax over the last dimension.

use super::exponential::exponential;
use super::{contiguous, map_values};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

/// Softmax of `x`, which must be contiguous, over its last dimension.
pub(crate) fn softmax(x: &Tensor) -> Result<Tensor> {
    x.apply_op1(Softmax)
}

struct Softmax;

impl CustomOp1 for Softmax {
    fn name(&self) -> &'static str {
        "softmax"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let values = contiguous(storage, layout)?;
        let width = last(layout.dims());
        let mut out = Vec::with_capacity(values.len());
        for row in values.chunks_exact(width) {
            let largest = row.iter().fold(f32::NEG_INFINITY, |a, &b| a.max(b));
            let start = out.len();
            out.extend(row.iter().map(|&value| exponential(value - largest)));
            let row = &mut out[start..];
            let factor = 1.0 / sum(row);
            row.iter_mut().for_each(|value| *value *= factor);
        }
        Ok((CpuStorage::F32(out), layout.shape().clone()))
    }

    /// With p the result and g its gradient: p (g - sum(p g)).
    fn bwd(&self, x: &Tensor, result: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let width = last(x.dims());
        let of_x = map_values([result, gradient], |[result, gradient]| {
            let mut out = Vec::with_capacity(result.len());
            let rows = result.chunks_exact(width).zip(gradient.chunks_exact(width));
            for (result, gradient) in rows {
                let mean = dot(result, gradient);
                let of_row = result.iter().zip(gradient).map(|(p, g)| p * (g - mean));
                out.extend(of_row);
            }
            out
        })?;
        Ok(Some(of_x))
    }
}

fn last(dims: &[usize]) -> usize {
    dims.last().copied().unwrap_or(1).max(1)
}

/// Sums kept apart, so that additions need not wait for each other.
const LANES: usize = 16;

fn sum(values: &[f32]) -> f32 {
    let mut sums = [0f32; LANES];
    let (whole, rest) = values.as_chunks::<LANES>();
    for chunk in whole {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            *sum += value;
        }
    }
    sums.iter().sum::<f32>() + rest.iter().sum::<f32>()
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0f32; LANES];
    let (whole_a, rest_a) = a.as_chunks::<LANES>();
    let (whole_b, rest_b) = b.as_chunks::<LANES>();
    for (a, b) in whole_a.iter().zip(whole_b) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    let rest: f32 = rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use super::super::testing::{check_gradient, some};
    use super::*;
    use candle_core::D;

    #[test]
    fn it_is_candles_softmax() {
        let x = (some(&[2, 3, 37]) * 20.0).unwrap();
        let expected = candle_nn::ops::softmax(&x, D::Minus1).unwrap();
        let difference = (softmax(&x).unwrap() - expected).unwrap().abs().unwrap();
        let worst: f32 = difference.max_all().unwrap().to_scalar().unwrap();
        assert!(worst < 1e-6, "{worst}");
    }

    #[test]
    fn its_gradient_agrees_with_finite_differences() {
        check_gradient(&some(&[3, 21]), softmax);
    }
}

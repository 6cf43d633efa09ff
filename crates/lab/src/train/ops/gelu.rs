//! GELU with the exact error function.

use super::exponential::exponential;
use super::{contiguous, map_values};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use placeformer_vision::extract::gelu as gelu_in_place;

/// x Phi(x) of every value of `x`, which must be contiguous.
pub(crate) fn gelu(x: &Tensor) -> Result<Tensor> {
    x.apply_op1(Gelu)
}

struct Gelu;

impl CustomOp1 for Gelu {
    fn name(&self) -> &'static str {
        "gelu"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let mut values = contiguous(storage, layout)?.to_vec();
        gelu_in_place(&mut values);
        Ok((CpuStorage::F32(values), layout.shape().clone()))
    }

    /// The derivative is Phi(x) + x phi(x), with the normal distribution's Phi and density phi.
    fn bwd(&self, x: &Tensor, result: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let of_x = map_values([x, result, gradient], |[x, result, gradient]| {
            let density = std::f32::consts::FRAC_2_SQRT_PI * std::f32::consts::FRAC_1_SQRT_2 * 0.5;
            let mut out = Vec::with_capacity(x.len());
            for ((&x, &result), &gradient) in x.iter().zip(result).zip(gradient) {
                // Phi(x) is the result by x; near zero it is one half, and the quotient is rounding
                // noise.
                let cumulative = if x.abs() > 1e-3 {
                    result / x
                } else {
                    0.5 + x * density
                };
                let slope = cumulative + x * density * exponential(-0.5 * x * x);
                out.push(gradient * slope);
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
    fn it_is_candles_exact_gelu() {
        let x = (some(&[5, 40]) * 4.0).unwrap();
        let difference = (gelu(&x).unwrap() - x.gelu_erf().unwrap()).unwrap();
        let worst: f32 = difference
            .abs()
            .unwrap()
            .max_all()
            .unwrap()
            .to_scalar()
            .unwrap();
        assert!(worst < 3e-6, "{worst}");
    }

    #[test]
    fn its_gradient_agrees_with_finite_differences() {
        check_gradient(&(some(&[4, 9]) * 3.0).unwrap(), gelu);
        let zero = Tensor::zeros((1, 3), candle_core::DType::F32, &candle_core::Device::Cpu);
        check_gradient(&zero.unwrap(), gelu);
    }
}

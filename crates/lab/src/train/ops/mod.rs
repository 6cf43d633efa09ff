//! The operations of a transformer that candle does slowly on a CPU, each with its gradient.
//!
//! Candle builds softmax and LayerNorm out of half a dozen passes over memory, computes GELU value
//! by value, and sums the gradient of a bias element by element. Together these would take longer
//! than the matrix products. Each is one pass here, in plain loops that the compiler turns into
//! vector code. Candle still keeps the graph and multiplies the matrices.

mod exponential;
mod gelu;
mod layer_norm;
mod rows;
mod softmax;
#[cfg(test)]
mod testing;

pub(super) use gelu::gelu;
pub(super) use layer_norm::layer_norm;
pub(super) use rows::{linear, multiply_row};
pub(super) use softmax::softmax;
#[cfg(test)]
pub(super) use testing::{check_gradient, some};

use candle_core::{CpuStorage, Layout, Result, Storage, Tensor};

/// The values of contiguous 32-bit floats in storage.
fn contiguous<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(values), Some((start, end))) => Ok(&values[start..end]),
        _ => candle_core::bail!("this operation takes contiguous 32-bit floats"),
    }
}

/// Calls `compute` with the values of some tensors; their result has the shape of the first.
fn map_values<const N: usize>(
    tensors: [&Tensor; N],
    compute: impl FnOnce([&[f32]; N]) -> Vec<f32>,
) -> Result<Tensor> {
    let contiguous_ones: Vec<Tensor> = tensors
        .iter()
        .map(|tensor| tensor.detach().contiguous())
        .collect::<Result<_>>()?;
    let guards: Vec<_> = contiguous_ones
        .iter()
        .map(Tensor::storage_and_layout)
        .collect();
    let mut slices: [&[f32]; N] = [&[]; N];
    for (slice, (storage, layout)) in slices.iter_mut().zip(&guards) {
        let Storage::Cpu(storage) = &**storage else {
            candle_core::bail!("this operation runs on a CPU")
        };
        *slice = contiguous(storage, layout)?;
    }
    let values = compute(slices);
    Tensor::from_vec(values, tensors[0].shape(), tensors[0].device())
}

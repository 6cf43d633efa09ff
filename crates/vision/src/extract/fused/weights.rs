//! The weights of a transformer, packed once as the fused encoder multiplies by them, with
//! everything that is linear folded in.
//!
//! - The scale g and shift s of a LayerNorm go into the layer that reads it: W diag(g), b + W s.
//! - LayerScale l goes into the layer that it scales: diag(l) W, diag(l) b.
//! - The query rows get the factor log2(e) / sqrt(head_dim), so that softmax can take powers of two
//!   of the scores as they are.
//! - The bias of the keys adds the same number to all scores of a query, and softmax removes it
//!   again. It is left out, which also keeps the keys small, and so their rounding error.
//! - Inputs that become int8 codes are centred and scaled by channel first
//!   ([`super::smoothing`]); W and b undo that.
//!
//! The sums for this are taken in f64. At run time only products and biases are left.

use super::smoothing::{BlockSmoothing, Smoothing};
use crate::extract::preset::Geometry;
use crate::extract::weights::{BlockWeights, Linear, Norm};
use placeformer_kernels::Simd;
use placeformer_kernels::gemm::{PackedMatrix, Tiling};
use placeformer_kernels::operand::{ChannelScaling, Format};
use std::ops::Range;

/// A linear layer, packed.
pub(super) struct PackedLinear {
    /// W transposed, `[in, out]`.
    pub weight: PackedMatrix,
    /// b, followed by zeros up to a whole panel.
    bias: Vec<f32>,
    /// Factor of each input before it becomes a code, `[in]`; empty where inputs are taken as they
    /// are.
    gain: Vec<f32>,
    /// Added to each input after that, `[in]` or empty.
    shift: Vec<f32>,
}

/// For which instructions a layer is packed, and how.
#[derive(Debug, Clone, Copy)]
struct Packing {
    simd: Simd,
    format: Format,
    /// Inputs that are multiplied at a time; more than the layer has stands for all.
    slice: usize,
}

impl Packing {
    /// The same for a layer that is multiplied over all its inputs at once.
    fn whole(simd: Simd, format: Format) -> Self {
        Self {
            simd,
            format,
            slice: usize::MAX,
        }
    }
}

impl PackedLinear {
    /// Packs y = W x + b as it is, in f32.
    pub fn plain(simd: Simd, layer: &Linear) -> Self {
        Self::pack(Packing::whole(simd, Format::F32), layer, |_| 1.0, None)
    }

    /// Packs `y = diag(output_scale) (W (input_norm(x)) + b)`, where `input_norm` multiplies each
    /// input by its weight and adds its bias. Without an `input_norm`, x is taken as it is.
    fn pack(
        packing: Packing,
        layer: &Linear,
        output_scale: impl Fn(usize) -> f32,
        input_norm: Option<&Norm>,
    ) -> Self {
        let outputs = layer.bias.len();
        let inputs = layer.weight.len() / outputs;

        let input_scale = |input: usize| input_norm.map_or(1.0, |norm| norm.weight[input]);
        let element = |input: usize, output: usize| {
            let scale = output_scale(output) * input_scale(input);
            layer.weight[output * inputs + input] * scale
        };
        let weight = PackedMatrix::pack(
            packing.simd,
            packing.format,
            (inputs, outputs),
            packing.slice.min(inputs),
            element,
        );

        let bias_of = |output: usize| {
            let row = &layer.weight[output * inputs..(output + 1) * inputs];
            let shifted = input_norm.map_or(0.0, |norm| dot(row, &norm.bias));
            let bias = f64::from(layer.bias[output]) + shifted;
            (bias * f64::from(output_scale(output))) as f32
        };
        let padded = outputs.next_multiple_of(Tiling::of(packing.simd).columns);
        let mut bias: Vec<f32> = (0..outputs).map(bias_of).collect();
        bias.resize(padded, 0.0);
        Self {
            weight,
            bias,
            gain: Vec::new(),
            shift: Vec::new(),
        }
    }

    /// Packs a layer whose inputs become int8 codes if there is a `smoothing` for them.
    ///
    /// The inputs arrive without the scale and shift of `norm`, the LayerNorm before the layer (if
    /// there is one). With smoothing these are applied to the inputs just before they become codes;
    /// without, they are folded into W and b.
    fn pack_smoothed(
        packing: Packing,
        layer: &Linear,
        output_scale: impl Fn(usize) -> f32,
        norm: Option<&Norm>,
        smoothing: Option<&Smoothing>,
    ) -> Self {
        let Some(smoothing) = smoothing else {
            return Self::pack(packing, layer, output_scale, norm);
        };
        let mut packed = Self::pack(packing, layer, output_scale, Some(&smoothing.inverse()));
        for (input, (centre, scale)) in smoothing.channels().enumerate() {
            let norm_scale = norm.map_or(1.0, |norm| norm.weight[input]);
            let norm_shift = norm.map_or(0.0, |norm| norm.bias[input]);
            packed.gain.push(norm_scale / scale);
            packed.shift.push((norm_shift - centre) / scale);
        }
        packed
    }

    /// How the inputs in `range` are scaled and shifted before they become codes.
    pub fn channels(&self, range: Range<usize>) -> ChannelScaling<'_> {
        if self.gain.is_empty() {
            return ChannelScaling::default();
        }
        ChannelScaling {
            gain: &self.gain[range.clone()],
            shift: &self.shift[range],
        }
    }

    /// The biases of one panel.
    pub fn panel_bias(&self, simd: Simd, panel: usize) -> &[f32] {
        let columns = Tiling::of(simd).columns;
        &self.bias[panel * columns..(panel + 1) * columns]
    }

    /// Bytes on the heap.
    pub fn bytes(&self) -> usize {
        let numbers = self.bias.len() + self.gain.len() + self.shift.len();
        self.weight.bytes() + numbers * size_of::<f32>()
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(&a, &b)| f64::from(a) * f64::from(b))
        .sum()
}

/// One transformer block, packed.
pub(super) struct PackedBlock {
    pub qkv: PackedLinear,
    pub proj: PackedLinear,
    pub fc1: PackedLinear,
    pub fc2: PackedLinear,
}

impl PackedBlock {
    /// Packs a block whose hidden layer is multiplied `hidden_slice` inputs at a time. `smoothing`
    /// is there exactly where the inputs of the layers become int8 codes.
    pub fn pack(
        simd: Simd,
        format: Format,
        block: &BlockWeights,
        geometry: &Geometry,
        hidden_slice: usize,
        smoothing: Option<&BlockSmoothing>,
    ) -> Self {
        let whole = Packing::whole(simd, format);
        let sliced = Packing {
            slice: hidden_slice,
            ..whole
        };
        let proj_inverse = smoothing.map(|smoothing| smoothing.proj.inverse());
        Self {
            qkv: pack_qkv(whole, block, geometry, smoothing),
            proj: PackedLinear::pack(
                whole,
                &block.proj,
                |output| layer_scale(&block.layer_scale1, output),
                proj_inverse.as_ref(),
            ),
            fc1: PackedLinear::pack_smoothed(
                whole,
                &block.fc1,
                |_| 1.0,
                Some(&block.norm2),
                smoothing.map(|smoothing| &smoothing.fc1),
            ),
            fc2: PackedLinear::pack_smoothed(
                sliced,
                &block.fc2,
                |output| layer_scale(&block.layer_scale2, output),
                None,
                smoothing.map(|smoothing| &smoothing.fc2),
            ),
        }
    }

    /// Bytes on the heap.
    pub fn bytes(&self) -> usize {
        self.qkv.bytes() + self.proj.bytes() + self.fc1.bytes() + self.fc2.bytes()
    }
}

/// Packs the projections to queries, keys and values.
///
/// The inputs of the output projection are smoothed here already: attention takes weighted sums of
/// the values, and its weights add up to one. So scaling and centring all values scales and centres
/// every such sum in the same way.
fn pack_qkv(
    packing: Packing,
    block: &BlockWeights,
    geometry: &Geometry,
    smoothing: Option<&BlockSmoothing>,
) -> PackedLinear {
    let dim = geometry.dim;
    let query_scale = std::f32::consts::LOG2_E / (geometry.head_dim() as f32).sqrt();
    let value_smoothing = smoothing.map(|smoothing| &smoothing.proj);
    let output_scale = |output: usize| {
        if output < dim {
            query_scale
        } else if output < 2 * dim {
            1.0
        } else {
            value_smoothing.map_or(1.0, |values| 1.0 / values.scale[output - 2 * dim])
        }
    };
    let mut qkv = PackedLinear::pack_smoothed(
        packing,
        &block.qkv,
        output_scale,
        Some(&block.norm1),
        smoothing.map(|smoothing| &smoothing.qkv),
    );

    let (key_bias, value_bias) = qkv.bias[dim..3 * dim].split_at_mut(dim);
    key_bias.fill(0.0);
    if let Some(values) = value_smoothing {
        for (bias, (centre, scale)) in value_bias.iter_mut().zip(values.channels()) {
            *bias -= centre / scale;
        }
    }
    qkv
}

fn layer_scale(scales: &Option<Vec<f32>>, output: usize) -> f32 {
    scales.as_ref().map_or(1.0, |scales| scales[output])
}

//! The weights of a transformer as the fused encoder multiplies by them: packed once, with
//! everything that is linear folded in.
//!
//! A LayerNorm's scale and shift go into the layer that reads it (W diag(g), b + W s), LayerScale
//! into the layer it scales (diag(l) W, l b), and the factor log2(e) / sqrt(head_dim) into the
//! query rows, so that scores are exponents of two. The bias of the keys adds the same to all
//! scores of a query, which softmax takes out again: it is left out. Keys are that much smaller,
//! and what bf16 loses of a score is no more than what it loses elsewhere. Inputs that become int8
//! codes are centred and scaled by channel first ([`super::spread`]); W and b make that good. Sums
//! are taken in f64 once; what is left at run time is products, biases, and nothing else.

use super::spread::{BlockSpread, Spread};
use crate::extract::weights::{BlockWeights, Linear, Norm};
use placeformer_kernels::Simd;
use placeformer_kernels::gemm::{PackedMatrix, Tiling};
use placeformer_kernels::operand::{ChannelScaling, Format};
use std::ops::Range;

/// A linear layer, packed.
pub(super) struct PackedLinear {
    /// W transposed, `[in, out]`.
    pub weight: PackedMatrix,
    /// b, zero beyond the last output up to a whole panel.
    pub bias: Vec<f32>,
    /// How inputs are scaled before they become codes, `[in]` or empty.
    gain: Vec<f32>,
    shift: Vec<f32>,
}

impl PackedLinear {
    /// Packs y = W x + b, to be multiplied `slice` inputs at a time, after giving element `(out,
    /// in)` of W the factor `rows(out) * columns(in)`, b the factor `rows(out)`, and b further what
    /// `shift` through W comes to.
    fn pack(
        (simd, format): (Simd, Format),
        layer: &Linear,
        slice: usize,
        rows: impl Fn(usize) -> f32,
        columns: Option<&Norm>,
    ) -> Self {
        let (outputs, inputs) = (layer.bias.len(), layer.weight.len() / layer.bias.len());
        let scale = |input: usize| columns.map_or(1.0, |norm| norm.weight[input]);
        let element = |i: usize, o: usize| layer.weight[o * inputs + i] * (rows(o) * scale(i));
        let weight =
            PackedMatrix::pack(simd, format, (inputs, outputs), slice.min(inputs), element);
        let shifted = |o: usize| {
            let row = &layer.weight[o * inputs..(o + 1) * inputs];
            let shift = columns.map_or(0.0, |norm| {
                row.iter()
                    .zip(&norm.bias)
                    .map(|(&w, &s)| f64::from(w) * f64::from(s))
                    .sum::<f64>()
            });
            ((f64::from(layer.bias[o]) + shift) * f64::from(rows(o))) as f32
        };
        let padded = outputs.next_multiple_of(Tiling::of(simd).columns);
        let bias = (0..padded)
            .map(|o| if o < outputs { shifted(o) } else { 0.0 })
            .collect();
        Self {
            weight,
            bias,
            gain: Vec::new(),
            shift: Vec::new(),
        }
    }

    /// Packs a layer that multiplies what `spread` makes of its inputs. They come without the scale
    /// and shift of `norm`, the LayerNorm before it if there is one; these go to the inputs that
    /// become codes, or else into W and b.
    fn pack_spread(
        kernels: (Simd, Format),
        layer: &Linear,
        slice: usize,
        rows: impl Fn(usize) -> f32,
        (norm, spread): (Option<&Norm>, Option<&Spread>),
    ) -> Self {
        let Some(spread) = spread else {
            return Self::pack(kernels, layer, slice, rows, norm);
        };
        let inputs = 0..spread.centre.len();
        let gain = |i: usize| norm.map_or(1.0, |norm| norm.weight[i]) / spread.scale[i];
        let shift =
            |i: usize| (norm.map_or(0.0, |norm| norm.bias[i]) - spread.centre[i]) / spread.scale[i];
        Self {
            gain: inputs.clone().map(gain).collect(),
            shift: inputs.map(shift).collect(),
            ..Self::pack(kernels, layer, slice, rows, Some(&spread.undone()))
        }
    }

    /// How the inputs in `range` are scaled before they become codes.
    pub fn channels(&self, range: Range<usize>) -> ChannelScaling<'_> {
        if self.gain.is_empty() {
            return ChannelScaling::default();
        }
        ChannelScaling {
            gain: &self.gain[range.clone()],
            shift: &self.shift[range],
        }
    }

    /// Packs a layer as it is, in f32.
    pub fn plain(simd: Simd, layer: &Linear) -> Self {
        Self::pack((simd, Format::F32), layer, usize::MAX, |_| 1.0, None)
    }

    /// The biases of one panel.
    pub fn panel_bias(&self, simd: Simd, panel: usize) -> &[f32] {
        let columns = Tiling::of(simd).columns;
        &self.bias[panel * columns..(panel + 1) * columns]
    }

    pub fn bytes(&self) -> usize {
        self.weight.bytes()
            + [&self.bias, &self.gain, &self.shift]
                .map(|values| size_of_val(values.as_slice()))
                .iter()
                .sum::<usize>()
    }
}

/// One transformer block, packed.
pub(super) struct PackedBlock {
    pub qkv: PackedLinear,
    pub proj: PackedLinear,
    pub fc1: PackedLinear,
    pub fc2: PackedLinear,
}

impl PackedBlock {
    /// Packs a block whose hidden layer is computed `hidden_slice` numbers at a time, and whose
    /// inputs are scaled by `spread` if they become codes.
    pub fn pack(
        kernels: (Simd, Format),
        block: &BlockWeights,
        (dim, head_dim): (usize, usize),
        hidden_slice: usize,
        spread: Option<&BlockSpread>,
    ) -> Self {
        let query_scale = std::f32::consts::LOG2_E / (head_dim as f32).sqrt();
        let scale = |layer_scale: &Option<Vec<f32>>, o: usize| {
            layer_scale.as_ref().map_or(1.0, |scale| scale[o])
        };
        // Softmax's weights add up to one, so that what is done to all values is done to every mix
        // of them: the projection's inputs come scaled.
        let mixed = spread.map(|spread| &spread.proj);
        let query_or_value = |o: usize| match o {
            _ if o < dim => query_scale,
            _ if o < 2 * dim => 1.0,
            _ => mixed.map_or(1.0, |mixed| 1.0 / mixed.scale[o - 2 * dim]),
        };
        let whole = usize::MAX;
        let norm1 = (Some(&block.norm1), spread.map(|spread| &spread.qkv));
        let mut qkv = PackedLinear::pack_spread(kernels, &block.qkv, whole, query_or_value, norm1);
        qkv.bias[dim..2 * dim].fill(0.0);
        if let Some(Spread { centre, scale }) = mixed {
            let values = qkv.bias[2 * dim..3 * dim].iter_mut();
            values
                .zip(centre.iter().zip(scale))
                .for_each(|(bias, (centre, scale))| *bias -= centre / scale);
        }
        let undone = mixed.map(Spread::undone);
        let norm2 = (Some(&block.norm2), spread.map(|spread| &spread.fc1));
        let hidden = (None, spread.map(|spread| &spread.fc2));
        let (scale1, scale2) = (
            |o| scale(&block.layer_scale1, o),
            |o| scale(&block.layer_scale2, o),
        );
        Self {
            qkv,
            proj: PackedLinear::pack(kernels, &block.proj, whole, scale1, undone.as_ref()),
            fc1: PackedLinear::pack_spread(kernels, &block.fc1, whole, |_| 1.0, norm2),
            fc2: PackedLinear::pack_spread(kernels, &block.fc2, hidden_slice, scale2, hidden),
        }
    }

    pub fn bytes(&self) -> usize {
        self.qkv.bytes() + self.proj.bytes() + self.fc1.bytes() + self.fc2.bytes()
    }
}

//! The weights of a transformer as the fused encoder multiplies by them: packed once, with everything that is linear
//! folded in.
//!
//! A LayerNorm's scale and shift go into the layer that reads it (W diag(g), b + W s), LayerScale into the layer it
//! scales (diag(l) W, l b), and the factor log2(e) / sqrt(head_dim) into the query rows, so that scores are exponents of
//! two. The bias of the keys adds the same to all scores of a query, which softmax takes out again: it is left out. Keys
//! are that much smaller, and what bf16 loses of a score is no more than what it loses elsewhere. Sums are taken in f64
//! once; what is left at run time is products, biases, and nothing else.

use crate::extract::weights::{BlockWeights, Linear, Norm};
use crate::kernels::Simd;
use crate::kernels::gemm::{PackedMatrix, Tiling};
use crate::kernels::operand::Format;

/// A linear layer, packed.
pub(super) struct PackedLinear {
    /// W transposed, `[in, out]`.
    pub weight: PackedMatrix,
    /// b, zero beyond the last output up to a whole panel.
    pub bias: Vec<f32>,
}

impl PackedLinear {
    /// Packs y = W x + b, to be multiplied `slice` inputs at a time, after giving element `(out, in)` of W the factor
    /// `rows(out) * columns(in)`, b the factor `rows(out)`, and b further what `shift` through W comes to.
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
        let weight = PackedMatrix::pack(simd, format, (inputs, outputs), slice.min(inputs), element);
        let shifted = |o: usize| {
            let row = &layer.weight[o * inputs..(o + 1) * inputs];
            let shift = columns.map_or(0.0, |norm| {
                row.iter().zip(&norm.bias).map(|(&w, &s)| f64::from(w) * f64::from(s)).sum::<f64>()
            });
            ((f64::from(layer.bias[o]) + shift) * f64::from(rows(o))) as f32
        };
        let padded = outputs.next_multiple_of(Tiling::of(simd).columns);
        let bias = (0..padded).map(|o| if o < outputs { shifted(o) } else { 0.0 }).collect();
        Self { weight, bias }
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
        self.weight.bytes() + size_of_val(self.bias.as_slice())
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
    /// Packs a block whose hidden layer is computed `hidden_slice` numbers at a time.
    pub fn pack(
        kernels: (Simd, Format),
        block: &BlockWeights,
        dim: usize,
        head_dim: usize,
        hidden_slice: usize,
    ) -> Self {
        let query_scale = std::f32::consts::LOG2_E / (head_dim as f32).sqrt();
        let scale = |layer_scale: &Option<Vec<f32>>, o: usize| layer_scale.as_ref().map_or(1.0, |scale| scale[o]);
        let query = |o: usize| if o < dim { query_scale } else { 1.0 };
        let whole = usize::MAX;
        let mut qkv = PackedLinear::pack(kernels, &block.qkv, whole, query, Some(&block.norm1));
        qkv.bias[dim..2 * dim].fill(0.0);
        Self {
            qkv,
            proj: PackedLinear::pack(kernels, &block.proj, whole, |o| scale(&block.layer_scale1, o), None),
            fc1: PackedLinear::pack(kernels, &block.fc1, whole, |_| 1.0, Some(&block.norm2)),
            fc2: PackedLinear::pack(kernels, &block.fc2, hidden_slice, |o| scale(&block.layer_scale2, o), None),
        }
    }

    pub fn bytes(&self) -> usize {
        self.qkv.bytes() + self.proj.bytes() + self.fc1.bytes() + self.fc2.bytes()
    }
}

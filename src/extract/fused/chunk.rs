//! What one thread does with one chunk of tokens: patch embedding, and a transformer block from attention to the next
//! block's queries, keys and values, all while the chunk stays in its cache.

use super::weights::{PackedBlock, PackedLinear};
use crate::extract::preset::LAYER_NORM_EPS;
use crate::kernels::Simd;
use crate::kernels::aligned::AlignedBuffer;
use crate::kernels::attention::{AttentionShape, attend, store_keys, store_values};
use crate::kernels::elementwise::{Epilogue, finish_block, normalize_rows};
use crate::kernels::gemm::{Panel, Rows, Tiling, multiply_panel};

/// Width of the slice of the MLP's hidden layer that exists at a time.
const HIDDEN_SLICE: usize = 384;

/// What every chunk of an encoder has in common.
#[derive(Debug, Clone, Copy)]
pub(super) struct ChunkPlan {
    pub simd: Simd,
    pub shape: AttentionShape,
    /// Width of a token.
    pub dim: usize,
    /// Length of a patch's pixels, `3 * p * p`.
    pub patch_len: usize,
}

/// The chunk's own tokens and what the next block reads of it.
pub(super) struct Chunk<'a> {
    /// Its place in the image.
    pub index: usize,
    /// Tokens, `[chunk_rows, dim]`.
    pub tokens: &'a mut [f32],
    /// Queries, `[chunk_rows, dim]`.
    pub queries: &'a mut [f32],
    /// Keys for the next block.
    pub keys: &'a mut [f32],
    /// Values for the next block.
    pub values: &'a mut [f32],
}

/// Buffers of one thread, reused for every chunk.
#[derive(Default)]
pub(super) struct Scratch {
    /// A product before its epilogue, `[chunk_rows, columns]`.
    block: AlignedBuffer<f32>,
    /// Normalised tokens, or mixed values, `[chunk_rows, dim]`.
    input: AlignedBuffer<f32>,
    /// A slice of the hidden layer, or patches, `[chunk_rows, ..]`.
    hidden: AlignedBuffer<f32>,
    /// Output panels of the MLP while they are summed, `[panels][chunk_rows, columns]`.
    sums: AlignedBuffer<f32>,
    /// Attention scores of a group of rows.
    scores: AlignedBuffer<f32>,
}

impl ChunkPlan {
    /// Rows of chunk `index` that hold tokens, in whole register tiles.
    fn rows(&self, index: usize) -> usize {
        let filled = (self.shape.tokens - index * self.shape.chunk_rows).min(self.shape.chunk_rows);
        filled.next_multiple_of(Tiling::of(self.simd).rows)
    }

    fn columns(&self) -> usize {
        Tiling::of(self.simd).columns
    }

    /// Embeds the chunk's patches of an image `[3, height, width]` whose rows are `width` long, cut in patches of
    /// `side` pixels, on top of `positions` (`[tokens, dim]`, CLS and bias included).
    pub fn embed(
        &self,
        chunk: &mut Chunk<'_>,
        (image, width, side): (&[f32], usize, usize),
        positions: &[f32],
        embedding: &PackedLinear,
        scratch: &mut Scratch,
    ) {
        let (rows, first) = (self.rows(chunk.index), chunk.index * self.shape.chunk_rows);
        scratch.hidden.resize(self.shape.chunk_rows * self.patch_len);
        let plane = image.len() / 3;
        for (row, patch) in scratch.hidden.chunks_exact_mut(self.patch_len).take(rows).enumerate() {
            let token = first + row;
            if token == 0 || token >= self.shape.tokens {
                patch.fill(0.0);
                continue;
            }
            let (top, left) = ((token - 1) / (width / side) * side, (token - 1) % (width / side) * side);
            for (line, pixels) in patch.chunks_exact_mut(side).enumerate() {
                let at = line / side * plane + (top + line % side) * width + left;
                pixels.copy_from_slice(&image[at..at + side]);
            }
        }
        let present = (self.shape.tokens - first).min(self.shape.chunk_rows) * self.dim;
        chunk.tokens[..present].copy_from_slice(&positions[first * self.dim..][..present]);
        chunk.tokens[present..].fill(0.0);
        let Scratch { block, hidden, .. } = scratch;
        let left = Rows { data: hidden, stride: self.patch_len };
        self.linear(rows, left, embedding, block, |panel, bias, block| {
            let out = &mut chunk.tokens[panel * self.columns()..];
            finish_block(self.simd, Epilogue::BiasResidual, rows, block, bias, out, self.dim);
        });
    }

    /// Queries, keys and values of the chunk for `block`.
    pub fn project(&self, chunk: &mut Chunk<'_>, block: &PackedBlock, scratch: &mut Scratch) {
        let (rows, columns, head_dim) = (self.rows(chunk.index), self.columns(), self.shape.head_dim);
        self.normalize(chunk, rows, scratch);
        let Scratch { block: product, input, hidden, .. } = scratch;
        hidden.resize(self.shape.chunk_rows * columns);
        let left = Rows { data: input, stride: self.dim };
        self.linear(rows, left, &block.qkv, product, |panel, bias, product| {
            let column = panel * columns;
            let (part, column) = (column / self.dim, column % self.dim);
            if part == 0 {
                let out = &mut chunk.queries[column..];
                return finish_block(self.simd, Epilogue::Bias, rows, product, bias, out, self.dim);
            }
            let biased = &mut hidden[..rows * columns];
            finish_block(self.simd, Epilogue::Bias, rows, product, bias, biased, columns);
            let (head, dim) = (column / head_dim, column % head_dim);
            if part == 1 {
                store_keys(self.simd, &self.shape, head, dim, biased, chunk.keys);
            } else {
                store_values(self.simd, &self.shape, head, dim, biased, chunk.values);
            }
        });
    }

    /// One transformer block on the chunk: attention over all `keys` and `values` of the image, then the MLP.
    pub fn transform(
        &self,
        chunk: &mut Chunk<'_>,
        key_values: (&[f32], &[f32]),
        block: &PackedBlock,
        scratch: &mut Scratch,
    ) {
        let rows = self.rows(chunk.index);
        scratch.input.resize(self.shape.chunk_rows * self.dim);
        scratch.scores.resize(self.shape.scratch_len(self.simd));
        for head in 0..self.shape.heads {
            let queries = Rows { data: &chunk.queries[head * self.shape.head_dim..], stride: self.dim };
            let out = &mut scratch.input[head * self.shape.head_dim..];
            attend(self.simd, &self.shape, head, queries, rows, key_values, &mut scratch.scores, out);
        }
        let Scratch { block: product, input, .. } = scratch;
        let left = Rows { data: input, stride: self.dim };
        self.linear(rows, left, &block.proj, product, |panel, bias, product| {
            let out = &mut chunk.tokens[panel * self.columns()..];
            finish_block(self.simd, Epilogue::BiasResidual, rows, product, bias, out, self.dim);
        });
        self.feed_forward(chunk, rows, block, scratch);
    }

    /// The MLP, a slice of its hidden layer at a time.
    fn feed_forward(&self, chunk: &mut Chunk<'_>, rows: usize, block: &PackedBlock, scratch: &mut Scratch) {
        let (simd, columns) = (self.simd, self.columns());
        self.normalize(chunk, rows, scratch);
        let Scratch { block: product, input, hidden, sums, .. } = scratch;
        let (fc1, fc2, block_len) = (&block.fc1, &block.fc2, self.shape.chunk_rows * columns);
        hidden.resize(self.shape.chunk_rows * HIDDEN_SLICE);
        sums.resize(fc2.weight.panels() * block_len);
        for from in (0..fc1.weight.n()).step_by(HIDDEN_SLICE) {
            let to = fc1.weight.n().min(from + HIDDEN_SLICE);
            let left = Rows { data: input, stride: self.dim };
            self.panels(rows, left, fc1, from / columns..to.div_ceil(columns), product, |panel, bias, product| {
                let out = &mut hidden[panel * columns - from..];
                finish_block(simd, Epilogue::BiasGelu, rows, product, bias, out, HIDDEN_SLICE);
            });
            let left = Rows { data: hidden, stride: HIDDEN_SLICE };
            for (panel, sums) in sums.chunks_exact_mut(block_len).enumerate() {
                let right = Panel::whole(fc2.weight.panel_rows(panel, from, to), to - from);
                multiply_panel(simd, rows, left, right, sums, columns, from > 0);
            }
        }
        for (panel, sums) in sums.chunks_exact(block_len).enumerate() {
            let (bias, out) = (fc2.panel_bias(simd, panel), &mut chunk.tokens[panel * columns..]);
            finish_block(simd, Epilogue::BiasResidual, rows, sums, bias, out, self.dim);
        }
    }

    fn normalize(&self, chunk: &Chunk<'_>, rows: usize, scratch: &mut Scratch) {
        scratch.input.resize(self.shape.chunk_rows * self.dim);
        let len = rows * self.dim;
        normalize_rows(self.simd, self.dim, LAYER_NORM_EPS, &chunk.tokens[..len], &mut scratch.input[..len]);
    }

    /// All panels of a layer: `finish(panel, bias, product)` sees each while it is hot.
    fn linear(
        &self,
        rows: usize,
        left: Rows<'_>,
        layer: &PackedLinear,
        block: &mut AlignedBuffer<f32>,
        finish: impl FnMut(usize, &[f32], &[f32]),
    ) {
        self.panels(rows, left, layer, 0..layer.weight.panels(), block, finish);
    }

    fn panels(
        &self,
        rows: usize,
        left: Rows<'_>,
        layer: &PackedLinear,
        panels: std::ops::Range<usize>,
        block: &mut AlignedBuffer<f32>,
        mut finish: impl FnMut(usize, &[f32], &[f32]),
    ) {
        let k = layer.weight.k();
        block.resize(rows * self.columns());
        for panel in panels {
            let right = Panel::whole(layer.weight.panel_rows(panel, 0, k), k);
            multiply_panel(self.simd, rows, left, right, block, self.columns(), false);
            finish(panel, layer.panel_bias(self.simd, panel), block);
        }
    }
}

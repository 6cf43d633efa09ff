//! The shapes of a chunk, its buffers, and the product of its rows with a packed layer.
//!
//! A layer is multiplied panel by panel (a panel is a group of output columns as wide as the
//! kernels compute at once), and each panel in blocks of rows. The caller's `finish` gets every
//! block of sums while it is still in the first-level cache.

use crate::extract::fused::weights::PackedLinear;
use crate::extract::preset::LAYER_NORM_EPS;
use placeformer_kernels::Simd;
use placeformer_kernels::aligned::AlignedBuffer;
use placeformer_kernels::attention::AttentionShape;
use placeformer_kernels::elementwise::{Product, normalize_rows};
use placeformer_kernels::gemm::{Tiling, multiply_panel};
use placeformer_kernels::operand::{LeftOperand, OperandBuffer};
use std::ops::Range;

/// Columns of the MLP's hidden layer that exist at a time.
pub(crate) const HIDDEN_SLICE: usize = 384;

/// Rows whose sums exist at a time, few enough that their epilogue finds them in the first-level
/// cache. A multiple of the tile heights and panel sizes of every level.
const BLOCK_ROWS: usize = 192;

/// What all chunks of one call have in common.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ChunkPlan {
    pub simd: Simd,
    pub shape: AttentionShape,
    /// Width of a token.
    pub dim: usize,
    /// Number of values of a patch, `3 * p * p`.
    pub patch_len: usize,
}

/// One chunk: its tokens, and what it contributes to the next block.
pub(crate) struct Chunk<'a> {
    /// Number of the chunk within its image.
    pub index: usize,
    /// Tokens, `[chunk_rows, dim]`.
    pub tokens: &'a mut [f32],
    /// Queries, [`AttentionShape::queries_len`] words.
    pub queries: &'a mut [u32],
    /// Keys for the next block, [`AttentionShape::keys_len`] words.
    pub keys: &'a mut [u32],
    /// Values for the next block, [`AttentionShape::values_len`] words.
    pub values: &'a mut [u32],
}

/// Keys and values of all chunks of one image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct KeyValues<'a> {
    pub keys: &'a [u32],
    pub values: &'a [u32],
}

/// Buffers of one thread, reused from chunk to chunk.
#[derive(Default)]
pub(crate) struct ChunkScratch {
    /// A product before its epilogue, `[BLOCK_ROWS, columns of a panel]`.
    pub sums: AlignedBuffer<f32>,
    /// Normalised tokens, or the output of attention, `[chunk_rows, dim]`.
    pub input: AlignedBuffer<f32>,
    /// A slice of the MLP's hidden layer, the pixels of the patches, or queries and keys that wait
    /// for quantisation, `[chunk_rows, ..]`.
    pub hidden: AlignedBuffer<f32>,
    /// One of the above in the format of the next product.
    pub packed: OperandBuffer,
    /// A second operand, for what is computed while `packed` is still being read.
    pub packed_next: OperandBuffer,
    /// Attention scores of a group of rows.
    pub scores: AlignedBuffer<f32>,
}

/// A row operand of a product: how many rows there are, and the rows.
#[derive(Clone, Copy)]
pub(super) struct RowOperand<'a> {
    pub rows: usize,
    pub left: LeftOperand<'a>,
}

/// Which part of a layer is multiplied.
#[derive(Clone)]
pub(super) struct LayerPart {
    /// Which slice of the inputs; slices are as long as the layer was packed for.
    pub slice: usize,
    /// Which panels of the outputs.
    pub panels: Range<usize>,
}

impl ChunkPlan {
    /// Length of the tokens of a chunk, `chunk_rows * dim`.
    pub fn tokens_len(&self) -> usize {
        self.shape.chunk_rows * self.dim
    }

    /// Tokens in chunk `index`; the last chunk of an image may have fewer than the others.
    pub(super) fn filled_rows(&self, index: usize) -> usize {
        let before = index * self.shape.chunk_rows;
        (self.shape.tokens - before).min(self.shape.chunk_rows)
    }

    /// As [`Self::filled_rows`], rounded up to whole steps of the kernels.
    pub(super) fn padded_rows(&self, index: usize) -> usize {
        let row_step = Tiling::of(self.simd).row_step;
        self.filled_rows(index).next_multiple_of(row_step)
    }

    /// Output columns of a panel.
    pub(super) fn panel_columns(&self) -> usize {
        Tiling::of(self.simd).columns
    }

    /// LayerNorm without scale and shift of the first `rows` tokens, from the chunk to
    /// `scratch.input`. Scale and shift are part of the layer that reads it.
    pub(super) fn normalize(&self, chunk: &Chunk<'_>, rows: usize, scratch: &mut ChunkScratch) {
        let len = rows * self.dim;
        scratch.input.resize(self.tokens_len());
        normalize_rows(
            self.simd,
            self.dim,
            LAYER_NORM_EPS,
            &chunk.tokens[..len],
            &mut scratch.input[..len],
        );
    }

    /// Normalised tokens `input` in the format in which `layer` multiplies them.
    pub(super) fn pack_normalized<'a>(
        &self,
        layer: &PackedLinear,
        rows: usize,
        input: &'a [f32],
        packed: &'a mut OperandBuffer,
    ) -> RowOperand<'a> {
        let left = packed.pack_scaled(
            self.simd,
            layer.weight.format(),
            rows,
            self.dim,
            (input, self.dim),
            layer.channels(0..self.dim),
        );
        RowOperand { rows, left }
    }

    /// Multiplies `operand` by all of `layer`; `finish` is as in [`Self::multiply_part`].
    pub(super) fn multiply(
        &self,
        operand: RowOperand<'_>,
        layer: &PackedLinear,
        sums: &mut AlignedBuffer<f32>,
        finish: impl FnMut(usize, usize, Product<'_>),
    ) {
        let whole = LayerPart {
            slice: 0,
            panels: 0..layer.weight.panels(),
        };
        self.multiply_part(operand, layer, whole, sums, finish);
    }

    /// Multiplies `operand` by a part of `layer`, and calls `finish(panel, first_row, product)` for
    /// each block of rows while its sums are in the cache.
    pub(super) fn multiply_part(
        &self,
        operand: RowOperand<'_>,
        layer: &PackedLinear,
        part: LayerPart,
        sums: &mut AlignedBuffer<f32>,
        mut finish: impl FnMut(usize, usize, Product<'_>),
    ) {
        let columns = self.panel_columns();
        sums.resize(BLOCK_ROWS * columns);
        for panel in part.panels {
            let right = layer.weight.panel(panel, part.slice);
            let codes = layer.weight.codes(panel, part.slice);
            let bias = layer.panel_bias(self.simd, panel);
            for first_row in (0..operand.rows).step_by(BLOCK_ROWS) {
                let rows = BLOCK_ROWS.min(operand.rows - first_row);
                let left = operand.left.from_row(first_row);
                multiply_panel(
                    self.simd,
                    layer.weight.format(),
                    rows,
                    left.rows,
                    right,
                    sums,
                    columns,
                );
                let product = Product {
                    rows,
                    block: sums,
                    codes,
                    factors: left.factors,
                    bias: Some(bias),
                };
                finish(panel, first_row, product);
            }
        }
    }
}

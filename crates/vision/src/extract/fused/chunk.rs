//! What one thread does with one chunk of tokens: patch embedding, and a transformer block from
//! attention to the next block's queries, keys and values, all while the chunk stays in its cache.

use super::weights::{PackedBlock, PackedLinear};
use crate::extract::preset::LAYER_NORM_EPS;
use placeformer_kernels::Simd;
use placeformer_kernels::aligned::AlignedBuffer;
use placeformer_kernels::attention::{
    AttentionShape, BlockPosition, attend, store_key_codes, store_keys, store_query_codes,
    store_values,
};
use placeformer_kernels::elementwise::{
    Epilogue, Product, finish_block, finish_words, normalize_rows,
};
use placeformer_kernels::gemm::{Tiling, multiply_panel};
use placeformer_kernels::operand::{Format, LeftOperand, OperandBuffer, WordRows};
use std::ops::Range;

/// Width of the slice of the MLP's hidden layer that exists at a time.
pub(super) const HIDDEN_SLICE: usize = 384;

/// Rows whose sums exist at a time, so that their epilogue finds them in the first-level cache:
/// whole tiles and panels of every level.
const BLOCK_ROWS: usize = 192;

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
    /// Queries, `queries_len` words.
    pub queries: &'a mut [u32],
    /// Keys for the next block.
    pub keys: &'a mut [u32],
    /// Values for the next block.
    pub values: &'a mut [u32],
}

/// Buffers of one thread, reused for every chunk.
#[derive(Default)]
pub(super) struct Scratch {
    /// A product before its epilogue, `[BLOCK_ROWS, columns]`.
    block: AlignedBuffer<f32>,
    /// Normalised tokens, or mixed values, `[chunk_rows, dim]`.
    input: AlignedBuffer<f32>,
    /// A slice of the hidden layer, or patches, `[chunk_rows, ..]`.
    hidden: AlignedBuffer<f32>,
    /// One of the above in the format of the next product.
    packed: OperandBuffer,
    /// The same for what is computed while that is still needed.
    packed_block: OperandBuffer,
    /// Attention scores of a group of rows.
    scores: AlignedBuffer<f32>,
}

impl ChunkPlan {
    /// Rows of chunk `index` that hold tokens, in whole steps of the products.
    fn rows(&self, index: usize) -> usize {
        let filled = (self.shape.tokens - index * self.shape.chunk_rows).min(self.shape.chunk_rows);
        filled.next_multiple_of(Tiling::of(self.simd).row_step)
    }

    fn columns(&self) -> usize {
        Tiling::of(self.simd).columns
    }

    /// Embeds the chunk's patches of an image `[3, height, width]` whose rows are `width` long, cut
    /// in patches of `side` pixels, on top of `positions` (`[tokens, dim]`, CLS and bias included).
    pub fn embed(
        &self,
        chunk: &mut Chunk<'_>,
        (image, width, side): (&[f32], usize, usize),
        positions: &[f32],
        embedding: &PackedLinear,
        scratch: &mut Scratch,
    ) {
        let (rows, first) = (self.rows(chunk.index), chunk.index * self.shape.chunk_rows);
        scratch
            .hidden
            .resize(self.shape.chunk_rows * self.patch_len);
        let plane = image.len() / 3;
        for (row, patch) in scratch
            .hidden
            .chunks_exact_mut(self.patch_len)
            .take(rows)
            .enumerate()
        {
            let token = first + row;
            if token == 0 || token >= self.shape.tokens {
                patch.fill(0.0);
                continue;
            }
            let (top, left) = (
                (token - 1) / (width / side) * side,
                (token - 1) % (width / side) * side,
            );
            for (line, pixels) in patch.chunks_exact_mut(side).enumerate() {
                let at = line / side * plane + (top + line % side) * width + left;
                pixels.copy_from_slice(&image[at..at + side]);
            }
        }
        let present = (self.shape.tokens - first).min(self.shape.chunk_rows) * self.dim;
        chunk.tokens[..present].copy_from_slice(&positions[first * self.dim..][..present]);
        chunk.tokens[present..].fill(0.0);
        let Scratch {
            block,
            hidden,
            packed,
            ..
        } = scratch;
        let left = packed.pack(
            self.simd,
            embedding.weight.format(),
            rows,
            self.patch_len,
            (hidden, self.patch_len),
        );
        self.linear(rows, left, embedding, block, |panel, first, product| {
            let out = &mut chunk.tokens[first * self.dim + panel * self.columns()..];
            finish_block(self.simd, Epilogue::BiasResidual, product, out, self.dim);
        });
    }

    /// Queries, keys and values of the chunk for `block`.
    pub fn project(&self, chunk: &mut Chunk<'_>, block: &PackedBlock, scratch: &mut Scratch) {
        let (rows, columns, head_dim) =
            (self.rows(chunk.index), self.columns(), self.shape.head_dim);
        self.normalize(chunk, rows, scratch);
        let Scratch {
            block: sums,
            input,
            hidden,
            packed,
            packed_block,
            ..
        } = scratch;
        hidden.resize(self.shape.chunk_rows * head_dim);
        let left = self.normalized(&block.qkv, rows, input, packed);
        self.linear(rows, left, &block.qkv, sums, |panel, token, product| {
            let (simd, shape) = (self.simd, &self.shape);
            let (part, column) = (panel * columns / self.dim, panel * columns % self.dim);
            let place = BlockPosition {
                head: column / head_dim,
                dim: column % head_dim,
                token,
            };
            if part < 2 && shape.scores == Format::Int8 {
                // What a code is worth is known when the head's last panel is there.
                let head = &mut hidden[token * head_dim..(token + product.rows) * head_dim];
                finish_block(
                    simd,
                    Epilogue::Bias,
                    product,
                    &mut head[place.dim..],
                    head_dim,
                );
                return match part {
                    _ if place.dim + columns < head_dim => (),
                    0 => store_query_codes(simd, shape, place, head, chunk.queries),
                    _ => store_key_codes(simd, shape, place, head, packed_block, chunk.keys),
                };
            }
            if part == 0 {
                let queries = &mut chunk.queries[shape.query_at(place)..];
                return finish_words(
                    simd,
                    shape.scores,
                    Epilogue::Bias,
                    product,
                    queries,
                    shape.query_len(),
                );
            }
            let format = if part == 1 { shape.scores } else { shape.mix };
            let stride = format.words(columns);
            let finished = packed_block.rows(format, product.rows, columns);
            finish_words(simd, format, Epilogue::Bias, product, finished, stride);
            let finished = WordRows {
                data: finished,
                stride,
            };
            match part {
                1 => store_keys(simd, shape, place, finished, chunk.keys),
                _ => store_values(simd, shape, place, finished, chunk.values),
            }
        });
    }

    /// One transformer block on the chunk: attention over all `keys` and `values` of the image,
    /// then the MLP.
    pub fn transform(
        &self,
        chunk: &mut Chunk<'_>,
        key_values: (&[u32], &[u32]),
        block: &PackedBlock,
        scratch: &mut Scratch,
    ) {
        let rows = self.rows(chunk.index);
        scratch.input.resize(self.shape.chunk_rows * self.dim);
        scratch.scores.resize(self.shape.scratch_len(self.simd));
        for head in 0..self.shape.heads {
            let out = &mut scratch.input[head * self.shape.head_dim..];
            let queries = (&*chunk.queries, rows);
            attend(
                self.simd,
                &self.shape,
                head,
                queries,
                key_values,
                &mut scratch.scores,
                out,
                self.dim,
            );
        }
        let Scratch {
            block: sums,
            input,
            packed,
            ..
        } = scratch;
        let left = packed.pack(
            self.simd,
            block.proj.weight.format(),
            rows,
            self.dim,
            (input, self.dim),
        );
        self.linear(rows, left, &block.proj, sums, |panel, first, product| {
            let out = &mut chunk.tokens[first * self.dim + panel * self.columns()..];
            finish_block(self.simd, Epilogue::BiasResidual, product, out, self.dim);
        });
        self.feed_forward(chunk, rows, block, scratch);
    }

    /// The MLP, a slice of its hidden layer at a time.
    fn feed_forward(
        &self,
        chunk: &mut Chunk<'_>,
        rows: usize,
        block: &PackedBlock,
        scratch: &mut Scratch,
    ) {
        let (simd, columns) = (self.simd, self.columns());
        self.normalize(chunk, rows, scratch);
        let Scratch {
            block: sums,
            input,
            hidden,
            packed,
            packed_block,
            ..
        } = scratch;
        let (fc1, fc2, format) = (&block.fc1, &block.fc2, block.fc2.weight.format());
        let gelu = if format == Format::F32 {
            Epilogue::BiasGelu
        } else {
            Epilogue::BiasShortGelu
        };
        let normalized = self.normalized(fc1, rows, input, packed);
        for (slice, from) in (0..fc1.weight.n()).step_by(HIDDEN_SLICE).enumerate() {
            let to = fc1.weight.n().min(from + HIDDEN_SLICE);
            let (width, panels) = (to - from, from / columns..to.div_ceil(columns));
            let left = if format == Format::Int8 {
                // What a code is worth is known when the row is whole.
                hidden.resize(self.shape.chunk_rows * HIDDEN_SLICE);
                self.panels(
                    (rows, normalized),
                    fc1,
                    0,
                    panels,
                    sums,
                    |panel, first, product| {
                        let out = &mut hidden[first * HIDDEN_SLICE + panel * columns - from..];
                        finish_block(simd, gelu, product, out, HIDDEN_SLICE);
                    },
                );
                packed_block.pack_scaled(
                    simd,
                    format,
                    rows,
                    width,
                    (hidden, HIDDEN_SLICE),
                    fc2.channels(from..to),
                )
            } else {
                let words = format.words(width);
                let finished = packed_block.rows(format, rows, width);
                self.panels(
                    (rows, normalized),
                    fc1,
                    0,
                    panels,
                    sums,
                    |panel, first, product| {
                        let out =
                            &mut finished[first * words + format.words(panel * columns - from)..];
                        finish_words(simd, format, gelu, product, out, words);
                    },
                );
                LeftOperand {
                    rows: WordRows {
                        data: finished,
                        stride: words,
                    },
                    factors: &[],
                }
            };
            self.panels(
                (rows, left),
                fc2,
                slice,
                0..fc2.weight.panels(),
                sums,
                |panel, first, product| {
                    // The bias is added once, with the first slice.
                    let product = Product {
                        bias: product.bias.filter(|_| slice == 0),
                        ..product
                    };
                    let out = &mut chunk.tokens[first * self.dim + panel * columns..];
                    finish_block(simd, Epilogue::BiasResidual, product, out, self.dim);
                },
            );
        }
    }

    fn normalize(&self, chunk: &Chunk<'_>, rows: usize, scratch: &mut Scratch) {
        scratch.input.resize(self.shape.chunk_rows * self.dim);
        let len = rows * self.dim;
        normalize_rows(
            self.simd,
            self.dim,
            LAYER_NORM_EPS,
            &chunk.tokens[..len],
            &mut scratch.input[..len],
        );
    }

    /// Normalised tokens as `layer` multiplies them.
    fn normalized<'a>(
        &self,
        layer: &PackedLinear,
        rows: usize,
        input: &'a [f32],
        packed: &'a mut OperandBuffer,
    ) -> LeftOperand<'a> {
        let (format, channels) = (layer.weight.format(), layer.channels(0..self.dim));
        packed.pack_scaled(
            self.simd,
            format,
            rows,
            self.dim,
            (input, self.dim),
            channels,
        )
    }

    /// All panels of a layer: `finish(panel, first row, product)` sees each block of rows while it
    /// is hot.
    fn linear(
        &self,
        rows: usize,
        left: LeftOperand<'_>,
        layer: &PackedLinear,
        sums: &mut AlignedBuffer<f32>,
        finish: impl FnMut(usize, usize, Product<'_>),
    ) {
        self.panels(
            (rows, left),
            layer,
            0,
            0..layer.weight.panels(),
            sums,
            finish,
        );
    }

    /// The given panels of a slice of a layer.
    fn panels(
        &self,
        (rows, left): (usize, LeftOperand<'_>),
        layer: &PackedLinear,
        slice: usize,
        panels: Range<usize>,
        sums: &mut AlignedBuffer<f32>,
        mut finish: impl FnMut(usize, usize, Product<'_>),
    ) {
        sums.resize(BLOCK_ROWS * self.columns());
        for panel in panels {
            let right = layer.weight.panel(panel, slice);
            let bias = Some(layer.panel_bias(self.simd, panel));
            let codes = layer.weight.codes(panel, slice);
            for first in (0..rows).step_by(BLOCK_ROWS) {
                let count = BLOCK_ROWS.min(rows - first);
                let block = left.from_row(first);
                multiply_panel(
                    self.simd,
                    layer.weight.format(),
                    count,
                    block.rows,
                    right,
                    sums,
                    self.columns(),
                );
                finish(
                    panel,
                    first,
                    Product {
                        rows: count,
                        block: sums,
                        codes,
                        factors: block.factors,
                        bias,
                    },
                );
            }
        }
    }
}

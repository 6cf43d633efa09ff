//! One transformer block on one chunk: attention, then the MLP, each with its residual.

use super::plan::{Chunk, ChunkPlan, ChunkScratch, HIDDEN_SLICE, KeyValues, LayerPart, RowOperand};
use crate::extract::fused::weights::{PackedBlock, PackedLinear};
use placeformer_kernels::aligned::AlignedBuffer;
use placeformer_kernels::attention::attend;
use placeformer_kernels::elementwise::{Epilogue, Product, finish_block, finish_words};
use placeformer_kernels::operand::{Format, LeftOperand, OperandBuffer, WordRows};
use std::ops::Range;

impl ChunkPlan {
    /// Runs one block on the chunk, whose queries attend to all keys and values of the image.
    pub fn transform(
        &self,
        chunk: &mut Chunk<'_>,
        key_values: KeyValues<'_>,
        block: &PackedBlock,
        scratch: &mut ChunkScratch,
    ) {
        let rows = self.padded_rows(chunk.index);
        self.attend_heads(chunk, rows, key_values, scratch);
        let left = scratch.packed.pack(
            self.simd,
            block.proj.weight.format(),
            rows,
            self.dim,
            (&scratch.input, self.dim),
        );
        let mixed = RowOperand { rows, left };
        let sums = &mut scratch.sums;
        self.multiply(mixed, &block.proj, sums, |panel, first_row, product| {
            self.add_to_tokens(panel, first_row, product, chunk);
        });
        self.feed_forward(chunk, rows, block, scratch);
    }

    /// Softmax attention of all heads, to `scratch.input` `[rows, dim]`.
    fn attend_heads(
        &self,
        chunk: &Chunk<'_>,
        rows: usize,
        key_values: KeyValues<'_>,
        scratch: &mut ChunkScratch,
    ) {
        scratch.input.resize(self.tokens_len());
        scratch.scores.resize(self.shape.scratch_len(self.simd));
        for head in 0..self.shape.heads {
            attend(
                self.simd,
                &self.shape,
                head,
                (chunk.queries, rows),
                (key_values.keys, key_values.values),
                &mut scratch.scores,
                &mut scratch.input[head * self.shape.head_dim..],
                self.dim,
            );
        }
    }

    /// The MLP. Its hidden layer is four times as wide as a token and would not stay in the cache,
    /// so it is computed slice by slice, and each slice is multiplied by its part of the second
    /// layer at once.
    fn feed_forward(
        &self,
        chunk: &mut Chunk<'_>,
        rows: usize,
        block: &PackedBlock,
        scratch: &mut ChunkScratch,
    ) {
        self.normalize(chunk, rows, scratch);
        let ChunkScratch {
            sums,
            input,
            hidden,
            packed,
            packed_next,
            ..
        } = scratch;
        let tokens = self.pack_normalized(&block.fc1, rows, input, packed);
        let hidden_width = block.fc1.weight.n();
        for (slice, from) in (0..hidden_width).step_by(HIDDEN_SLICE).enumerate() {
            let columns = from..hidden_width.min(from + HIDDEN_SLICE);
            let left = if block.fc2.weight.format() == Format::Int8 {
                hidden.resize(self.shape.chunk_rows * HIDDEN_SLICE);
                self.hidden_codes(tokens, block, columns, sums, hidden, packed_next)
            } else {
                self.hidden_words(tokens, block, columns, sums, packed_next)
            };
            let activations = RowOperand { rows, left };
            self.multiply_hidden(activations, &block.fc2, slice, sums, chunk);
        }
    }

    /// The hidden activations in `columns` as int8 codes.
    ///
    /// The scale of a row's codes follows from its largest value, so the slice is computed whole,
    /// in f32, before it is quantised.
    fn hidden_codes<'a>(
        &self,
        tokens: RowOperand<'_>,
        block: &PackedBlock,
        columns: Range<usize>,
        sums: &mut AlignedBuffer<f32>,
        hidden: &'a mut [f32],
        packed: &'a mut OperandBuffer,
    ) -> LeftOperand<'a> {
        let part = self.panels_of(&columns);
        self.multiply_part(
            tokens,
            &block.fc1,
            part,
            sums,
            |panel, first_row, product| {
                let column = panel * self.panel_columns() - columns.start;
                let out = &mut hidden[first_row * HIDDEN_SLICE + column..];
                finish_block(
                    self.simd,
                    Epilogue::BiasShortGelu,
                    product,
                    out,
                    HIDDEN_SLICE,
                );
            },
        );
        packed.pack_scaled(
            self.simd,
            Format::Int8,
            tokens.rows,
            columns.len(),
            (hidden, HIDDEN_SLICE),
            block.fc2.channels(columns),
        )
    }

    /// The hidden activations in `columns` in the format of the second layer, f32 or bf16, written
    /// by the epilogue itself.
    fn hidden_words<'a>(
        &self,
        tokens: RowOperand<'_>,
        block: &PackedBlock,
        columns: Range<usize>,
        sums: &mut AlignedBuffer<f32>,
        packed: &'a mut OperandBuffer,
    ) -> LeftOperand<'a> {
        let format = block.fc2.weight.format();
        let gelu = if format == Format::F32 {
            Epilogue::BiasGelu
        } else {
            Epilogue::BiasShortGelu
        };
        let stride = format.words(columns.len());
        let part = self.panels_of(&columns);
        let data = packed.rows(format, tokens.rows, columns.len());
        self.multiply_part(
            tokens,
            &block.fc1,
            part,
            sums,
            |panel, first_row, product| {
                let column = panel * self.panel_columns() - columns.start;
                let out = &mut data[first_row * stride + format.words(column)..];
                finish_words(self.simd, format, gelu, product, out, stride);
            },
        );
        LeftOperand {
            rows: WordRows { data, stride },
            factors: &[],
        }
    }

    /// The panels of the first layer that compute the hidden activations in `columns`.
    fn panels_of(&self, columns: &Range<usize>) -> LayerPart {
        let width = self.panel_columns();
        LayerPart {
            slice: 0,
            panels: columns.start / width..columns.end.div_ceil(width),
        }
    }

    /// Multiplies a slice of the hidden activations by its part of the second layer, and adds the
    /// result to the tokens.
    fn multiply_hidden(
        &self,
        activations: RowOperand<'_>,
        layer: &PackedLinear,
        slice: usize,
        sums: &mut AlignedBuffer<f32>,
        chunk: &mut Chunk<'_>,
    ) {
        let part = LayerPart {
            slice,
            panels: 0..layer.weight.panels(),
        };
        self.multiply_part(
            activations,
            layer,
            part,
            sums,
            |panel, first_row, product| {
                // Every slice adds to the same outputs, so the bias is added with the first one
                // only.
                let bias = product.bias.filter(|_| slice == 0);
                let product = Product { bias, ..product };
                self.add_to_tokens(panel, first_row, product, chunk);
            },
        );
    }

    /// Adds a finished block of a product to the residual stream.
    fn add_to_tokens(
        &self,
        panel: usize,
        first_row: usize,
        product: Product<'_>,
        chunk: &mut Chunk<'_>,
    ) {
        let start = first_row * self.dim + panel * self.panel_columns();
        let out = &mut chunk.tokens[start..];
        finish_block(self.simd, Epilogue::BiasResidual, product, out, self.dim);
    }
}

//! LayerNorm and the projections of a chunk to queries, keys and values.
//!
//! The outputs of the fused `qkv` layer come panel by panel: first all panels of the queries, then
//! those of the keys, then those of the values, head by head. Each panel is stored in the layout in
//! which attention reads it.

use super::plan::{Chunk, ChunkPlan, ChunkScratch};
use crate::extract::fused::weights::PackedBlock;
use placeformer_kernels::attention::{
    BlockPosition, store_key_codes, store_keys, store_query_codes, store_values,
};
use placeformer_kernels::elementwise::{Epilogue, Product, finish_block, finish_words};
use placeformer_kernels::operand::{Format, OperandBuffer, WordRows};

/// Which of the three a panel of the `qkv` layer belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    Queries,
    Keys,
    Values,
}

impl ChunkPlan {
    /// Computes queries, keys and values of the chunk for `block`.
    pub fn project(&self, chunk: &mut Chunk<'_>, block: &PackedBlock, scratch: &mut ChunkScratch) {
        let rows = self.padded_rows(chunk.index);
        self.normalize(chunk, rows, scratch);
        let ChunkScratch {
            sums,
            input,
            hidden,
            packed,
            packed_next,
            ..
        } = scratch;
        hidden.resize(self.shape.chunk_rows * self.shape.head_dim);
        let tokens = self.pack_normalized(&block.qkv, rows, input, packed);
        self.multiply(tokens, &block.qkv, sums, |panel, token, product| {
            let (part, place) = self.locate(panel, token);
            let has_code_scores = self.shape.scores == Format::Int8;
            match part {
                Part::Queries | Part::Keys if has_code_scores => {
                    self.collect_codes(part, place, product, hidden, packed_next, chunk);
                }
                Part::Queries => self.store_queries(place, product, chunk),
                Part::Keys | Part::Values => {
                    self.store_key_values(part, place, product, packed_next, chunk);
                }
            }
        });
    }

    /// What the first column of `panel` of the `qkv` layer is, in the rows from `token` on.
    fn locate(&self, panel: usize, token: usize) -> (Part, BlockPosition) {
        let column = panel * self.panel_columns();
        let part = match column / self.dim {
            0 => Part::Queries,
            1 => Part::Keys,
            _ => Part::Values,
        };
        let column_of_part = column % self.dim;
        let place = BlockPosition {
            head: column_of_part / self.shape.head_dim,
            dim: column_of_part % self.shape.head_dim,
            token,
        };
        (part, place)
    }

    /// Adds the bias to a panel of queries or keys, and quantises the head once it is complete.
    ///
    /// The scale of a row's int8 codes follows from the largest value of the row in the whole head.
    /// So the panels of a head are collected in `hidden` (`[chunk_rows, head_dim]`) as f32, and
    /// become codes when the last panel of the head is there.
    fn collect_codes(
        &self,
        part: Part,
        place: BlockPosition,
        product: Product<'_>,
        hidden: &mut [f32],
        packed: &mut OperandBuffer,
        chunk: &mut Chunk<'_>,
    ) {
        let shape = &self.shape;
        let head_dim = shape.head_dim;
        let rows = product.rows;
        let head = &mut hidden[place.token * head_dim..(place.token + rows) * head_dim];
        let out = &mut head[place.dim..];
        finish_block(self.simd, Epilogue::Bias, product, out, head_dim);

        let is_complete = place.dim + self.panel_columns() >= head_dim;
        if !is_complete {
            return;
        }
        if part == Part::Queries {
            store_query_codes(self.simd, shape, place, head, chunk.queries);
        } else {
            store_key_codes(self.simd, shape, place, head, packed, chunk.keys);
        }
    }

    fn store_queries(&self, place: BlockPosition, product: Product<'_>, chunk: &mut Chunk<'_>) {
        let shape = &self.shape;
        finish_words(
            self.simd,
            shape.scores,
            Epilogue::Bias,
            product,
            &mut chunk.queries[shape.query_at(place)..],
            shape.query_len(),
        );
    }

    /// Adds the bias to a panel of keys or values, converts it to its format, and stores it.
    fn store_key_values(
        &self,
        part: Part,
        place: BlockPosition,
        product: Product<'_>,
        packed: &mut OperandBuffer,
        chunk: &mut Chunk<'_>,
    ) {
        let shape = &self.shape;
        let format = if part == Part::Keys {
            shape.scores
        } else {
            shape.mix
        };
        let columns = self.panel_columns();
        let stride = format.words(columns);
        let data = packed.rows(format, product.rows, columns);
        finish_words(self.simd, format, Epilogue::Bias, product, data, stride);
        let finished = WordRows { data, stride };
        if part == Part::Keys {
            store_keys(self.simd, shape, place, finished, chunk.keys);
        } else {
            store_values(self.simd, shape, place, finished, chunk.values);
        }
    }
}

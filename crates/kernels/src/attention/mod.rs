//! Softmax attention of some query tokens of an image over all its tokens, one head at a time.
//!
//! Attention multiplies queries with keys, applies softmax to the resulting scores, and multiplies
//! those weights with values. All scores of an image, `[tokens, tokens]` for each head, would not
//! fit into a cache. So queries are processed in groups of rows small enough that the scores of a
//! group, `[group, tokens]`, stay in the second-level cache: a group is multiplied with one panel
//! of keys after another (2 to 8 kB, which fit into the first-level cache), then softmax runs over
//! its rows, then it is multiplied with the values.
//!
//! Queries are expected to carry the factor log2(e) / sqrt(head_dim), so that softmax can use
//! powers of two. Scores are products of f32, bf16 or int8; the product with the values is one of
//! f32 or bf16; softmax is computed in f32.
//!
//! Everything here is made of the kernels in [`gemm`](crate::gemm) and
//! [`elementwise`](crate::elementwise), so there is no code for particular instruction sets.

mod check;
mod chunks;
mod layout;
#[cfg(test)]
mod tests;

use crate::elementwise::{Epilogue, Product, exponentiate_row, finish_block, scale_rows};
use crate::gemm::{PanelCodes, RightPanel, Tiling, multiply_panel};
use crate::operand::{Format, LeftOperand, WordRows};
use crate::{Simd, SimdLevel};
pub(crate) use check::check;
pub use chunks::chunk_rows;
use layout::head_queries;
pub use layout::{
    AttentionShape, BlockPosition, store_key_codes, store_keys, store_query_codes, store_values,
};

/// Most query rows of a group: whole tiles of every level.
const GROUP_ROWS: usize = 96;

/// Number of scores, each a float, that a group of query rows may have. They take part of the
/// second-level cache and leave the rest for the keys and values of the head. That cache has 512 kB
/// or more, and 2 MB on CPUs with AMX.
fn group_scores(simd: Simd) -> usize {
    if simd.level() == SimdLevel::Amx {
        80 * 1024
    } else {
        40 * 1024
    }
}

impl AttentionShape {
    /// Number of floats of scratch memory that [`attend`] needs.
    pub fn scratch_len(&self, simd: Simd) -> usize {
        self.group_rows(simd) * (self.padded_tokens() + Tiling::of(simd).columns)
    }

    /// Query rows of a group: whole tiles.
    fn group_rows(&self, simd: Simd) -> usize {
        let tile = Tiling::of(simd).rows;
        let rows = group_scores(simd) / self.padded_tokens();
        (rows / tile * tile).clamp(tile, self.chunk_rows.min(GROUP_ROWS))
    }
}

/// Attention of the first `rows` rows (whole steps of [`Tiling`]) of a chunk's `queries`, for one
/// head.
///
/// `keys` and `values` are those of all chunks of the image. `out` is `[rows, head_dim]`, row `i`
/// starting at `i * out_stride`.
///
/// # Panics
/// If a slice is shorter than `shape` says.
#[expect(
    clippy::too_many_arguments,
    reason = "the operands of a kernel, of which none belongs to another"
)]
pub fn attend(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    (queries, rows): (&[u32], usize),
    (keys, values): (&[u32], &[u32]),
    scratch: &mut [f32],
    out: &mut [f32],
    out_stride: usize,
) {
    let columns = Tiling::of(simd).columns;
    let width = shape.padded_tokens();
    let group = shape.group_rows(simd);
    let mut reciprocals = [0.0f32; GROUP_ROWS];
    let (block, scores) = scratch[..shape.scratch_len(simd)].split_at_mut(group * columns);
    for first in (0..rows).step_by(group) {
        let count = group.min(rows - first);
        let queries = head_queries(shape, head, first, queries);
        compute_scores(simd, shape, head, queries, count, keys, block, scores);

        let reciprocals = &mut reciprocals[..count];
        for (row, reciprocal) in scores.chunks_exact_mut(width).zip(&mut *reciprocals) {
            *reciprocal = exponentiate_row(simd, shape.mix, &mut row[..shape.tokens]);
        }

        let out = &mut out[first * out_stride..];
        mix_values(simd, shape, head, count, scores, values, out, out_stride);
        scale_rows(reciprocals, shape.head_dim, out, out_stride);
    }
}

/// Computes the scores of `rows` query rows of one head with every key, `[rows, padded tokens]`.
/// Scores beyond the last token are meaningless. `block` has room for `rows` rows of a panel.
#[expect(
    clippy::too_many_arguments,
    reason = "the operands of a kernel, of which none belongs to another"
)]
fn compute_scores(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    queries: LeftOperand<'_>,
    rows: usize,
    keys: &[u32],
    block: &mut [f32],
    out: &mut [f32],
) {
    let columns = Tiling::of(simd).columns;
    let words = shape.head_words();
    let stride = shape.padded_tokens();
    let panel_len = shape.panel_rows() * columns;
    let panels_per_chunk = shape.chunk_rows / columns;
    for panel in 0..shape.tokens.div_ceil(columns) {
        let chunk_start = panel / panels_per_chunk * shape.keys_len();
        let head_start = chunk_start + head * shape.head_keys();
        let start = head_start + panel % panels_per_chunk * panel_len;
        let (right, tail) = keys[start..start + panel_len].split_at(words * columns);
        let right = RightPanel::whole(right, words);
        let out = &mut out[panel * columns..];
        if shape.scores != Format::Int8 {
            multiply_panel(simd, shape.scores, rows, queries.rows, right, out, stride);
            continue;
        }

        multiply_panel(
            simd,
            shape.scores,
            rows,
            queries.rows,
            right,
            block,
            columns,
        );
        let (factors, offsets) = tail.split_at(columns);
        let codes = PanelCodes {
            factors: bytemuck::cast_slice(factors),
            offsets: bytemuck::cast_slice(offsets),
        };
        let product = Product {
            rows,
            block,
            codes: Some(codes),
            factors: queries.factors,
            bias: None,
        };
        finish_block(simd, Epilogue::Bias, product, out, stride);
    }
}

/// Multiplies the weights of `rows` query rows of one head, `[rows, padded tokens]` floats of which
/// bf16 weights fill the first half of each row, with the values.
#[expect(
    clippy::too_many_arguments,
    reason = "the operands of a kernel, of which none belongs to another"
)]
fn mix_values(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    rows: usize,
    weights: &[f32],
    values: &[u32],
    out: &mut [f32],
    out_stride: usize,
) {
    let segment_rows = shape.mix.words(shape.chunk_rows);
    let weights = WordRows::f32(weights, shape.padded_tokens());
    for dim in (0..shape.head_dim).step_by(Tiling::of(simd).columns) {
        let panel = RightPanel {
            data: &values[head * shape.head_values() + dim * segment_rows..],
            k: shape.mix.words(shape.tokens),
            segment_rows,
            segment_stride: shape.values_len(),
        };
        let out = &mut out[dim..];
        multiply_panel(simd, shape.mix, rows, weights, panel, out, out_stride);
    }
}

/// The attention weights, after softmax, of the first query row of one head over all tokens; `out`
/// is `[tokens]`.
///
/// # Panics
/// If a slice is shorter than `shape` says.
pub fn first_row_attention(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    queries: &[u32],
    keys: &[u32],
    scratch: &mut [f32],
    out: &mut [f32],
) {
    let tile = Tiling::of(simd);
    let rows = tile.row_step;
    let (block, scores) = scratch.split_at_mut(rows * tile.columns);
    let queries = head_queries(shape, head, 0, queries);
    compute_scores(simd, shape, head, queries, rows, keys, block, scores);
    out.copy_from_slice(&scores[..shape.tokens]);
    let reciprocal = exponentiate_row(simd, Format::F32, out);
    scale_rows(&[reciprocal], shape.tokens, out, shape.tokens);
}

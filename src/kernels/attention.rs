//! Softmax attention of a chunk of queries over all tokens of an image, one head at a time; no more scores exist than
//! those of a group of query rows, which stay in the second-level cache.
//!
//! Keys and values lie as the two products read them, cut into chunks of [`chunk_rows`] tokens so that each chunk can be
//! written by the thread that computed it: keys `[chunk][head][key panel][head_dim][columns]`, values
//! `[chunk][head][value panel][chunk_rows][columns]`, panels `columns` wide as in [`Tiling`]. A group of queries first
//! meets every key panel (4 to 8 kB, first-level cache), then softmax runs over its rows, then it meets the values.
//! Queries carry the factor log2(e) / sqrt(head_dim).

use super::Simd;
use super::elementwise::{exponentiate_row, scale_rows};
use super::gemm::{Panel, Rows, Tiling, multiply_panel};

/// Tokens of a chunk: whole register tiles and whole key panels.
pub fn chunk_rows(simd: Simd) -> usize {
    let tile = Tiling::of(simd);
    let (mut a, mut b) = (tile.rows, tile.columns);
    while b > 0 {
        (a, b) = (b, a % b);
    }
    let common = tile.rows / a * tile.columns;
    common * (48usize.div_ceil(common))
}

/// Floats that the scores of one group of query rows may take: half of a second-level cache of 512 kB leaves room for
/// a head's values to stream by.
const GROUP_SCORES: usize = 40 * 1024;

/// How the tokens of an image and their heads are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AttentionShape {
    /// Tokens of an image, CLS included.
    pub tokens: usize,
    /// Heads.
    pub heads: usize,
    /// Width of a head; a multiple of [`Tiling::columns`].
    pub head_dim: usize,
    /// Tokens of a chunk.
    pub chunk_rows: usize,
}

impl AttentionShape {
    /// Chunks of an image, the last possibly not full.
    pub fn chunks(&self) -> usize {
        self.tokens.div_ceil(self.chunk_rows)
    }

    /// Floats of one chunk's keys, or of its values: all heads.
    pub fn chunk_len(&self) -> usize {
        self.heads * self.head_len()
    }

    fn head_len(&self) -> usize {
        self.head_dim * self.chunk_rows
    }

    fn padded_tokens(&self) -> usize {
        self.chunks() * self.chunk_rows
    }

    /// Floats of scratch that [`attend`] needs.
    pub fn scratch_len(&self, simd: Simd) -> usize {
        self.group_rows(simd) * self.padded_tokens()
    }

    fn group_rows(&self, simd: Simd) -> usize {
        let tile = Tiling::of(simd).rows;
        (GROUP_SCORES / self.padded_tokens() / tile * tile).clamp(tile, self.chunk_rows)
    }
}

/// Writes a finished `[rows, columns]` block of the key projection, `columns` dimensions of one head from `dim` on, to
/// its places in a chunk's keys.
///
/// # Panics
/// If `keys` is not a chunk of `shape`.
pub fn store_keys(simd: Simd, shape: &AttentionShape, head: usize, dim: usize, block: &[f32], keys: &mut [f32]) {
    let columns = Tiling::of(simd).columns;
    assert_eq!(keys.len(), shape.chunk_len(), "not one chunk of keys");
    let head = &mut keys[head * shape.head_len()..][..shape.head_len()];
    for (token, row) in block.chunks_exact(columns).enumerate() {
        let panel = &mut head[token / columns * shape.head_dim * columns..][..shape.head_dim * columns];
        for (offset, &value) in row.iter().enumerate() {
            panel[(dim + offset) * columns + token % columns] = value;
        }
    }
}

/// As [`store_keys`], for values.
///
/// # Panics
/// If `values` is not a chunk of `shape`.
pub fn store_values(simd: Simd, shape: &AttentionShape, head: usize, dim: usize, block: &[f32], values: &mut [f32]) {
    let columns = Tiling::of(simd).columns;
    assert_eq!(values.len(), shape.chunk_len(), "not one chunk of values");
    let panel = head * shape.head_len() + dim / columns * shape.chunk_rows * columns;
    values[panel..panel + block.len()].copy_from_slice(block);
}

/// Scores of `rows` query rows of one head over every key, `[rows, padded tokens]`; places beyond the last token hold
/// nothing of use.
fn score(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    queries: Rows<'_>,
    rows: usize,
    keys: &[f32],
    out: &mut [f32],
) {
    let columns = Tiling::of(simd).columns;
    let (panel_len, per_chunk) = (shape.head_dim * columns, shape.chunk_rows / columns);
    for panel in 0..shape.tokens.div_ceil(columns) {
        let at = panel / per_chunk * shape.chunk_len() + head * shape.head_len() + panel % per_chunk * panel_len;
        let right = Panel::whole(&keys[at..at + panel_len], shape.head_dim);
        multiply_panel(simd, rows, queries, right, &mut out[panel * columns..], shape.padded_tokens(), false);
    }
}

/// Attention of `rows` query rows (whole register tiles) of one head. `queries` and `out` are `[rows, ..]` with row `i`
/// at `i * stride` and this head's dimensions first; `keys` and `values` are all chunks of the image.
///
/// # Panics
/// If a slice is shorter than `shape` says.
#[allow(clippy::too_many_arguments)]
pub fn attend(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    queries: Rows<'_>,
    rows: usize,
    (keys, values): (&[f32], &[f32]),
    scratch: &mut [f32],
    out: &mut [f32],
) {
    let columns = Tiling::of(simd).columns;
    let (width, group) = (shape.padded_tokens(), shape.group_rows(simd));
    let mut reciprocals = [0.0f32; 128];
    for first in (0..rows).step_by(group) {
        let count = group.min(rows - first);
        let group_queries = Rows { data: &queries.data[first * queries.stride..], stride: queries.stride };
        score(simd, shape, head, group_queries, count, keys, scratch);
        for (row, reciprocal) in scratch.chunks_exact_mut(width).zip(&mut reciprocals[..count]) {
            *reciprocal = exponentiate_row(simd, &mut row[..shape.tokens]);
        }
        let out = &mut out[first * queries.stride..];
        for dim in (0..shape.head_dim).step_by(columns) {
            let panel = Panel {
                data: &values[head * shape.head_len() + dim * shape.chunk_rows..],
                k: shape.tokens,
                segment_rows: shape.chunk_rows,
                segment_stride: shape.chunk_len(),
            };
            let weights = Rows { data: scratch, stride: width };
            multiply_panel(simd, count, weights, panel, &mut out[dim..], queries.stride, false);
        }
        scale_rows(&reciprocals[..count], shape.head_dim, out, queries.stride);
    }
}

/// Softmax attention of the first query row of one head over every token, written to `out` (`[tokens]`).
///
/// # Panics
/// If a slice is shorter than `shape` says.
pub fn first_row_attention(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    queries: Rows<'_>,
    keys: &[f32],
    scratch: &mut [f32],
    out: &mut [f32],
) {
    score(simd, shape, head, queries, Tiling::of(simd).rows, keys, scratch);
    out.copy_from_slice(&scratch[..shape.tokens]);
    let reciprocal = exponentiate_row(simd, out);
    scale_rows(&[reciprocal], shape.tokens, out, shape.tokens);
}

/// Blocked attention against the definition in f64, on a token count that fills no panel.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    (1..4).try_for_each(|extra| compare_with_definition(simd, chunk_rows(simd) + 10 * extra + 1, 2, 32))
}

fn compare_with_definition(simd: Simd, tokens: usize, heads: usize, head_dim: usize) -> Result<(), String> {
    use super::testing::{differ, ramp};
    let columns = Tiling::of(simd).columns;
    let shape = AttentionShape { tokens, heads, head_dim, chunk_rows: chunk_rows(simd) };
    let (dim, padded) = (heads * head_dim, shape.padded_tokens());
    let [queries, key_rows, value_rows] = [11, 12, 13].map(|seed| ramp(padded * dim, seed));
    let (mut keys, mut values) = (vec![f32::NAN; shape.chunks() * shape.chunk_len()], Vec::new());
    values.resize(keys.len(), f32::NAN);
    for chunk in 0..shape.chunks() {
        let places = chunk * shape.chunk_len()..(chunk + 1) * shape.chunk_len();
        let filled = (tokens - chunk * shape.chunk_rows).min(shape.chunk_rows);
        for column in (0..dim).step_by(columns) {
            let block = |rows: &[f32]| -> Vec<f32> {
                let row = |token: usize| &rows[(chunk * shape.chunk_rows + token) * dim + column..][..columns];
                (0..filled).flat_map(|token| row(token).iter().copied()).collect()
            };
            let (head, within) = (column / head_dim, column % head_dim);
            store_keys(simd, &shape, head, within, &block(&key_rows), &mut keys[places.clone()]);
            store_values(simd, &shape, head, within, &block(&value_rows), &mut values[places.clone()]);
        }
    }
    let rows = Tiling::of(simd).rows * 3;
    let (mut scratch, mut out) = (vec![f32::NAN; shape.scratch_len(simd)], vec![0.0; rows * dim]);
    let mut first = vec![0.0; tokens];
    for head in 0..heads {
        let at = head * head_dim;
        let left = Rows { data: &queries[at..], stride: dim };
        first_row_attention(simd, &shape, head, left, &keys, &mut scratch, &mut first);
        attend(simd, &shape, head, left, rows, (&keys, &values), &mut scratch, &mut out[at..]);
        for row in 0..rows {
            let dot = |token: usize| -> f64 {
                (0..head_dim)
                    .map(|i| f64::from(queries[row * dim + at + i]) * f64::from(key_rows[token * dim + at + i]))
                    .sum()
            };
            let weights: Vec<f64> = (0..tokens).map(|token| dot(token).exp2()).collect();
            let total: f64 = weights.iter().sum();
            for i in 0..head_dim {
                let mix = |token: usize| weights[token] / total * f64::from(value_rows[token * dim + at + i]);
                let (actual, expected) = (out[row * dim + at + i], (0..tokens).map(mix).sum());
                if differ(actual, expected, 1e-5) {
                    return Err(format!("{tokens} tokens, head {head}, row {row}: {actual} is not {expected}"));
                }
            }
            if let Some(token) = (0..tokens).find(|&t| row == 0 && differ(first[t], weights[t] / total, 1e-5)) {
                return Err(format!("{tokens} tokens, head {head}: weight {token} of the first row is off"));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn equals_the_definition(tokens in 1usize..180, heads in 1usize..3) {
            for simd in Simd::all() {
                prop_assert_eq!(compare_with_definition(simd, tokens, heads, 32), Ok(()));
            }
        }
    }
}

//! Softmax attention of a chunk of queries over all tokens of an image, one head at a time; no more
//! scores exist than those of a group of query rows, which stay in the second-level cache.
//!
//! A group of queries first meets every key panel (2 to 8 kB, first-level cache), then softmax runs
//! over its rows, then it meets the values. Queries carry the factor log2(e) / sqrt(head_dim).
//! Scores are products of f32, bf16 or int8, the mix of values one of f32 or bf16; softmax is in
//! f32.

mod layout;

use super::Simd;
use super::elementwise::{Epilogue, Product, exponentiate_row, finish_block, scale_rows};
use super::gemm::{PanelCodes, RightPanel, Tiling, multiply_panel};
use super::greatest_common_divisor;
use super::operand::{Format, LeftOperand, OperandBuffer, WordRows};
use super::simd::SimdLevel;
use layout::head_queries;
pub use layout::{
    AttentionShape, BlockPosition, store_key_codes, store_keys, store_query_codes, store_values,
};

/// Tokens of a chunk, whole register tiles and whole key panels, where `images` of so many tokens
/// are spread over `threads`. It changes how long they take and not what they give.
pub fn chunk_rows(simd: Simd, tokens: usize, images: usize, threads: usize) -> usize {
    let fewest = fewest_chunk_rows(simd);
    if simd.level() < SimdLevel::Amx {
        return fewest;
    }
    // Matrix registers are done with a chunk before the weights of the next layer are there: the
    // fewer chunks the better, as long as every thread has as much to do.
    let sizes = (1..=MOST_CHUNK_ROWS / fewest)
        .rev()
        .map(|count| count * fewest);
    sizes
        .min_by_key(|&rows| finished_after(rows, tokens, images, threads.max(1)))
        .unwrap_or(fewest)
}

/// Some dozens of rows: enough that fetching a panel of weights does not take longer than
/// multiplying with it in vector registers.
fn fewest_chunk_rows(simd: Simd) -> usize {
    let tile = Tiling::of(simd);
    let common = tile.rows / greatest_common_divisor(tile.rows, tile.columns) * tile.columns;
    common * 48usize.div_ceil(common)
}

/// WordRows of a chunk whose tokens, packed and not, and a slice of whose hidden layer leave room for
/// weights in a second-level cache of 2 MB; twice as many are no faster, and spread worse.
const MOST_CHUNK_ROWS: usize = 192;

/// WordRows that take as long as it takes to fetch the weights they are multiplied with.
const ROWS_OF_WEIGHTS: usize = 64;

/// When the last thread is done with one layer, in units of a row, if chunks have so many rows.
fn finished_after(rows: usize, tokens: usize, images: usize, threads: usize) -> usize {
    let time = |rows: usize| if rows == 0 { 0 } else { rows + ROWS_OF_WEIGHTS };
    let (whole, full, rest) = (images * (tokens / rows), time(rows), time(tokens % rows));
    let (each, busier) = (whole / threads, whole % threads);
    if busier == 0 {
        return each * full + images.div_ceil(threads) * rest;
    }
    // What is left of the images falls to those who have a whole chunk less.
    let fits = rest == 0 || images <= (threads - busier) * (full / rest);
    (each + 1) * full + if fits { 0 } else { rest }
}

/// Query rows of a group at most: whole tiles of every level.
const GROUP_ROWS: usize = 96;

/// Floats that the scores of one group of query rows may take: a part of the second-level cache
/// that leaves room for a head's values to stream by. That cache has 512 kB or more, and 2 MB where
/// there are matrix registers.
fn group_scores(simd: Simd) -> usize {
    if simd.level() == SimdLevel::Amx {
        80 * 1024
    } else {
        40 * 1024
    }
}

impl AttentionShape {
    /// Floats of scratch that [`attend`] needs.
    pub fn scratch_len(&self, simd: Simd) -> usize {
        self.group_rows(simd) * (self.padded_tokens() + Tiling::of(simd).columns)
    }

    fn group_rows(&self, simd: Simd) -> usize {
        let tile = Tiling::of(simd).rows;
        (group_scores(simd) / self.padded_tokens() / tile * tile)
            .clamp(tile, self.chunk_rows.min(GROUP_ROWS))
    }
}

/// Scores of `rows` query rows of one head over every key, `[rows, padded tokens]`; places beyond
/// the last token hold nothing of use. `block` has room for `rows` rows of a panel.
#[allow(
    clippy::too_many_arguments,
    reason = "a kernel's operands; each is used once"
)]
fn score(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    queries: LeftOperand<'_>,
    rows: usize,
    keys: &[u32],
    block: &mut [f32],
    out: &mut [f32],
) {
    let (columns, words, stride) = (
        Tiling::of(simd).columns,
        shape.head_words(),
        shape.padded_tokens(),
    );
    let (panel_len, per_chunk) = (shape.panel_rows() * columns, shape.chunk_rows / columns);
    for panel in 0..shape.tokens.div_ceil(columns) {
        let at = panel / per_chunk * shape.keys_len()
            + head * shape.head_keys()
            + panel % per_chunk * panel_len;
        let (right, tail) = keys[at..at + panel_len].split_at(words * columns);
        let (right, out) = (RightPanel::whole(right, words), &mut out[panel * columns..]);
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

/// Attention of the first `rows` rows (whole steps of [`Tiling`]) of a chunk's `queries`, for one
/// head. `out` is `[rows, ..]` with row `i` at `i * out_stride` and this head's dimensions first;
/// `keys` and `values` are all chunks of the image.
///
/// # Panics
/// If a slice is shorter than `shape` says.
#[allow(
    clippy::too_many_arguments,
    reason = "a kernel's operands; each is used once"
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
    let (width, group) = (shape.padded_tokens(), shape.group_rows(simd));
    let mut reciprocals = [0.0f32; GROUP_ROWS];
    let (block, scratch) = scratch[..shape.scratch_len(simd)].split_at_mut(group * columns);
    for first in (0..rows).step_by(group) {
        let count = group.min(rows - first);
        score(
            simd,
            shape,
            head,
            head_queries(shape, head, first, queries),
            count,
            keys,
            block,
            scratch,
        );
        for (row, reciprocal) in scratch
            .chunks_exact_mut(width)
            .zip(&mut reciprocals[..count])
        {
            *reciprocal = exponentiate_row(simd, shape.mix, &mut row[..shape.tokens]);
        }
        let out = &mut out[first * out_stride..];
        for dim in (0..shape.head_dim).step_by(columns) {
            let segment_rows = shape.mix.words(shape.chunk_rows);
            let panel = RightPanel {
                data: &values[head * shape.head_values() + dim * segment_rows..],
                k: shape.mix.words(shape.tokens),
                segment_rows,
                segment_stride: shape.values_len(),
            };
            let weights = WordRows::f32(scratch, width);
            multiply_panel(
                simd,
                shape.mix,
                count,
                weights,
                panel,
                &mut out[dim..],
                out_stride,
            );
        }
        scale_rows(&reciprocals[..count], shape.head_dim, out, out_stride);
    }
}

/// Softmax attention of the first query row of one head over every token, written to `out`
/// (`[tokens]`).
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
    let (block, scratch) = scratch.split_at_mut(tile.row_step * tile.columns);
    score(
        simd,
        shape,
        head,
        head_queries(shape, head, 0, queries),
        tile.row_step,
        keys,
        block,
        scratch,
    );
    out.copy_from_slice(&scratch[..shape.tokens]);
    let reciprocal = exponentiate_row(simd, Format::F32, out);
    scale_rows(&[reciprocal], shape.tokens, out, shape.tokens);
}

/// Formats of scores and of the mix that the encoder uses, as far as the level has them.
fn formats(simd: Simd) -> impl Iterator<Item = (Format, Format)> {
    let pairs = [
        (Format::F32, Format::F32),
        (Format::Bf16, Format::Bf16),
        (Format::Int8, Format::Bf16),
        (Format::Int8, Format::F32),
    ];
    pairs
        .into_iter()
        .filter(move |(scores, mix)| scores.is_available(simd) && mix.is_available(simd))
}

/// Blocked attention against the definition in f64, on a token count that fills no panel.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    for formats in formats(simd) {
        for extra in 1..4 {
            compare_with_definition(
                simd,
                formats,
                fewest_chunk_rows(simd) + 10 * extra + 1,
                2,
                32,
            )?;
        }
    }
    Ok(())
}

/// Queries, keys and values `[tokens, dim]` of one image, laid out as the encoder does.
fn lay_out(
    simd: Simd,
    shape: &AttentionShape,
    rows: [&[f32]; 3],
) -> (Vec<u32>, Vec<u32>, Vec<u32>) {
    let (columns, width) = (Tiling::of(simd).columns, shape.head_dim);
    let nothing = f32::NAN.to_bits();
    let mut queries = vec![nothing; shape.chunks() * shape.queries_len()];
    let mut keys = vec![nothing; shape.chunks() * shape.keys_len()];
    let mut values = vec![nothing; shape.chunks() * shape.values_len()];
    let mut buffer = OperandBuffer::default();
    for (chunk, head) in
        (0..shape.chunks()).flat_map(|chunk| (0..shape.heads).map(move |head| (chunk, head)))
    {
        let of = |len: usize| chunk * len..(chunk + 1) * len;
        let queries = &mut queries[of(shape.queries_len())];
        let keys = &mut keys[of(shape.keys_len())];
        let values = &mut values[of(shape.values_len())];
        // Whole steps are written, as the encoder does: beyond the last token there are finite
        // numbers.
        let filled = (shape.tokens - chunk * shape.chunk_rows).min(shape.chunk_rows);
        let filled = filled.next_multiple_of(Tiling::of(simd).row_step);
        let block = |rows: &[f32], from: usize, count: usize| -> Vec<f32> {
            let row = |token: usize| {
                (chunk * shape.chunk_rows + token) * shape.heads * width + head * width + from
            };
            (0..filled)
                .flat_map(|token| rows[row(token)..][..count].iter().copied())
                .collect()
        };
        let place = BlockPosition {
            head,
            dim: 0,
            token: 0,
        };
        if shape.scores == Format::Int8 {
            store_query_codes(simd, shape, place, &block(rows[0], 0, width), queries);
            store_key_codes(
                simd,
                shape,
                place,
                &block(rows[1], 0, width),
                &mut buffer,
                keys,
            );
        }
        for dim in (0..width).step_by(columns) {
            let (place, [query, key, value]) = (
                BlockPosition { dim, ..place },
                rows.map(|rows| block(rows, dim, columns)),
            );
            if shape.scores != Format::Int8 {
                let query = buffer
                    .pack(simd, shape.scores, filled, columns, (&query, columns))
                    .rows;
                for (row, words) in query.data.chunks_exact(query.stride).enumerate() {
                    let at = shape.query_at(BlockPosition {
                        token: row,
                        ..place
                    });
                    queries[at..at + words.len()].copy_from_slice(words);
                }
                let key = buffer
                    .pack(simd, shape.scores, filled, columns, (&key, columns))
                    .rows;
                store_keys(simd, shape, place, key, keys);
            }
            let value = buffer
                .pack(simd, shape.mix, filled, columns, (&value, columns))
                .rows;
            store_values(simd, shape, place, value, values);
        }
    }
    (queries, keys, values)
}

fn compare_with_definition(
    simd: Simd,
    (scores, mix): (Format, Format),
    tokens: usize,
    heads: usize,
    head_dim: usize,
) -> Result<(), String> {
    use super::testing::{differ, ramp};
    let shape = AttentionShape {
        scores,
        mix,
        tokens,
        heads,
        head_dim,
        chunk_rows: fewest_chunk_rows(simd),
    };
    let (dim, padded) = (heads * head_dim, shape.padded_tokens());
    let [query_rows, key_rows, value_rows] = [11, 12, 13].map(|seed| ramp(padded * dim, seed));
    let (queries, keys, values) = lay_out(simd, &shape, [&query_rows, &key_rows, &value_rows]);
    // bf16 and int8 keep eight bits: of the scores, then of the weights.
    let (of_values, of_weights) = if scores == Format::F32 {
        (1e-5, 1e-5)
    } else {
        (2e-2, 5e-3)
    };
    let rows = Tiling::of(simd).rows * 3 - Tiling::of(simd).row_step;
    let (mut scratch, mut out) = (
        vec![f32::NAN; shape.scratch_len(simd)],
        vec![0.0; rows * dim],
    );
    let mut first = vec![0.0; tokens];
    for head in 0..heads {
        let at = head * head_dim;
        first_row_attention(
            simd,
            &shape,
            head,
            &queries,
            &keys,
            &mut scratch,
            &mut first,
        );
        attend(
            simd,
            &shape,
            head,
            (&queries, rows),
            (&keys, &values),
            &mut scratch,
            &mut out[at..],
            dim,
        );
        for row in 0..rows {
            let dot = |token: usize| -> f64 {
                (0..head_dim)
                    .map(|i| {
                        f64::from(query_rows[row * dim + at + i])
                            * f64::from(key_rows[token * dim + at + i])
                    })
                    .sum()
            };
            let weights: Vec<f64> = (0..tokens).map(|token| dot(token).exp2()).collect();
            let total: f64 = weights.iter().sum();
            for i in 0..head_dim {
                let share = |token: usize| {
                    weights[token] / total * f64::from(value_rows[token * dim + at + i])
                };
                let (actual, expected) = (out[row * dim + at + i], (0..tokens).map(share).sum());
                if differ(actual, expected, of_values) {
                    return Err(format!(
                        "{scores:?}, {mix:?}, {tokens} tokens, row {row}: {actual} is not {expected}"
                    ));
                }
            }
            let off = |t: &usize| row == 0 && differ(first[*t], weights[*t] / total, of_weights);
            if let Some(token) = (0..tokens).find(off) {
                return Err(format!(
                    "{scores:?}, {mix:?}, {tokens} tokens: weight {token} of the first row is off"
                ));
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
        fn equals_the_definition(tokens in 36usize..180, heads in 1usize..3) {
            for simd in Simd::all() {
                for formats in formats(simd) {
                    prop_assert_eq!(compare_with_definition(simd, formats, tokens, heads, 32), Ok(()));
                }
            }
        }

        #[test]
        fn chunks_are_whole_panels_and_keep_every_thread_busy(
            tokens in 1usize..3000, images in 1usize..10, threads in 1usize..33
        ) {
            for simd in Simd::all() {
                let (tile, rows) = (Tiling::of(simd), chunk_rows(simd, tokens, images, threads));
                prop_assert_eq!((rows % tile.rows, rows % tile.columns), (0, 0));
                let fewest = fewest_chunk_rows(simd);
                prop_assert!((fewest..=MOST_CHUNK_ROWS).contains(&rows), "{} rows", rows);
                if simd.level() == SimdLevel::Amx {
                    let after = |rows| finished_after(rows, tokens, images, threads);
                    prop_assert!(after(rows) <= after(fewest));
                }
            }
        }
    }

    #[test]
    fn the_slowest_thread_decides_how_long_a_layer_takes() {
        let time = |rows| rows + ROWS_OF_WEIGHTS;
        // Four whole chunks and one of a single token; five nearly equal ones; more threads than
        // chunks.
        assert_eq!(finished_after(192, 769, 1, 2), 2 * time(192) + time(1));
        assert_eq!(finished_after(160, 769, 1, 2), 2 * time(160) + time(129));
        assert_eq!(finished_after(64, 769, 1, 16), time(64));
        // The rests of three images beside the odd whole chunk, and too many of them.
        assert_eq!(finished_after(64, 64 + 1, 3, 2), 2 * time(64) + time(1));
        assert_eq!(finished_after(128, 128 + 1, 1, 2), time(128));
    }
}

//! Softmax attention of a chunk of queries over all tokens of an image, one head at a time; no more scores exist than
//! those of a group of query rows, which stay in the second-level cache.
//!
//! Keys and values lie as the two products read them, cut into chunks of [`chunk_rows`] tokens so that each chunk can be
//! written by the thread that computed it: keys `[chunk][head][key panel][words of head_dim][columns]`, values
//! `[chunk][head][value panel][words of chunk_rows][columns]`, panels `columns` wide as in [`Tiling`]. A group of queries
//! first meets every key panel (2 to 8 kB, first-level cache), then softmax runs over its rows, then it meets the
//! values. Queries carry the factor log2(e) / sqrt(head_dim). Both products are in f32 or bf16, softmax in f32.

use super::Simd;
use super::elementwise::{exponentiate_row, scale_rows};
use super::gemm::{Panel, Tiling, multiply_panel};
use super::greatest_common_divisor;
use super::operand::{Format, Rows};
use super::simd::SimdLevel;
use super::transpose::transpose;

/// Tokens of a chunk, whole register tiles and whole key panels, where `images` of so many tokens are spread over
/// `threads`. It changes how long they take and not what they give.
pub fn chunk_rows(simd: Simd, tokens: usize, images: usize, threads: usize) -> usize {
    let fewest = fewest_chunk_rows(simd);
    if simd.level() < SimdLevel::Amx {
        return fewest;
    }
    // Matrix registers are done with a chunk before the weights of the next layer are there: the fewer chunks the
    // better, as long as every thread has as much to do.
    let sizes = (1..=MOST_CHUNK_ROWS / fewest).rev().map(|count| count * fewest);
    sizes.min_by_key(|&rows| finished_after(rows, tokens, images, threads.max(1))).unwrap_or(fewest)
}

/// Some dozens of rows: enough that fetching a panel of weights does not take longer than multiplying with it in vector
/// registers.
fn fewest_chunk_rows(simd: Simd) -> usize {
    let tile = Tiling::of(simd);
    let common = tile.rows / greatest_common_divisor(tile.rows, tile.columns) * tile.columns;
    common * 48usize.div_ceil(common)
}

/// Rows of a chunk whose tokens, packed and not, and a slice of whose hidden layer leave room for weights in a
/// second-level cache of 2 MB; twice as many are no faster, and spread worse.
const MOST_CHUNK_ROWS: usize = 192;

/// Rows that take as long as it takes to fetch the weights they are multiplied with.
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

/// Floats that the scores of one group of query rows may take: a part of the second-level cache that leaves room for a
/// head's values to stream by. That cache has 512 kB or more, and 2 MB where there are matrix registers.
fn group_scores(simd: Simd) -> usize {
    if simd.level() == SimdLevel::Amx { 80 * 1024 } else { 40 * 1024 }
}

/// How the tokens of an image and their heads are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AttentionShape {
    /// Format of both products: f32 or bf16.
    pub format: Format,
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

    /// Words of one chunk's keys: all heads.
    pub fn keys_len(&self) -> usize {
        self.heads * self.head_keys()
    }

    /// Words of one chunk's values: all heads.
    pub fn values_len(&self) -> usize {
        self.heads * self.head_values()
    }

    /// Words of one token's queries: all heads.
    pub fn query_len(&self) -> usize {
        self.heads * self.head_words()
    }

    /// Where in a chunk's queries (`[chunk_rows, query_len]`) a block of their projection begins.
    pub fn query_at(&self, place: Place) -> usize {
        place.token * self.query_len() + place.head * self.head_words() + self.format.words(place.dim)
    }

    fn head_words(&self) -> usize {
        self.format.words(self.head_dim)
    }

    fn head_keys(&self) -> usize {
        self.head_words() * self.chunk_rows
    }

    fn head_values(&self) -> usize {
        self.format.words(self.chunk_rows) * self.head_dim
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
        (group_scores(simd) / self.padded_tokens() / tile * tile).clamp(tile, self.chunk_rows.min(GROUP_ROWS))
    }
}

/// Where a finished block of a projection belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    /// The head.
    pub head: usize,
    /// Its dimension that the block's first column is.
    pub dim: usize,
    /// The token of the chunk that the block's first row is; whole panels of keys.
    pub token: usize,
}

/// Writes finished rows of the key projection in the shape's format to their places in a chunk's keys.
///
/// # Panics
/// If `keys` is not a chunk of `shape`, or the place not the first of a panel.
pub fn store_keys(simd: Simd, shape: &AttentionShape, place: Place, block: Rows<'_>, keys: &mut [u32]) {
    let (columns, panel_len) = (Tiling::of(simd).columns, shape.head_words() * Tiling::of(simd).columns);
    assert_eq!(keys.len(), shape.keys_len(), "not one chunk of keys");
    assert_eq!(place.token % columns, 0, "keys are written by whole panels");
    let first = shape.format.words(place.dim) * columns;
    let head = &mut keys[place.head * shape.head_keys()..][..shape.head_keys()];
    let panels = head.chunks_exact_mut(panel_len).skip(place.token / columns);
    for (rows, panel) in block.data.chunks(columns * block.stride).zip(panels) {
        let size = (rows.len() / block.stride, block.stride);
        transpose(simd, (rows, block.stride), size, &mut panel[first..], columns);
    }
}

/// As [`store_keys`], for values: their words hold the same dimension of neighbouring tokens.
///
/// # Panics
/// If `values` is not a chunk of `shape`.
pub fn store_values(simd: Simd, shape: &AttentionShape, place: Place, block: Rows<'_>, values: &mut [u32]) {
    let columns = Tiling::of(simd).columns;
    assert_eq!(values.len(), shape.values_len(), "not one chunk of values");
    let words = |tokens: usize| shape.format.words(tokens);
    let row = place.dim / columns * words(shape.chunk_rows) + words(place.token);
    let panel = &mut values[place.head * shape.head_values() + row * columns..];
    if shape.format == Format::F32 {
        return panel[..block.data.len()].copy_from_slice(block.data);
    }
    for (pair, out) in block.data.chunks_exact(2 * block.stride).zip(panel.chunks_exact_mut(columns)) {
        let (first, second) = pair.split_at(block.stride);
        for ((out, first), second) in out.chunks_exact_mut(2).zip(first).zip(second) {
            out[0] = first & 0xffff | second << 16;
            out[1] = first >> 16 | second & 0xffff_0000;
        }
    }
}

/// Scores of `rows` query rows of one head over every key, `[rows, padded tokens]`; places beyond the last token hold
/// nothing of use.
fn score(
    simd: Simd,
    shape: &AttentionShape,
    head: usize,
    queries: Rows<'_>,
    rows: usize,
    keys: &[u32],
    out: &mut [f32],
) {
    let columns = Tiling::of(simd).columns;
    let (panel_len, per_chunk) = (shape.head_words() * columns, shape.chunk_rows / columns);
    for panel in 0..shape.tokens.div_ceil(columns) {
        let at = panel / per_chunk * shape.keys_len() + head * shape.head_keys() + panel % per_chunk * panel_len;
        let right = Panel::whole(&keys[at..at + panel_len], shape.head_words());
        let out = &mut out[panel * columns..];
        multiply_panel(simd, shape.format, rows, queries, right, out, shape.padded_tokens());
    }
}

/// The query rows of one head, `[rows, query_len]` from `first` on.
fn head_queries<'a>(shape: &AttentionShape, head: usize, first: usize, queries: &'a [u32]) -> Rows<'a> {
    Rows { data: &queries[first * shape.query_len() + head * shape.head_words()..], stride: shape.query_len() }
}

/// Attention of `rows` query rows (whole register tiles, `[rows, query_len]`) of one head. `out` is `[rows, ..]` with
/// row `i` at `i * out_stride` and this head's dimensions first; `keys` and `values` are all chunks of the image.
///
/// # Panics
/// If a slice is shorter than `shape` says.
#[allow(clippy::too_many_arguments, reason = "a kernel's operands; each is used once")]
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
    for first in (0..rows).step_by(group) {
        let count = group.min(rows - first);
        score(simd, shape, head, head_queries(shape, head, first, queries), count, keys, scratch);
        for (row, reciprocal) in scratch.chunks_exact_mut(width).zip(&mut reciprocals[..count]) {
            *reciprocal = exponentiate_row(simd, shape.format, &mut row[..shape.tokens]);
        }
        let out = &mut out[first * out_stride..];
        for dim in (0..shape.head_dim).step_by(columns) {
            let segment_rows = shape.format.words(shape.chunk_rows);
            let panel = Panel {
                data: &values[head * shape.head_values() + dim * segment_rows..],
                k: shape.format.words(shape.tokens),
                segment_rows,
                segment_stride: shape.values_len(),
            };
            let weights = Rows::f32(scratch, width);
            multiply_panel(simd, shape.format, count, weights, panel, &mut out[dim..], out_stride);
        }
        scale_rows(&reciprocals[..count], shape.head_dim, out, out_stride);
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
    queries: &[u32],
    keys: &[u32],
    scratch: &mut [f32],
    out: &mut [f32],
) {
    score(simd, shape, head, head_queries(shape, head, 0, queries), Tiling::of(simd).rows, keys, scratch);
    out.copy_from_slice(&scratch[..shape.tokens]);
    let reciprocal = exponentiate_row(simd, Format::F32, out);
    scale_rows(&[reciprocal], shape.tokens, out, shape.tokens);
}

/// Formats that both products can be in.
const FORMATS: [Format; 2] = [Format::F32, Format::Bf16];

/// Blocked attention against the definition in f64, on a token count that fills no panel.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    for format in FORMATS.into_iter().filter(|format| format.is_available(simd)) {
        for extra in 1..4 {
            compare_with_definition(simd, format, fewest_chunk_rows(simd) + 10 * extra + 1, 2, 32)?;
        }
    }
    Ok(())
}

/// Queries, keys and values `[tokens, dim]` of one image, laid out as the encoder does.
fn lay_out(simd: Simd, shape: &AttentionShape, rows: [&[f32]; 3]) -> (Vec<u32>, Vec<u32>, Vec<u32>) {
    use super::operand::OperandBuffer;
    let (columns, dim) = (Tiling::of(simd).columns, shape.heads * shape.head_dim);
    let nothing = f32::NAN.to_bits();
    let mut queries = vec![nothing; shape.padded_tokens() * shape.query_len()];
    let mut keys = vec![nothing; shape.chunks() * shape.keys_len()];
    let mut values = vec![nothing; shape.chunks() * shape.values_len()];
    for chunk in 0..shape.chunks() {
        let of = |len: usize| chunk * len..(chunk + 1) * len;
        // Whole tiles are written, as the encoder does: beyond the last token there are finite numbers.
        let filled = (shape.tokens - chunk * shape.chunk_rows).min(shape.chunk_rows);
        let filled = filled.next_multiple_of(Tiling::of(simd).rows);
        for column in (0..dim).step_by(columns) {
            let (head, within) = (column / shape.head_dim, column % shape.head_dim);
            let block = |rows: &[f32]| -> Vec<f32> {
                let row = |token: usize| &rows[(chunk * shape.chunk_rows + token) * dim + column..][..columns];
                (0..filled).flat_map(|token| row(token).iter().copied()).collect()
            };
            let blocks = rows.map(block);
            let mut buffers = [(); 3].map(|()| OperandBuffer::default());
            let [of_query, of_key, of_value] = &mut buffers;
            let block = |part: usize| (&blocks[part][..], columns);
            let query = of_query.pack(simd, shape.format, filled, columns, block(0)).rows;
            let key = of_key.pack(simd, shape.format, filled, columns, block(1)).rows;
            let value = of_value.pack(simd, shape.format, filled, columns, block(2)).rows;
            let place = Place { head, dim: within, token: 0 };
            let first = chunk * shape.chunk_rows * shape.query_len() + shape.query_at(place);
            for (row, words) in query.data.chunks_exact(query.stride).enumerate() {
                queries[first + row * shape.query_len()..][..words.len()].copy_from_slice(words);
            }
            store_keys(simd, shape, place, key, &mut keys[of(shape.keys_len())]);
            store_values(simd, shape, place, value, &mut values[of(shape.values_len())]);
        }
    }
    (queries, keys, values)
}

fn compare_with_definition(
    simd: Simd,
    format: Format,
    tokens: usize,
    heads: usize,
    head_dim: usize,
) -> Result<(), String> {
    use super::testing::{differ, ramp};
    let shape = AttentionShape { format, tokens, heads, head_dim, chunk_rows: fewest_chunk_rows(simd) };
    let (dim, padded) = (heads * head_dim, shape.padded_tokens());
    let [query_rows, key_rows, value_rows] = [11, 12, 13].map(|seed| ramp(padded * dim, seed));
    let (queries, keys, values) = lay_out(simd, &shape, [&query_rows, &key_rows, &value_rows]);
    // bf16 keeps eight bits: of the scores, then of the weights.
    let (of_values, of_weights) = if format == Format::F32 { (1e-5, 1e-5) } else { (2e-2, 5e-3) };
    let rows = Tiling::of(simd).rows * 3;
    let (mut scratch, mut out) = (vec![f32::NAN; shape.scratch_len(simd)], vec![0.0; rows * dim]);
    let mut first = vec![0.0; tokens];
    for head in 0..heads {
        let at = head * head_dim;
        first_row_attention(simd, &shape, head, &queries, &keys, &mut scratch, &mut first);
        attend(simd, &shape, head, (&queries, rows), (&keys, &values), &mut scratch, &mut out[at..], dim);
        for row in 0..rows {
            let dot = |token: usize| -> f64 {
                (0..head_dim)
                    .map(|i| f64::from(query_rows[row * dim + at + i]) * f64::from(key_rows[token * dim + at + i]))
                    .sum()
            };
            let weights: Vec<f64> = (0..tokens).map(|token| dot(token).exp2()).collect();
            let total: f64 = weights.iter().sum();
            for i in 0..head_dim {
                let mix = |token: usize| weights[token] / total * f64::from(value_rows[token * dim + at + i]);
                let (actual, expected) = (out[row * dim + at + i], (0..tokens).map(mix).sum());
                if differ(actual, expected, of_values) {
                    return Err(format!("{format:?}, {tokens} tokens, row {row}: {actual} is not {expected}"));
                }
            }
            let off = |t: &usize| row == 0 && differ(first[*t], weights[*t] / total, of_weights);
            if let Some(token) = (0..tokens).find(off) {
                return Err(format!("{format:?}, {tokens} tokens: weight {token} of the first row is off"));
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
                for format in FORMATS.into_iter().filter(|format| format.is_available(simd)) {
                    prop_assert_eq!(compare_with_definition(simd, format, tokens, heads, 32), Ok(()));
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
        // Four whole chunks and one of a single token; five nearly equal ones; more threads than chunks.
        assert_eq!(finished_after(192, 769, 1, 2), 2 * time(192) + time(1));
        assert_eq!(finished_after(160, 769, 1, 2), 2 * time(160) + time(129));
        assert_eq!(finished_after(64, 769, 1, 16), time(64));
        // The rests of three images beside the odd whole chunk, and too many of them.
        assert_eq!(finished_after(64, 64 + 1, 3, 2), 2 * time(64) + time(1));
        assert_eq!(finished_after(128, 128 + 1, 1, 2), time(128));
    }
}

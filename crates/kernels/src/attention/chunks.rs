//! How many tokens of an image are processed at once.
//!
//! The layers of the transformer run over chunks of tokens, which threads take one by one. In every
//! chunk the weights of a layer are fetched anew, so chunks must not be small; and chunks that do
//! not divide evenly among the threads leave some of them waiting for the last one.

use crate::gemm::Tiling;
use crate::{Simd, SimdLevel, greatest_common_divisor};

/// Tokens of a chunk, whole register tiles and whole panels of keys, when `images` of `tokens`
/// tokens each are spread over `threads`. The number changes how long they take, not what they
/// give.
pub fn chunk_rows(simd: Simd, tokens: usize, images: usize, threads: usize) -> usize {
    let fewest = fewest_rows(simd);
    if simd.level() < SimdLevel::Amx {
        return fewest;
    }
    // Products in matrix registers take less time than fetching the weights of a small chunk, so
    // chunks should be large, as long as all threads have equally much to do.
    let sizes = (1..=MOST_ROWS / fewest).rev().map(|count| count * fewest);
    let best = sizes.min_by_key(|&rows| finish_time(rows, tokens, images, threads.max(1)));
    best.unwrap_or(fewest)
}

/// Some dozens of rows, whole tiles and panels: with vector registers, multiplying so many rows
/// with a panel of weights takes longer than fetching the panel.
pub(super) fn fewest_rows(simd: Simd) -> usize {
    let tile = Tiling::of(simd);
    let common = tile.rows / greatest_common_divisor(tile.rows, tile.columns) * tile.columns;
    common * 48usize.div_ceil(common)
}

/// Most rows of a chunk. The tokens of such a chunk, packed and not, and a slice of its hidden
/// layer leave room for weights in a second-level cache of 2 MB. Twice as many rows are no faster,
/// and harder to divide among threads.
pub(super) const MOST_ROWS: usize = 192;

/// Fetching the weights for a chunk takes as long as multiplying this many rows with them.
pub(super) const WEIGHT_ROWS: usize = 64;

/// When the last thread has finished one layer if chunks have `rows` rows, in units of the time
/// that one row takes.
pub(super) fn finish_time(rows: usize, tokens: usize, images: usize, threads: usize) -> usize {
    let time_of = |rows: usize| if rows == 0 { 0 } else { rows + WEIGHT_ROWS };
    let whole_chunks = images * (tokens / rows);
    let whole_time = time_of(rows);
    // Every image ends in one chunk that is not whole, unless nothing is left for it.
    let last_time = time_of(tokens % rows);
    let each = whole_chunks / threads;
    let busier = whole_chunks % threads;
    if busier == 0 {
        return each * whole_time + images.div_ceil(threads) * last_time;
    }
    // The last chunks go to the threads with one whole chunk less, if they can take them all
    // meanwhile.
    let fits = last_time == 0 || images <= (threads - busier) * (whole_time / last_time);
    (each + 1) * whole_time + if fits { 0 } else { last_time }
}

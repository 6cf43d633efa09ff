//! How the queries, keys and values of an image lie in memory, and how finished blocks of their
//! projections are written there.
//!
//! The two products of attention read keys and values as packed right-hand sides. They are cut into
//! chunks of [`chunk_rows`](super::chunk_rows) tokens, so that the thread that computes a chunk can
//! write it without waiting for others. With panels `columns` wide as in [`Tiling`]:
//!
//! - queries of a chunk: `[chunk_rows][heads][words of head_dim]`;
//! - keys: `[chunks][heads][panels of chunk_rows][words of head_dim][columns]`;
//! - values: `[chunks][heads][panels of head_dim][words of chunk_rows][columns]`.
//!
//! In int8, a query and a key have one factor for all dimensions of their head. Each panel of keys
//! is followed by a row of factors and a row of the offsets that the 128 in the codes of queries
//! adds to sums. A chunk's queries are followed by their factors, `[heads][chunk_rows]`.

use crate::Simd;
use crate::gemm::{RightPanel, Tiling, multiply_panel};
use crate::operand::{Format, LeftOperand, OperandBuffer, WordRows, quantise_into};
use crate::transpose::{SourceBlock, transpose};

/// How the tokens of an image and their heads are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AttentionShape {
    /// Format of queries and keys.
    pub scores: Format,
    /// Format of attention weights and of values: f32 or bf16.
    pub mix: Format,
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

    /// Words of one chunk's queries, and of the factors of their codes.
    pub fn queries_len(&self) -> usize {
        let factors = if self.scores == Format::Int8 {
            self.heads
        } else {
            0
        };
        self.chunk_rows * (self.query_len() + factors)
    }

    /// Index in a chunk's queries, `[chunk_rows, query_len]`, at which a block of their projection
    /// begins.
    pub fn query_at(&self, position: BlockPosition) -> usize {
        position.token * self.query_len()
            + position.head * self.head_words()
            + self.scores.words(position.dim)
    }

    /// Index in a chunk's queries of the factor of one token's query, if there are factors.
    pub(super) fn query_factor_at(&self, head: usize, token: usize) -> usize {
        self.chunk_rows * (self.query_len() + head) + token
    }

    /// Words of one token's query or key in one head.
    pub(super) fn head_words(&self) -> usize {
        self.scores.words(self.head_dim)
    }

    /// Rows of a panel of keys, one word of each column, with those of factors and offsets.
    pub(super) fn panel_rows(&self) -> usize {
        self.head_words() + if self.scores == Format::Int8 { 2 } else { 0 }
    }

    /// Words of one chunk's keys in one head.
    pub(super) fn head_keys(&self) -> usize {
        self.panel_rows() * self.chunk_rows
    }

    /// Words of one chunk's values in one head.
    pub(super) fn head_values(&self) -> usize {
        self.mix.words(self.chunk_rows) * self.head_dim
    }

    /// Tokens of all chunks if the last one were full.
    pub(super) fn padded_tokens(&self) -> usize {
        self.chunks() * self.chunk_rows
    }
}

/// Which part of a chunk's queries, keys or values a finished block of their projection is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlockPosition {
    /// The head.
    pub head: usize,
    /// The dimension of the head that the block's first column holds.
    pub dim: usize,
    /// The token within the chunk that the block's first row holds. For keys it must be the first
    /// of a panel.
    pub token: usize,
}

/// Writes finished rows of the key projection, `[n, words]` in f32 or bf16, to a chunk's keys.
///
/// # Panics
/// If `keys` is not a chunk of `shape`, or the position not the start of a panel.
pub fn store_keys(
    simd: Simd,
    shape: &AttentionShape,
    position: BlockPosition,
    block: WordRows<'_>,
    keys: &mut [u32],
) {
    let columns = Tiling::of(simd).columns;
    let first = shape.scores.words(position.dim) * columns;
    for (rows, panel) in key_panels(simd, shape, position, block, keys) {
        let source = SourceBlock {
            words: rows,
            stride: block.stride,
            rows: rows.len() / block.stride,
            columns: block.stride,
        };
        transpose(simd, source, &mut panel[first..], columns);
    }
}

/// The rows of `block`, divided by panels of keys, each with the panel that they belong into.
fn key_panels<'a>(
    simd: Simd,
    shape: &AttentionShape,
    position: BlockPosition,
    block: WordRows<'a>,
    keys: &'a mut [u32],
) -> impl Iterator<Item = (&'a [u32], &'a mut [u32])> {
    let columns = Tiling::of(simd).columns;
    assert_eq!(keys.len(), shape.keys_len(), "not one chunk of keys");
    assert_eq!(
        position.token % columns,
        0,
        "keys are written by whole panels"
    );
    let head = &mut keys[position.head * shape.head_keys()..][..shape.head_keys()];
    let panels = head
        .chunks_exact_mut(shape.panel_rows() * columns)
        .skip(position.token / columns);
    block.data.chunks(columns * block.stride).zip(panels)
}

/// Quantises queries of one head, `[n, head_dim]` f32 from the position's token on, and writes the
/// codes to a chunk's queries.
///
/// # Panics
/// If `queries` is not a chunk of `shape`, or the scores are not int8.
pub fn store_query_codes(
    simd: Simd,
    shape: &AttentionShape,
    position: BlockPosition,
    rows: &[f32],
    queries: &mut [u32],
) {
    assert_eq!(
        (shape.scores, queries.len()),
        (Format::Int8, shape.queries_len()),
        "not one chunk of codes"
    );
    let (codes, factors) = queries.split_at_mut(shape.chunk_rows * shape.query_len());
    let factors =
        &mut factors[shape.query_factor_at(position.head, position.token) - codes.len()..];
    let factors = bytemuck::cast_slice_mut(&mut factors[..rows.len() / shape.head_dim]);
    let codes = (
        &mut codes[shape.query_at(BlockPosition { dim: 0, ..position })..],
        shape.query_len(),
    );
    quantise_into(simd, shape.head_dim, (rows, shape.head_dim), codes, factors);
}

/// As [`store_query_codes`], for a chunk's keys; `buffer` is scratch memory.
///
/// # Panics
/// As [`store_keys`], or if the scores are not int8.
pub fn store_key_codes(
    simd: Simd,
    shape: &AttentionShape,
    position: BlockPosition,
    rows: &[f32],
    buffer: &mut OperandBuffer,
    keys: &mut [u32],
) {
    assert_eq!(shape.scores, Format::Int8, "keys are not codes");
    let columns = Tiling::of(simd).columns;
    let words = shape.head_words();
    let width = shape.head_dim;
    let packed = buffer.pack(simd, Format::Int8, rows.len() / width, width, (rows, width));
    let factors = packed.factors.chunks(columns);
    for ((rows, panel), factors) in
        key_panels(simd, shape, position, packed.rows, keys).zip(factors)
    {
        let (codes, tail) = panel.split_at_mut(words * columns);
        let source = SourceBlock {
            words: rows,
            stride: words,
            rows: factors.len(),
            columns: words,
        };
        transpose(simd, source, codes, columns);
        // Subtracts 128 from each code, which leaves them signed.
        for word in codes.iter_mut() {
            *word ^= ZERO_CODES;
        }
        let (of_columns, offsets) = tail.split_at_mut(columns);
        of_columns[..factors.len()].copy_from_slice(bytemuck::cast_slice(factors));
        store_offsets(simd, RightPanel::whole(codes, words), offsets);
    }
}

/// Four codes of a left-hand side that stand for zero.
const ZERO_CODES: u32 = 0x8080_8080;

/// A query of zeros, as wide as a head of any backbone.
static ZERO_QUERY: [u32; 512] = [ZERO_CODES; 512];

/// Writes the sums that a query of zeros gives to `offsets`: every query's sums are too high by
/// them.
fn store_offsets(simd: Simd, panel: RightPanel<'_>, offsets: &mut [u32]) {
    let tile = Tiling::of(simd);
    let mut sums = [0.0; 16 * 32];
    let sums = &mut sums[..tile.row_step * tile.columns];
    multiply_panel(
        simd,
        Format::Int8,
        tile.row_step,
        WordRows {
            data: &ZERO_QUERY,
            stride: 0,
        },
        panel,
        sums,
        tile.columns,
    );
    offsets.copy_from_slice(bytemuck::cast_slice(&sums[..tile.columns]));
}

/// As [`store_keys`], for values: their words hold the same dimension of neighbouring tokens, where
/// those of the block hold neighbouring dimensions of the same token.
///
/// # Panics
/// If `values` is not a chunk of `shape`.
pub fn store_values(
    simd: Simd,
    shape: &AttentionShape,
    position: BlockPosition,
    block: WordRows<'_>,
    values: &mut [u32],
) {
    let columns = Tiling::of(simd).columns;
    assert_eq!(values.len(), shape.values_len(), "not one chunk of values");
    let words = |tokens: usize| shape.mix.words(tokens);
    let row = position.dim / columns * words(shape.chunk_rows) + words(position.token);
    let panel = &mut values[position.head * shape.head_values() + row * columns..];
    if shape.mix == Format::F32 {
        return panel[..block.data.len()].copy_from_slice(block.data);
    }
    for (pair, out) in block
        .data
        .chunks_exact(2 * block.stride)
        .zip(panel.chunks_exact_mut(columns))
    {
        let (first, second) = pair.split_at(block.stride);
        for ((out, first), second) in out.chunks_exact_mut(2).zip(first).zip(second) {
            out[0] = first & 0xffff | second << 16;
            out[1] = first >> 16 | second & 0xffff_0000;
        }
    }
}

/// The queries of one head in a chunk's queries, from row `first` on, as a left-hand side.
pub(super) fn head_queries<'a>(
    shape: &AttentionShape,
    head: usize,
    first: usize,
    queries: &'a [u32],
) -> LeftOperand<'a> {
    let at = shape.query_at(BlockPosition {
        head,
        dim: 0,
        token: first,
    });
    let factors = match shape.scores {
        Format::Int8 => bytemuck::cast_slice(&queries[shape.query_factor_at(head, first)..]),
        _ => &[],
    };
    LeftOperand {
        rows: WordRows {
            data: &queries[at..],
            stride: shape.query_len(),
        },
        factors,
    }
}

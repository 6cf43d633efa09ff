//! The self-check: attention against its definition in f64.

use super::chunks;
use super::{
    AttentionShape, BlockPosition, attend, first_row_attention, store_key_codes, store_keys,
    store_query_codes, store_values,
};
use crate::Simd;
use crate::gemm::Tiling;
use crate::operand::{Format, OperandBuffer};
use crate::testing::{differ, ramp};

/// The formats of scores and of the product with the values that the encoder uses, as far as the
/// level has them.
pub(super) fn formats(simd: Simd) -> impl Iterator<Item = (Format, Format)> {
    let pairs = [
        (Format::F32, Format::F32),
        (Format::Bf16, Format::Bf16),
        (Format::Int8, Format::Bf16),
        (Format::Int8, Format::F32),
    ];
    let available =
        move |(scores, mix): &(Format, Format)| scores.is_available(simd) && mix.is_available(simd);
    pairs.into_iter().filter(available)
}

/// Compares attention with its definition for numbers of tokens that do not fill a panel.
pub(crate) fn check(simd: Simd) -> Result<(), String> {
    for formats in formats(simd) {
        for extra in 1..4 {
            let tokens = chunks::fewest_rows(simd) + 10 * extra + 1;
            compare_with_definition(simd, formats, tokens, 2, 32)?;
        }
    }
    Ok(())
}

/// Queries, keys and values of an image, in the layout of the encoder.
struct LaidOut {
    queries: Vec<u32>,
    keys: Vec<u32>,
    values: Vec<u32>,
}

impl LaidOut {
    /// Lays out rows `[tokens, heads * head_dim]`. What is not written is NaN.
    fn new(simd: Simd, shape: &AttentionShape, [queries, keys, values]: [&[f32]; 3]) -> Self {
        let nothing = f32::NAN.to_bits();
        let mut laid_out = Self {
            queries: vec![nothing; shape.chunks() * shape.queries_len()],
            keys: vec![nothing; shape.chunks() * shape.keys_len()],
            values: vec![nothing; shape.chunks() * shape.values_len()],
        };
        let mut buffer = OperandBuffer::default();
        for chunk in 0..shape.chunks() {
            for head in 0..shape.heads {
                let source = HeadSource {
                    simd,
                    shape,
                    chunk,
                    head,
                };
                source.store_queries(queries, &mut buffer, &mut laid_out.queries);
                source.store_keys(keys, &mut buffer, &mut laid_out.keys);
                source.store_values(values, &mut buffer, &mut laid_out.values);
            }
        }
        laid_out
    }
}

/// One head of one chunk of tokens.
struct HeadSource<'a> {
    simd: Simd,
    shape: &'a AttentionShape,
    chunk: usize,
    head: usize,
}

impl HeadSource<'_> {
    /// Tokens that are written. As in the encoder these are whole steps, so that beyond the last
    /// token there are finite numbers.
    fn rows(&self) -> usize {
        let left = self.shape.tokens - self.chunk * self.shape.chunk_rows;
        let step = Tiling::of(self.simd).row_step;
        left.min(self.shape.chunk_rows).next_multiple_of(step)
    }

    /// Dimensions of the head from `dim` on, `count` of them, of every token.
    fn block(&self, rows: &[f32], dim: usize, count: usize) -> Vec<f32> {
        let AttentionShape {
            heads,
            head_dim,
            chunk_rows,
            ..
        } = *self.shape;
        let mut block = Vec::new();
        for token in 0..self.rows() {
            let row = (self.chunk * chunk_rows + token) * heads * head_dim;
            block.extend_from_slice(&rows[row + self.head * head_dim + dim..][..count]);
        }
        block
    }

    fn position(&self, dim: usize) -> BlockPosition {
        BlockPosition {
            head: self.head,
            dim,
            token: 0,
        }
    }

    /// The chunk's part of an array of `len` words for each chunk.
    fn part<'b>(&self, all: &'b mut [u32], len: usize) -> &'b mut [u32] {
        &mut all[self.chunk * len..][..len]
    }

    fn store_queries(&self, rows: &[f32], buffer: &mut OperandBuffer, out: &mut [u32]) {
        let Self { simd, shape, .. } = *self;
        let out = self.part(out, shape.queries_len());
        if shape.scores == Format::Int8 {
            let block = self.block(rows, 0, shape.head_dim);
            store_query_codes(simd, shape, self.position(0), &block, out);
            return;
        }
        let columns = Tiling::of(simd).columns;
        for dim in (0..shape.head_dim).step_by(columns) {
            let block = self.block(rows, dim, columns);
            let source = (&block[..], columns);
            let packed = buffer
                .pack(simd, shape.scores, self.rows(), columns, source)
                .rows;
            for (token, words) in packed.data.chunks_exact(packed.stride).enumerate() {
                let position = BlockPosition {
                    token,
                    ..self.position(dim)
                };
                out[shape.query_at(position)..][..words.len()].copy_from_slice(words);
            }
        }
    }

    fn store_keys(&self, rows: &[f32], buffer: &mut OperandBuffer, out: &mut [u32]) {
        let Self { simd, shape, .. } = *self;
        let out = self.part(out, shape.keys_len());
        if shape.scores == Format::Int8 {
            let block = self.block(rows, 0, shape.head_dim);
            store_key_codes(simd, shape, self.position(0), &block, buffer, out);
            return;
        }
        let columns = Tiling::of(simd).columns;
        for dim in (0..shape.head_dim).step_by(columns) {
            let block = self.block(rows, dim, columns);
            let source = (&block[..], columns);
            let packed = buffer
                .pack(simd, shape.scores, self.rows(), columns, source)
                .rows;
            store_keys(simd, shape, self.position(dim), packed, out);
        }
    }

    fn store_values(&self, rows: &[f32], buffer: &mut OperandBuffer, out: &mut [u32]) {
        let Self { simd, shape, .. } = *self;
        let out = self.part(out, shape.values_len());
        let columns = Tiling::of(simd).columns;
        for dim in (0..shape.head_dim).step_by(columns) {
            let block = self.block(rows, dim, columns);
            let source = (&block[..], columns);
            let packed = buffer
                .pack(simd, shape.mix, self.rows(), columns, source)
                .rows;
            store_values(simd, shape, self.position(dim), packed, out);
        }
    }
}

/// Queries, keys and values as rows of f32, `[tokens, heads * head_dim]`.
struct Reference {
    queries: Vec<f32>,
    keys: Vec<f32>,
    values: Vec<f32>,
}

impl Reference {
    /// The weights of one query row of a head over all tokens, before they are divided by their
    /// sum.
    fn weights(&self, shape: &AttentionShape, head: usize, row: usize) -> Vec<f64> {
        let dim = shape.heads * shape.head_dim;
        let first = head * shape.head_dim;
        let query = &self.queries[row * dim + first..][..shape.head_dim];
        let mut weights = Vec::new();
        for token in 0..shape.tokens {
            let key = &self.keys[token * dim + first..][..shape.head_dim];
            let products = query
                .iter()
                .zip(key)
                .map(|(&q, &k)| f64::from(q) * f64::from(k));
            weights.push(products.sum::<f64>().exp2());
        }
        weights
    }

    /// Element `i` of the head's mix of values by `weights`.
    fn mixed(&self, shape: &AttentionShape, head: usize, weights: &[f64], i: usize) -> f64 {
        let dim = shape.heads * shape.head_dim;
        let total: f64 = weights.iter().sum();
        let share = |(token, weight): (usize, &f64)| {
            weight / total * f64::from(self.values[token * dim + head * shape.head_dim + i])
        };
        weights.iter().enumerate().map(share).sum()
    }
}

/// Compares one head's results, `out`, and weights of the first row, `first`, with the definition.
fn compare_head(
    shape: &AttentionShape,
    head: usize,
    reference: &Reference,
    out: &[f32],
    first: &[f32],
) -> Result<(), String> {
    let AttentionShape {
        scores,
        mix,
        tokens,
        heads,
        head_dim,
        ..
    } = *shape;
    // bf16 and int8 keep eight bits: of the scores, then of the weights.
    let is_exact = scores == Format::F32;
    let value_tolerance = if is_exact { 1e-5 } else { 2e-2 };
    let weight_tolerance = if is_exact { 1e-5 } else { 5e-3 };
    for (row, out) in out.chunks(heads * head_dim).enumerate() {
        let weights = reference.weights(shape, head, row);
        for (i, &actual) in out[..head_dim].iter().enumerate() {
            let expected = reference.mixed(shape, head, &weights, i);
            if differ(actual, expected, value_tolerance) {
                return Err(format!(
                    "{scores:?}, {mix:?}, {tokens} tokens, row {row}: \
                     {actual} is not {expected}"
                ));
            }
        }
    }

    let weights = reference.weights(shape, head, 0);
    let total: f64 = weights.iter().sum();
    let is_off = |&token: &usize| differ(first[token], weights[token] / total, weight_tolerance);
    if let Some(token) = (0..tokens).find(is_off) {
        return Err(format!(
            "{scores:?}, {mix:?}, {tokens} tokens: weight {token} of the first row is off"
        ));
    }
    Ok(())
}

/// Compares attention in the given formats (scores, product with the values) with its definition.
pub(super) fn compare_with_definition(
    simd: Simd,
    (scores, mix): (Format, Format),
    tokens: usize,
    heads: usize,
    head_dim: usize,
) -> Result<(), String> {
    let shape = AttentionShape {
        scores,
        mix,
        tokens,
        heads,
        head_dim,
        chunk_rows: chunks::fewest_rows(simd),
    };
    let dim = heads * head_dim;
    let len = shape.padded_tokens() * dim;
    let reference = Reference {
        queries: ramp(len, 11),
        keys: ramp(len, 12),
        values: ramp(len, 13),
    };
    let sources = [&reference.queries[..], &reference.keys, &reference.values];
    let laid_out = LaidOut::new(simd, &shape, sources);
    let rows = Tiling::of(simd).rows * 3 - Tiling::of(simd).row_step;
    let mut scratch = vec![f32::NAN; shape.scratch_len(simd)];
    let mut out = vec![0.0; rows * dim];
    let mut first = vec![0.0; tokens];
    for head in 0..heads {
        let LaidOut {
            queries,
            keys,
            values,
        } = &laid_out;
        first_row_attention(simd, &shape, head, queries, keys, &mut scratch, &mut first);
        let out = &mut out[head * head_dim..];
        attend(
            simd,
            &shape,
            head,
            (queries, rows),
            (keys, values),
            &mut scratch,
            out,
            dim,
        );

        compare_head(&shape, head, &reference, out, &first)?;
    }
    Ok(())
}

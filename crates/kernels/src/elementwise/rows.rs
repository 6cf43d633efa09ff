//! LayerNorm and softmax of a row, generic over the instruction set.

use super::polynomials::{EXP2, EXP2_SHORT, exp2};
use crate::registers::{Bf16Isa, FloatVector, VectorIsa};

/// LayerNorm of one row; see [`super::normalize_rows`].
#[inline(always)]
pub(super) fn normalize<I: VectorIsa>(isa: I, row: &[f32], epsilon: f32, out: &mut [f32]) {
    let count = row.len() as f32;
    let mean = fold(isa, row, 0.0, |sum, value| sum.add(value)) / count;
    let center = isa.splat(mean);
    let add_square = |sum: I::Floats, value: I::Floats| {
        let difference = value.sub(center);
        difference.mul_add(difference, sum)
    };
    // Filled up with the mean, which differs from it by nothing.
    let variance = fold(isa, row, mean, add_square) / count;
    let scale = isa.splat(1.0 / (variance + epsilon).sqrt());

    let mut places = out.chunks_exact_mut(I::Floats::COUNT);
    let values = row.chunks_exact(I::Floats::COUNT);
    let rest = values.remainder();
    for (values, place) in values.zip(&mut places) {
        isa.load(values).sub(center).mul(scale).store(place);
    }
    if !rest.is_empty() {
        let normalized = isa.load_partial(rest, 0.0).sub(center).mul(scale);
        normalized.store_partial(places.into_remainder());
    }
}

/// Combines a row vector by vector, then sums the elements of the result. The last vector is filled
/// up with `fill`, which must add nothing.
#[inline(always)]
fn fold<I: VectorIsa>(
    isa: I,
    row: &[f32],
    fill: f32,
    add: impl Fn(I::Floats, I::Floats) -> I::Floats,
) -> f32 {
    let values = row.chunks_exact(I::Floats::COUNT);
    let rest = values.remainder();
    let mut sum = isa.splat(0.0);
    for values in values {
        sum = add(sum, isa.load(values));
    }
    if !rest.is_empty() {
        sum = add(sum, isa.load_partial(rest, fill));
    }
    sum.sum()
}

/// Where the results of softmax go. A result may overwrite only scores that were read before.
trait Weights<I: VectorIsa> {
    /// The polynomial that is exact enough for the results' format.
    const POLYNOMIAL: &'static [f32];

    /// Writes a whole vector of results for the scores from `at` on.
    fn store(isa: I, values: I::Floats, scores: &mut [f32], at: usize);

    /// Writes the last results, those of the scores from `at` on, which fill no vector; elements
    /// of `values` beyond them are zero.
    fn store_last(isa: I, values: I::Floats, scores: &mut [f32], at: usize);
}

/// Results of 32 bits each, in the places of the scores.
struct F32Weights;

impl<I: VectorIsa> Weights<I> for F32Weights {
    const POLYNOMIAL: &'static [f32] = &EXP2;

    #[inline(always)]
    fn store(_: I, values: I::Floats, scores: &mut [f32], at: usize) {
        values.store(&mut scores[at..]);
    }

    #[inline(always)]
    fn store_last(_: I, values: I::Floats, scores: &mut [f32], at: usize) {
        values.store_partial(&mut scores[at..]);
    }
}

/// Results of 16 bits each, in the first half of the row.
struct Bf16Weights;

impl<I: Bf16Isa> Weights<I> for Bf16Weights {
    const POLYNOMIAL: &'static [f32] = &EXP2_SHORT;

    #[inline(always)]
    fn store(isa: I, values: I::Floats, scores: &mut [f32], at: usize) {
        let words: &mut [u32] = bytemuck::cast_slice_mut(scores);
        isa.store_bf16(values, &mut words[at / 2..]);
    }

    #[inline(always)]
    fn store_last(isa: I, values: I::Floats, scores: &mut [f32], at: usize) {
        let words: &mut [u32] = bytemuck::cast_slice_mut(scores);
        let end = words.len().div_ceil(2);
        isa.store_bf16_partial(values, &mut words[at / 2..end]);
    }
}

/// See [`super::exponentiate_row`].
#[inline(always)]
pub(super) fn exponentiate_f32<I: VectorIsa>(isa: I, scores: &mut [f32]) -> f32 {
    exponentiate::<I, F32Weights>(isa, scores)
}

/// See [`super::exponentiate_row`].
#[inline(always)]
pub(super) fn exponentiate_bf16<I: Bf16Isa>(isa: I, scores: &mut [f32]) -> f32 {
    exponentiate::<I, Bf16Weights>(isa, scores)
}

#[inline(always)]
fn exponentiate<I: VectorIsa, W: Weights<I>>(isa: I, scores: &mut [f32]) -> f32 {
    let count = I::Floats::COUNT;
    let len = scores.len();
    let whole_pairs = len / (2 * count) * (2 * count);
    let whole = len / count * count;

    let highest = isa.splat(maximum(isa, scores));
    let power = |value: I::Floats| exp2(isa, value.sub(highest), W::POLYNOMIAL);

    // Two sums, so that an addition need not wait for the one before it.
    let mut sums = [isa.splat(0.0); 2];
    for at in (0..whole_pairs).step_by(2 * count) {
        for (half, sum) in sums.iter_mut().enumerate() {
            let at = at + half * count;
            let value = power(isa.load(&scores[at..]));
            W::store(isa, value, scores, at);
            *sum = sum.add(value);
        }
    }
    if whole_pairs < whole {
        let value = power(isa.load(&scores[whole_pairs..]));
        W::store(isa, value, scores, whole_pairs);
        sums[0] = sums[0].add(value);
    }
    if whole < len {
        let value = power(isa.load_partial(&scores[whole..], 0.0));
        let value = isa.keep_first(value, len - whole);
        sums[1] = sums[1].add(value);
        W::store_last(isa, value, scores, whole);
    }
    1.0 / sums[0].add(sums[1]).sum()
}

/// The largest of the scores. A NaN among them may or may not be passed over: it makes the sum of
/// the powers NaN in either case.
#[inline(always)]
fn maximum<I: VectorIsa>(isa: I, scores: &[f32]) -> f32 {
    let count = I::Floats::COUNT;
    let mut highest = [isa.splat(f32::NEG_INFINITY); 2];
    let pairs = scores.chunks_exact(2 * count);
    let rest = pairs.remainder();
    for pair in pairs {
        let (low, high) = pair.split_at(count);
        highest[0] = highest[0].max(isa.load(low));
        highest[1] = highest[1].max(isa.load(high));
    }
    for values in rest.chunks(count) {
        let values = isa.load_partial(values, f32::NEG_INFINITY);
        highest[0] = highest[0].max(values);
    }
    highest[0].max(highest[1]).maximum()
}

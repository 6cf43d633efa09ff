//! The three loops in vectors, one sample or point in each lane, generic over the instruction set.

use super::pairs::CheckedSamples;
use super::{COUNTING_STRIDE, Hypotheses, LANES, PointPairs, Sample};
use crate::registers::{FloatVector, VectorIsa};

/// What homographies need of an instruction set beyond [`VectorIsa`]. Masks have one bit for each
/// element.
pub(super) trait HomographyIsa: VectorIsa {
    /// `dividend / divisor`.
    fn divide(self, dividend: Self::Floats, divisor: Self::Floats) -> Self::Floats;
    /// Magnitudes.
    fn abs(self, values: Self::Floats) -> Self::Floats;
    /// The exclusive or of the bits.
    fn xor(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    /// The or of the bits.
    fn or(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    /// `values`, negated where `sign` has its sign bit set.
    fn negate_by_sign(self, values: Self::Floats, sign: Self::Floats) -> Self::Floats;
    /// Where the sign bit is set.
    fn sign_bits(self, values: Self::Floats) -> u32;
    /// Where `a > b`.
    fn greater(self, a: Self::Floats, b: Self::Floats) -> u32;
    /// Where `a <= b` and `factor > 0`.
    fn at_most_and_positive(self, a: Self::Floats, b: Self::Floats, factor: Self::Floats) -> u32;
    /// One corner of as many samples as a vector has elements, from sample `from` on: x, y, u, v.
    fn corner(self, samples: &CheckedSamples<'_>, from: usize, corner: usize) -> [Self::Floats; 4];
}

/// The corners of as many samples as a vector has elements, from sample `from` on:
/// `[axis][corner]`.
#[inline(always)]
fn corners<I: HomographyIsa>(
    isa: I,
    samples: &CheckedSamples<'_>,
    from: usize,
) -> [[I::Floats; 4]; 4] {
    let a = isa.corner(samples, from, 0);
    let b = isa.corner(samples, from, 1);
    let c = isa.corner(samples, from, 2);
    let d = isa.corner(samples, from, 3);
    [
        [a[0], b[0], c[0], d[0]],
        [a[1], b[1], c[1], d[1]],
        [a[2], b[2], c[2], d[2]],
        [a[3], b[3], c[3], d[3]],
    ]
}

/// Twice the signed areas of the four triangles of four corners, as in the scalar code.
#[inline(always)]
fn twice_areas<F: FloatVector>(x: &[F; 4], y: &[F; 4]) -> [F; 4] {
    [
        twice_area(x, y, [3, 1, 2]),
        twice_area(x, y, [0, 3, 2]),
        twice_area(x, y, [0, 1, 3]),
        twice_area(x, y, [0, 1, 2]),
    ]
}

#[inline(always)]
fn twice_area<F: FloatVector>(x: &[F; 4], y: &[F; 4], [a, b, c]: [usize; 3]) -> F {
    let one_way = x[b].sub(x[a]).mul(y[c].sub(y[a]));
    let other_way = x[c].sub(x[a]).mul(y[b].sub(y[a]));
    one_way.sub(other_way)
}

/// One row of the adjugate of the first three corners.
#[inline(always)]
fn adjugate_row<F: FloatVector>(x: &[F; 4], y: &[F; 4], a: usize, b: usize) -> [F; 3] {
    [
        y[a].sub(y[b]),
        x[b].sub(x[a]),
        x[a].mul(y[b]).sub(x[b].mul(y[a])),
    ]
}

/// The sum of the terms of the first three corners, times their coordinates on one axis.
#[inline(always)]
fn weighted_sum<F: FloatVector>(axis: &[F; 4], [p, q, r]: [F; 3]) -> F {
    axis[0].mul(p).add(axis[1].mul(q)).add(axis[2].mul(r))
}

/// See [`super::proper`].
#[inline(always)]
pub(super) fn proper<I: HomographyIsa>(
    isa: I,
    pairs: &PointPairs,
    samples: &[Sample; LANES],
    min_area: f32,
) -> u32 {
    let samples = CheckedSamples::new(pairs, samples);
    let min_area = isa.splat(min_area);
    let mut bits = 0;
    for from in (0..LANES).step_by(I::Floats::COUNT) {
        let [x, y, u, v] = corners(isa, &samples, from);
        let before = twice_areas(&x, &y);
        let after = twice_areas(&u, &v);
        let mut smallest = isa.abs(before[0]);
        let mut orientations_differ = isa.xor(before[0], after[0]);
        for (&before, &after) in before.iter().zip(&after) {
            smallest = isa.abs(before).min(smallest);
            smallest = isa.abs(after).min(smallest);
            orientations_differ = isa.or(isa.xor(before, after), orientations_differ);
        }
        let large = isa.greater(smallest, min_area);
        bits |= (large & !isa.sign_bits(orientations_differ)) << from;
    }
    bits
}

/// See [`super::solve`]; the formula is explained in the scalar code.
#[expect(
    clippy::needless_range_loop,
    reason = "a column indexes the rows of the matrix and the entries of the result"
)]
#[inline(always)]
pub(super) fn solve<I: HomographyIsa>(
    isa: I,
    pairs: &PointPairs,
    samples: &[Sample; LANES],
) -> Hypotheses {
    let samples = CheckedSamples::new(pairs, samples);
    let mut out = Hypotheses {
        entries: [[0.0; LANES]; 9],
    };
    for from in (0..LANES).step_by(I::Floats::COUNT) {
        let [x, y, u, v] = corners(isa, &samples, from);
        let before = twice_areas(&x, &y);
        let after = twice_areas(&u, &v);
        let rows = [
            adjugate_row(&x, &y, 1, 2),
            adjugate_row(&x, &y, 2, 0),
            adjugate_row(&x, &y, 0, 1),
        ];
        let mut weights = [before[3]; 3];
        for (corner, weight) in weights.iter_mut().enumerate() {
            let ratio = isa.divide(after[corner], before[corner]);
            *weight = isa.negate_by_sign(ratio, before[3]);
        }
        for column in 0..3 {
            let term = [
                weights[0].mul(rows[0][column]),
                weights[1].mul(rows[1][column]),
                weights[2].mul(rows[2][column]),
            ];
            let sum = term[0].add(term[1]).add(term[2]);
            weighted_sum(&u, term).store(&mut out.entries[column][from..]);
            weighted_sum(&v, term).store(&mut out.entries[3 + column][from..]);
            sum.store(&mut out.entries[6 + column][from..]);
        }
    }
    out
}

/// See [`super::count_inliers`].
#[inline(always)]
pub(super) fn count_inliers<I: HomographyIsa>(
    isa: I,
    pairs: &PointPairs,
    homography: &[f32; 9],
    floor: usize,
) -> usize {
    let mut entries = [isa.splat(0.0); 9];
    for (entry, &value) in entries.iter_mut().zip(homography) {
        *entry = isa.splat(value);
    }
    let [a, b, c, d, e, f, g, h, i] = entries;

    let vectors = |axis: usize| pairs.axis(axis).chunks_exact(I::Floats::COUNT);
    let queries = vectors(0).zip(vectors(1));
    let references = vectors(2).zip(vectors(3));
    let mut count = 0;
    for (number, ((x, y), (u, v))) in queries.zip(references).enumerate() {
        let point = number * I::Floats::COUNT;
        if point.is_multiple_of(COUNTING_STRIDE) && count + (pairs.len() - point) <= floor {
            return count;
        }
        let x = isa.load(x);
        let y = isa.load(y);
        let u = isa.load(u);
        let v = isa.load(v);
        let w = g.mul(x).add(h.mul(y)).add(i);
        let dx = a.mul(x).add(b.mul(y)).add(c).sub(u.mul(w));
        let dy = d.mul(x).add(e.mul(y)).add(f).sub(v.mul(w));
        let error = dx.mul(dx).add(dy.mul(dy));
        let inliers = isa.at_most_and_positive(error, w.mul(w), w);
        count += inliers.count_ones() as usize;
    }
    count
}

//! Portable code one sample or point at a time, and the reference for the other instruction sets.

use super::pairs::CheckedSamples;
use super::{COUNTING_STRIDE, Hypotheses, LANES, PointPairs, Sample};

/// See [`super::proper`].
pub(super) fn proper(pairs: &PointPairs, samples: &[Sample; LANES], min_area: f32) -> u32 {
    let samples = CheckedSamples::new(pairs, samples);
    let mut bits = 0;
    for sample in 0..LANES {
        bits |= u32::from(is_proper(&samples, sample, min_area)) << sample;
    }
    bits
}

fn is_proper(samples: &CheckedSamples<'_>, sample: usize, min_area: f32) -> bool {
    let [x, y, u, v] = corners(samples, sample);
    let before = twice_areas(&x, &y);
    let after = twice_areas(&u, &v);
    // Not `f32::min`, since NaN has to be treated as the vector instructions treat it.
    let smaller = |least: f32, area: &f32| {
        if area.abs() < least {
            area.abs()
        } else {
            least
        }
    };
    let smallest = before.iter().chain(&after).fold(before[0].abs(), smaller);
    let same_orientation = |(a, b): (&f32, &f32)| a.is_sign_negative() == b.is_sign_negative();
    smallest > min_area && before.iter().zip(&after).all(same_orientation)
}

/// The corners of a sample, `[axis][corner]`.
fn corners(samples: &CheckedSamples<'_>, sample: usize) -> [[f32; 4]; 4] {
    let four = [0, 1, 2, 3].map(|corner| samples.pair(sample, corner));
    std::array::from_fn(|axis| four.map(|pair| pair[axis]))
}

/// Twice the signed areas of the four triangles of four corners. In the first three, the fourth
/// corner replaces the first, second and third; the last is the triangle of the first three.
fn twice_areas(x: &[f32; 4], y: &[f32; 4]) -> [f32; 4] {
    let triangles = [[3, 1, 2], [0, 3, 2], [0, 1, 3], [0, 1, 2]];
    triangles.map(|[a, b, c]| (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a]))
}

/// See [`super::solve`].
///
/// The homography is `B diag(beta / alpha) adj(A)`. A and B hold the first three corners of either
/// image in homogeneous coordinates as columns, adj(A) is the adjugate of A, and alpha and beta are
/// the barycentric coordinates of the fourth corner, which are ratios of areas of triangles.
#[expect(
    clippy::needless_range_loop,
    reason = "a column indexes the rows of the matrix and the entries of the result"
)]
pub(super) fn solve(pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
    let samples = CheckedSamples::new(pairs, samples);
    let mut out = Hypotheses {
        entries: [[0.0; LANES]; 9],
    };
    for lane in 0..LANES {
        let [x, y, u, v] = corners(&samples, lane);
        let before = twice_areas(&x, &y);
        let after = twice_areas(&u, &v);
        let adjugate = |a: usize, b: usize| [y[a] - y[b], x[b] - x[a], x[a] * y[b] - x[b] * y[a]];
        let rows = [adjugate(1, 2), adjugate(2, 0), adjugate(0, 1)];
        // At corner i, w is weight i times the determinant of A. Giving the weights that
        // determinant's sign makes the scale positive.
        let sign = 1f32.copysign(before[3]);
        let weights = [0, 1, 2].map(|corner| sign * (after[corner] / before[corner]));
        for column in 0..3 {
            let term = [0, 1, 2].map(|corner| weights[corner] * rows[corner][column]);
            out.entries[column][lane] = u[0] * term[0] + u[1] * term[1] + u[2] * term[2];
            out.entries[3 + column][lane] = v[0] * term[0] + v[1] * term[1] + v[2] * term[2];
            out.entries[6 + column][lane] = term[0] + term[1] + term[2];
        }
    }
    out
}

/// See [`super::count_inliers`]; operations are in the order of the vector code.
pub(super) fn count_inliers(pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let mut count = 0;
    for point in 0..pairs.len() {
        if point % COUNTING_STRIDE == 0 && count + (pairs.len() - point) <= floor {
            return count;
        }
        let [x, y, u, v] = [0, 1, 2, 3].map(|axis| pairs.axis(axis)[point]);
        let w = (g * x + h * y) + i;
        let dx = ((a * x + b * y) + c) - u * w;
        let dy = ((d * x + e * y) + f) - v * w;
        count += usize::from((dx * dx + dy * dy <= w * w) & (w > 0.0));
    }
    count
}

//! Homographies from four correspondences, eight at a time, and counting who agrees with one.
//!
//! RANSAC (paper III-D) spends its time on these two loops. Coordinates are in units of the inlier tolerance, so that
//! a pair `(x, y) -> (u, v)` is an inlier of `H` if `w = g x + h y + i` is strictly positive and
//! `(a x + b y + c - u w)^2 + (d x + e y + f - v w)^2 <= w^2`: the one-directional transfer error without a division.
//!
//! Multiplications and additions are never fused, so that every level gives the same bits and a pair of images the
//! same score on every machine.

use super::simd::{Simd, SimdLevel};
#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// Samples solved at once.
pub const LANES: usize = 8;

/// Correspondences by coordinate, in units of the tolerance; the memory is kept when refilled.
#[derive(Debug, Clone, Default)]
pub struct PointPairs {
    /// As filled: what samples are taken from.
    pairs: Vec<[f32; 4]>,
    /// By axis: query x and y, reference x and y; padded to whole vectors with NaN, which is never an inlier.
    coordinates: [Vec<f32>; 4],
}

impl PointPairs {
    /// Replaces the correspondences by `(x, y, u, v)`.
    pub fn fill(&mut self, pairs: impl IntoIterator<Item = [f32; 4]>) {
        self.pairs.clear();
        self.pairs.extend(pairs);
        let padded = self.pairs.len().next_multiple_of(LANES);
        for (axis, all) in self.coordinates.iter_mut().enumerate() {
            all.clear();
            all.extend(self.pairs.iter().map(|pair| pair[axis]));
            all.resize(padded, f32::NAN);
        }
    }

    /// Number of correspondences.
    pub fn len(&self) -> usize {
        self.pairs.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }

    /// The correspondence `(x, y, u, v)` at `i`.
    ///
    /// # Panics
    /// Where there is none.
    #[inline(always)]
    pub fn get(&self, i: usize) -> [f32; 4] {
        self.pairs[i]
    }
}

/// Eight samples of four correspondences: `[axis x, y, u, v][corner][lane]`.
pub type Samples = [[[f32; LANES]; 4]; 4];

/// Eight homographies, entry by entry, row-major and up to a positive scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypotheses {
    /// `[entry][lane]`.
    pub entries: [[f32; LANES]; 9],
    /// Lanes whose sample is neither degenerate nor twisted.
    pub valid: [bool; LANES],
}

impl Hypotheses {
    /// The homography of one lane.
    #[inline(always)]
    pub fn get(&self, lane: usize) -> [f32; 9] {
        std::array::from_fn(|entry| self.entries[entry][lane])
    }
}

/// Solves eight samples.
///
/// A sample is valid if all four triangles of its corners have the same orientation in both images, and twice their
/// area is more than `min_area` in both. The first excludes quadrilaterals that no view of a plane turns into each
/// other (twisted, or mirrored as if seen from behind), and makes `w` positive at the corners; the second excludes
/// collinear and repeated corners.
pub fn solve_four(simd: Simd, samples: &Samples, min_area: f32) -> Hypotheses {
    match simd.level() {
        SimdLevel::Scalar => solve_lanes(samples, min_area),
        // SAFETY: the token proves AVX2, which AVX-512 includes.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 | SimdLevel::Avx512 => unsafe { solve_avx2(samples, min_area) },
        #[cfg(not(target_arch = "x86_64"))]
        level => unreachable!("a token for {level} cannot exist on this architecture"),
    }
}

/// The same operations in wider registers.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn solve_avx2(samples: &Samples, min_area: f32) -> Hypotheses {
    solve_lanes(samples, min_area)
}

/// `H = B diag(beta / alpha) adj(A)`, where `A` and `B` hold the first three corners in homogeneous coordinates as
/// columns, and `alpha`, `beta` are the fourth corner's barycentric coordinates: signed areas of triangles.
#[inline(always)]
fn solve_lanes(samples: &Samples, min_area: f32) -> Hypotheses {
    let mut out = Hypotheses { entries: [[0.0; LANES]; 9], valid: [false; LANES] };
    let [x, y, u, v] = samples;
    let (mut from_areas, mut to_areas) = ([[0f32; LANES]; 4], [[0f32; LANES]; 4]);
    for lane in 0..LANES {
        let twice_area = |px: &[[f32; LANES]; 4], py: &[[f32; LANES]; 4], a: usize, b: usize, c: usize| {
            (px[b][lane] - px[a][lane]) * (py[c][lane] - py[a][lane])
                - (px[c][lane] - px[a][lane]) * (py[b][lane] - py[a][lane])
        };
        let triangles = |px, py| {
            [
                twice_area(px, py, 3, 1, 2),
                twice_area(px, py, 0, 3, 2),
                twice_area(px, py, 0, 1, 3),
                twice_area(px, py, 0, 1, 2),
            ]
        };
        let (from, to) = (triangles(x, y), triangles(u, v));
        let mut valid = true;
        for t in 0..4 {
            valid &= (from[t] * to[t] > 0.0) & (from[t].abs() > min_area) & (to[t].abs() > min_area);
            (from_areas[t][lane], to_areas[t][lane]) = (from[t], to[t]);
        }
        out.valid[lane] = valid;
    }
    // Among false matches often none of the eight is valid.
    if out.valid == [false; LANES] {
        return out;
    }
    for lane in 0..LANES {
        let adjugate = |a: usize, b: usize| {
            [y[a][lane] - y[b][lane], x[b][lane] - x[a][lane], x[a][lane] * y[b][lane] - x[b][lane] * y[a][lane]]
        };
        let rows = [adjugate(1, 2), adjugate(2, 0), adjugate(0, 1)];
        // The sign of A's determinant makes the scale positive: w at corner i is weight_i times the determinant of A.
        let sign = 1f32.copysign(from_areas[3][lane]);
        let weights = [0, 1, 2].map(|corner| sign * (to_areas[corner][lane] / from_areas[corner][lane]));
        for column in 0..3 {
            let term = [0, 1, 2].map(|corner| weights[corner] * rows[corner][column]);
            out.entries[column][lane] = u[0][lane] * term[0] + u[1][lane] * term[1] + u[2][lane] * term[2];
            out.entries[3 + column][lane] = v[0][lane] * term[0] + v[1][lane] * term[1] + v[2][lane] * term[2];
            out.entries[6 + column][lane] = term[0] + term[1] + term[2];
        }
    }
    out
}

/// Counts the inliers of `homography`. Once it cannot exceed `floor` any more, counting may stop: what is returned is
/// then some number not above `floor`.
pub fn count_inliers(simd: Simd, pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    match simd.level() {
        SimdLevel::Scalar => count_scalar(pairs, homography, floor),
        // SAFETY: the token proves AVX2, which AVX-512 includes.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 | SimdLevel::Avx512 => unsafe { count_avx2(pairs, homography, floor) },
        #[cfg(not(target_arch = "x86_64"))]
        level => unreachable!("a token for {level} cannot exist on this architecture"),
    }
}

/// The definition, in the order of operations of the vector code.
fn count_scalar(pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let mut count = 0;
    for point in 0..pairs.len() {
        if point % STRIDE == 0 && count + (pairs.len() - point) <= floor {
            return count;
        }
        let [x, y, u, v] = pairs.get(point);
        let w = (g * x + h * y) + i;
        let dx = ((a * x + b * y) + c) - u * w;
        let dy = ((d * x + e * y) + f) - v * w;
        count += usize::from((dx * dx + dy * dy <= w * w) & (w > 0.0));
    }
    count
}

/// Points between two looks at whether counting can still succeed.
const STRIDE: usize = 4 * LANES;

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,popcnt")]
fn count_avx2(pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    let [a, b, c, d, e, f, g, h, i] = homography.map(|entry| _mm256_set1_ps(entry));
    let [x, y, u, v] = &pairs.coordinates;
    let padded = x.len();
    assert!(y.len() == padded && u.len() == padded && v.len() == padded && padded % LANES == 0);
    let mut count = 0;
    let mut point = 0;
    while point < padded {
        if point % STRIDE == 0 && count + (pairs.len() - point) <= floor {
            return count;
        }
        // SAFETY: `point + LANES <= padded`, the length of all four.
        let (x, y, u, v) = unsafe {
            (
                _mm256_loadu_ps(x.as_ptr().add(point)),
                _mm256_loadu_ps(y.as_ptr().add(point)),
                _mm256_loadu_ps(u.as_ptr().add(point)),
                _mm256_loadu_ps(v.as_ptr().add(point)),
            )
        };
        let row = |p, q, r| _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(p, x), _mm256_mul_ps(q, y)), r);
        let w = row(g, h, i);
        let dx = _mm256_sub_ps(row(a, b, c), _mm256_mul_ps(u, w));
        let dy = _mm256_sub_ps(row(d, e, f), _mm256_mul_ps(v, w));
        let error = _mm256_add_ps(_mm256_mul_ps(dx, dx), _mm256_mul_ps(dy, dy));
        let near = _mm256_cmp_ps::<_CMP_LE_OQ>(error, _mm256_mul_ps(w, w));
        let ahead = _mm256_cmp_ps::<_CMP_GT_OQ>(w, _mm256_setzero_ps());
        count += _mm256_movemask_ps(_mm256_and_ps(near, ahead)).count_ones() as usize;
        point += LANES;
    }
    count
}

/// Compares `simd` with the scalar twin on small odd inputs.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    for (n, seed) in [(4, 1), (5, 2), (37, 3), (131, 4)] {
        let pairs = sample_pairs(n, seed);
        let samples = samples_of(&pairs, seed);
        let (ours, twin) = (solve_four(simd, &samples, 1e-3), solve_lanes(&samples, 1e-3));
        let bits = |h: &Hypotheses, lane: usize| h.get(lane).map(f32::to_bits);
        let differs = |lane: usize| {
            ours.valid[lane] != twin.valid[lane] || (twin.valid[lane] && bits(&ours, lane) != bits(&twin, lane))
        };
        if (0..LANES).any(differs) {
            return Err(format!("four-point solutions among {n} correspondences"));
        }
        for lane in (0..LANES).filter(|&lane| twin.valid[lane]) {
            let homography = twin.get(lane);
            for floor in [0, n / 2, n] {
                let ours = count_inliers(simd, &pairs, &homography, floor);
                let twin = count_scalar(&pairs, &homography, floor);
                if ours != twin {
                    return Err(format!("{ours} instead of {twin} inliers among {n} correspondences"));
                }
            }
        }
    }
    Ok(())
}

/// Correspondences on a grid, half of them shifted alike and half anyhow.
fn sample_pairs(n: usize, seed: u64) -> PointPairs {
    let mut state = seed;
    let mut next = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) % 64
    };
    let mut pairs = PointPairs::default();
    pairs.fill((0..n).map(|i| {
        let (x, y) = (next() as f32 / 2.0, next() as f32 / 2.0);
        if i % 2 == 0 { [x, y, x + 1.25, y * 1.1 - 2.0] } else { [x, y, next() as f32 / 2.0, next() as f32 / 2.0] }
    }));
    pairs
}

/// Eight samples of `pairs`, with repeated corners among them.
fn samples_of(pairs: &PointPairs, seed: u64) -> Samples {
    let mut samples = [[[0.0; LANES]; 4]; 4];
    for lane in 0..LANES {
        for corner in 0..4 {
            let pair = pairs.get((seed as usize + 2 * lane * corner + corner * corner) % pairs.len());
            (0..4).for_each(|axis| samples[axis][corner][lane] = pair[axis]);
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn project(h: &[f32; 9], x: f32, y: f32) -> [f32; 3] {
        [0, 3, 6].map(|row| h[row] * x + h[row + 1] * y + h[row + 2])
    }

    fn one_sample(corners: [[f32; 4]; 4]) -> Samples {
        std::array::from_fn(|axis| std::array::from_fn(|corner| [corners[corner][axis]; LANES]))
    }

    const TRUE: [f32; 9] = [1.1, 0.1, -3.0, -0.05, 0.9, 2.0, 0.004, -0.002, 1.0];

    fn moved(points: [[f32; 2]; 4]) -> [[f32; 4]; 4] {
        points.map(|[x, y]| {
            let [u, v, w] = project(&TRUE, x, y);
            [x, y, u / w, v / w]
        })
    }

    #[test]
    fn four_corners_give_their_homography_with_positive_scale() {
        let square = [[0.0, 0.0], [30.0, 2.0], [28.0, 25.0], [-3.0, 22.0]];
        for order in [[0, 1, 2, 3], [3, 2, 1, 0], [0, 2, 1, 3]] {
            let corners = moved(order.map(|i| square[i]));
            let got = solve_four(Simd::SCALAR, &one_sample(corners), 0.01);
            assert!(got.valid[0], "{order:?}");
            let h = got.get(0);
            assert!(h[8] > 0.0);
            for (ours, truth) in h.iter().zip(TRUE) {
                assert!((ours / h[8] - truth).abs() < 1e-4, "{h:?}");
            }
        }
    }

    #[test]
    fn degenerate_twisted_and_mirrored_samples_are_not_valid() {
        let square = [[0.0, 0.0], [30.0, 0.0], [30.0, 25.0], [0.0, 25.0]];
        let straight = moved([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [5.0, 9.0]]);
        let repeated = moved([[0.0, 0.0], [0.0, 0.0], [20.0, 0.0], [5.0, 9.0]]);
        let mut twisted = moved(square);
        twisted[0][2..].copy_from_slice(&moved(square)[1][2..]);
        twisted[1][2..].copy_from_slice(&moved(square)[0][2..]);
        let mirrored = square.map(|[x, y]| [x, y, -x, y]);
        for corners in [straight, repeated, twisted, mirrored] {
            assert!(!solve_four(Simd::SCALAR, &one_sample(corners), 0.01).valid[0], "{corners:?}");
        }
    }

    #[test]
    fn inliers_lie_within_one_unit_and_in_front() {
        let mut pairs = PointPairs::default();
        pairs.fill([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.01, 0.0], [5.0, 5.0, 5.6, 5.7], [9.0, 9.0, 9.8, 9.8]]);
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let behind = identity.map(|entry: f32| -entry);
        for simd in Simd::all() {
            assert_eq!(count_inliers(simd, &pairs, &identity, 0), 2);
            assert_eq!(count_inliers(simd, &pairs, &behind, 0), 0);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]
        #[test]
        fn every_level_gives_the_bits_of_the_scalar_twin(n in 4usize..200, seed: u64, floor in 0usize..220) {
            let pairs = sample_pairs(n, seed);
            let samples = samples_of(&pairs, seed >> 8);
            let twin = solve_lanes(&samples, 0.1);
            for simd in Simd::all() {
                let ours = solve_four(simd, &samples, 0.1);
                prop_assert_eq!(ours.valid, twin.valid);
                for lane in (0..LANES).filter(|&lane| twin.valid[lane]) {
                    prop_assert_eq!(ours.get(lane).map(f32::to_bits), twin.get(lane).map(f32::to_bits));
                    prop_assert_eq!(
                        count_inliers(simd, &pairs, &ours.get(lane), floor),
                        count_scalar(&pairs, &ours.get(lane), floor)
                    );
                }
            }
        }
    }
}

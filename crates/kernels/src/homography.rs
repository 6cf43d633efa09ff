//! Homographies from four correspondences, many at a time, and counting who agrees with one.
//!
//! RANSAC (paper III-D) spends its time on three loops: drawing samples of four and telling which
//! of them can be corners of one plane seen twice (among false matches one in eight), solving
//! those, and counting inliers. Coordinates are in units of the inlier tolerance, so that a pair
//! `(x, y) -> (u, v)` is an inlier of `H` if `w = g x + h y + i` is strictly positive and `(a x + b
//! y + c - u w)^2 + (d x + e y + f - v w)^2 <= w^2`: the one-directional transfer error without a
//! division.
//!
//! Multiplications and additions are never fused, so that every level gives the same bits and a
//! pair of images the same score on every machine.

mod draw;
#[cfg(target_arch = "x86_64")]
mod vector;

use super::greatest_common_divisor;
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::simd::{Simd, SimdLevel};
pub use draw::{MOST_POSITIONS, Sampler};
#[cfg(target_arch = "x86_64")]
use vector::Vector;

/// Most samples screened at once, and solved at once.
pub const LANES: usize = 16;

/// The positions of four correspondences: the corners of two quadrilaterals.
pub type Sample = [u16; 4];

/// Correspondences by coordinate, in units of the tolerance; the memory is kept when refilled.
#[derive(Debug, Clone, Default)]
pub struct PointPairs {
    /// As filled: what samples are taken from.
    pairs: Vec<[f32; 4]>,
    /// By axis: query x and y, reference x and y; padded to whole vectors with NaN, which is never
    /// an inlier. In an order that spreads neighbours, so that inliers are as frequent in every
    /// stretch and counting can stop early.
    coordinates: [Vec<f32>; 4],
}

impl PointPairs {
    /// Replaces the correspondences by `(x, y, u, v)`.
    pub fn fill(&mut self, pairs: impl IntoIterator<Item = [f32; 4]>) {
        self.pairs.clear();
        self.pairs.extend(pairs);
        let len = self.pairs.len();
        let padded = len.next_multiple_of(LANES);
        let stride = spreading_stride(len);
        for (axis, all) in self.coordinates.iter_mut().enumerate() {
            all.clear();
            let mut at = 0;
            for _ in 0..len {
                all.push(self.pairs[at][axis]);
                at += stride;
                at -= if at >= len { len } else { 0 };
            }
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

    /// # Panics
    /// Where a sample names a correspondence that is not there: the vector code follows it without
    /// further checks.
    #[inline(always)]
    fn validate(&self, samples: &[Sample; LANES]) {
        // Without an early exit, so that it becomes vector code.
        let last = samples
            .as_flattened()
            .iter()
            .fold(0, |last: u16, &position| last.max(position));
        assert!(
            usize::from(last) < self.len(),
            "a sample names a pair that is not there"
        );
    }
}

/// A step through `len` positions that visits each once and never stays near: about the golden
/// section.
fn spreading_stride(len: usize) -> usize {
    (1..=len * 5 / 8)
        .rev()
        .find(|&stride| greatest_common_divisor(stride, len) == 1)
        .unwrap_or(1)
}

/// Homographies by lane, entry by entry, row-major and up to a positive scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypotheses {
    /// `[entry][lane]`.
    entries: [[f32; LANES]; 9],
}

impl Hypotheses {
    /// The homography of one lane.
    #[inline(always)]
    pub fn get(&self, lane: usize) -> [f32; 9] {
        std::array::from_fn(|entry| self.entries[entry][lane])
    }
}

/// Tells which of `samples` are proper: bit `i` of the result for sample `i`.
///
/// A sample is proper if all four triangles of its corners have the same orientation in both
/// images, and twice their area is more than `min_area` in both. The first excludes quadrilaterals
/// that no view of a plane turns into each other (twisted, or mirrored as if seen from behind), and
/// makes `w` positive at the corners; the second excludes collinear and repeated corners.
///
/// # Panics
/// If a sample names a correspondence that is not there, or `min_area` is negative.
pub fn proper(simd: Simd, pairs: &PointPairs, samples: &[Sample; LANES], min_area: f32) -> u32 {
    assert!(min_area >= 0.0, "twice an area is at least {min_area}");
    match simd.level() {
        SimdLevel::Scalar => proper_scalar(pairs, samples, min_area),
        // SAFETY: the token proves the level.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { proper_avx2(pairs, samples, min_area) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 | SimdLevel::Amx => unsafe { proper_avx512(pairs, samples, min_area) },
        #[cfg(not(target_arch = "x86_64"))]
        level => unreachable!("a token for {level} cannot exist on this architecture"),
    }
}

/// The homography of each sample; of one that is not proper, anything.
///
/// # Panics
/// If a sample names a correspondence that is not there.
pub fn solve(simd: Simd, pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
    match simd.level() {
        SimdLevel::Scalar => solve_scalar(pairs, samples),
        // SAFETY: the token proves the level.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { solve_avx2(pairs, samples) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 | SimdLevel::Amx => unsafe { solve_avx512(pairs, samples) },
        #[cfg(not(target_arch = "x86_64"))]
        level => unreachable!("a token for {level} cannot exist on this architecture"),
    }
}

/// Counts the inliers of `homography`. Once it cannot exceed `floor` any more, counting may stop:
/// what is returned is then some number not above `floor`, the same at every level.
pub fn count_inliers(simd: Simd, pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    match simd.level() {
        SimdLevel::Scalar => count_scalar(pairs, homography, floor),
        // SAFETY: the token proves the level.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { count_avx2(pairs, homography, floor) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 | SimdLevel::Amx => unsafe { count_avx512(pairs, homography, floor) },
        #[cfg(not(target_arch = "x86_64"))]
        level => unreachable!("a token for {level} cannot exist on this architecture"),
    }
}

/// Points between two looks at whether counting can still succeed.
const STRIDE: usize = 2 * LANES;

/// The corners of a sample by axis.
fn corners(pairs: &PointPairs, sample: &Sample) -> [[f32; 4]; 4] {
    let four = sample.map(|position| pairs.get(usize::from(position)));
    std::array::from_fn(|axis| four.map(|pair| pair[axis]))
}

/// Twice the signed areas of the four triangles of four corners; in the first three, the fourth
/// corner replaces the first, second and third.
fn twice_areas(x: &[f32; 4], y: &[f32; 4]) -> [f32; 4] {
    [[3, 1, 2], [0, 3, 2], [0, 1, 3], [0, 1, 2]]
        .map(|[a, b, c]| (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a]))
}

/// The definition.
fn proper_scalar(pairs: &PointPairs, samples: &[Sample; LANES], min_area: f32) -> u32 {
    pairs.validate(samples);
    let one = |sample: &Sample| {
        let [x, y, u, v] = corners(pairs, sample);
        let (from, to) = (twice_areas(&x, &y), twice_areas(&u, &v));
        let smaller = |least: f32, area: &f32| {
            if area.abs() < least {
                area.abs()
            } else {
                least
            }
        };
        let smallest = from.iter().chain(&to).fold(from[0].abs(), smaller);
        let alike = (0..4).all(|t| from[t].is_sign_negative() == to[t].is_sign_negative());
        smallest > min_area && alike
    };
    samples
        .iter()
        .rev()
        .fold(0, |bits, sample| bits << 1 | u32::from(one(sample)))
}

/// `H = B diag(beta / alpha) adj(A)`, where `A` and `B` hold the first three corners in homogeneous
/// coordinates as columns, and `alpha`, `beta` are the fourth corner's barycentric coordinates:
/// signed areas of triangles.
fn solve_scalar(pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
    pairs.validate(samples);
    let mut out = Hypotheses {
        entries: [[0.0; LANES]; 9],
    };
    for (lane, sample) in samples.iter().enumerate() {
        let [x, y, u, v] = corners(pairs, sample);
        let (from, to) = (twice_areas(&x, &y), twice_areas(&u, &v));
        let adjugate = |a: usize, b: usize| [y[a] - y[b], x[b] - x[a], x[a] * y[b] - x[b] * y[a]];
        let rows = [adjugate(1, 2), adjugate(2, 0), adjugate(0, 1)];
        // The sign of A's determinant makes the scale positive: w at corner i is weight_i times the
        // determinant of A.
        let sign = 1f32.copysign(from[3]);
        let weights = [0, 1, 2].map(|corner| sign * (to[corner] / from[corner]));
        for column in 0..3 {
            let term = [0, 1, 2].map(|corner| weights[corner] * rows[corner][column]);
            out.entries[column][lane] = u[0] * term[0] + u[1] * term[1] + u[2] * term[2];
            out.entries[3 + column][lane] = v[0] * term[0] + v[1] * term[1] + v[2] * term[2];
            out.entries[6 + column][lane] = term[0] + term[1] + term[2];
        }
    }
    out
}

/// The definition, in the order of operations of the vector code.
fn count_scalar(pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let mut count = 0;
    for point in 0..pairs.len() {
        if point % STRIDE == 0 && count + (pairs.len() - point) <= floor {
            return count;
        }
        let [x, y, u, v] = [0, 1, 2, 3].map(|axis| pairs.coordinates[axis][point]);
        let w = (g * x + h * y) + i;
        let dx = ((a * x + b * y) + c) - u * w;
        let dy = ((d * x + e * y) + f) - v * w;
        count += usize::from((dx * dx + dy * dy <= w * w) & (w > 0.0));
    }
    count
}

/// The instances of the vector code at each level.
#[cfg(target_arch = "x86_64")]
macro_rules! instances {
    ($vector:ident, $features:literal, $proper:ident, $solve:ident, $count:ident) => {
        #[target_feature(enable = $features)]
        fn $proper(pairs: &PointPairs, samples: &[Sample; LANES], min_area: f32) -> u32 {
            pairs.validate(samples);
            // SAFETY: this function has the features; the positions have been checked.
            unsafe { proper_vectors::<$vector>(pairs, samples, min_area) }
        }

        #[target_feature(enable = $features)]
        fn $solve(pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
            pairs.validate(samples);
            // SAFETY: this function has the features; the positions have been checked.
            unsafe { solve_vectors::<$vector>(pairs, samples) }
        }

        #[target_feature(enable = $features)]
        fn $count(pairs: &PointPairs, homography: &[f32; 9], floor: usize) -> usize {
            // SAFETY: this function has the features.
            unsafe { count_vectors::<$vector>(pairs, homography, floor) }
        }
    };
}

#[cfg(target_arch = "x86_64")]
instances!(Avx2, "avx2,popcnt", proper_avx2, solve_avx2, count_avx2);
#[cfg(target_arch = "x86_64")]
instances!(
    Avx512,
    "avx2,popcnt,avx512f,avx512dq",
    proper_avx512,
    solve_avx512,
    count_avx512
);

/// Twice the area of a triangle for each element.
///
/// # Safety
/// The level of `V` must be available.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn triangle<V: Vector>(x: &[V; 4], y: &[V; 4], [a, b, c]: [usize; 3]) -> V {
    // SAFETY: arithmetic at the caller's level.
    unsafe {
        x[b].sub(x[a])
            .mul(y[c].sub(y[a]))
            .sub(x[c].sub(x[a]).mul(y[b].sub(y[a])))
    }
}

/// [`twice_areas`] of as many samples as a vector has elements.
///
/// # Safety
/// The level of `V` must be available.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn areas_of<V: Vector>(x: &[V; 4], y: &[V; 4]) -> [V; 4] {
    // SAFETY: arithmetic at the caller's level.
    unsafe {
        [
            triangle(x, y, [3, 1, 2]),
            triangle(x, y, [0, 3, 2]),
            triangle(x, y, [0, 1, 3]),
            triangle(x, y, [0, 1, 2]),
        ]
    }
}

/// One row of the adjugate of the first three corners.
///
/// # Safety
/// The level of `V` must be available.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn adjugate_row<V: Vector>(x: &[V; 4], y: &[V; 4], a: usize, b: usize) -> [V; 3] {
    // SAFETY: arithmetic at the caller's level.
    unsafe {
        [
            y[a].sub(y[b]),
            x[b].sub(x[a]),
            x[a].mul(y[b]).sub(x[b].mul(y[a])),
        ]
    }
}

/// The sum of three corners' terms, from the first on.
///
/// # Safety
/// The level of `V` must be available.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn weighted<V: Vector>(axis: &[V; 4], [p, q, r]: [V; 3]) -> V {
    // SAFETY: arithmetic at the caller's level.
    unsafe { axis[0].mul(p).add(axis[1].mul(q)).add(axis[2].mul(r)) }
}

/// The corners of as many samples as a vector has elements: `[axis][corner]`.
///
/// # Safety
/// The level of `V` must be available, `from + V::COUNT <= LANES`, and the positions lie within
/// `pairs`.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn corners_of<V: Vector>(
    pairs: &PointPairs,
    samples: &[Sample; LANES],
    from: usize,
) -> [[V; 4]; 4] {
    let pairs = pairs.pairs.as_ptr();
    // SAFETY: the caller's.
    let four = unsafe {
        let samples = samples.as_ptr().add(from);
        [
            V::corners(pairs, samples, 0),
            V::corners(pairs, samples, 1),
            V::corners(pairs, samples, 2),
            V::corners(pairs, samples, 3),
        ]
    };
    std::array::from_fn(|axis| [four[0][axis], four[1][axis], four[2][axis], four[3][axis]])
}

/// # Safety
/// The level of `V` must be available and the positions lie within `pairs`.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn proper_vectors<V: Vector>(
    pairs: &PointPairs,
    samples: &[Sample; LANES],
    min_area: f32,
) -> u32 {
    let mut bits = 0;
    for from in (0..LANES).step_by(V::COUNT) {
        // SAFETY: LANES is a multiple of every vector's length; the rest is the caller's.
        unsafe {
            let [x, y, u, v] = corners_of::<V>(pairs, samples, from);
            let (before, after) = (areas_of(&x, &y), areas_of(&u, &v));
            let (mut smallest, mut turned) = (before[0].abs(), before[0].xor(after[0]));
            for t in 0..4 {
                smallest = before[t].abs().min(smallest);
                smallest = after[t].abs().min(smallest);
                turned = before[t].xor(after[t]).or(turned);
            }
            bits |= (smallest.greater(V::splat(min_area)) & !turned.sign_bits()) << from;
        }
    }
    bits
}

/// # Safety
/// The level of `V` must be available and the positions lie within `pairs`.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn solve_vectors<V: Vector>(pairs: &PointPairs, samples: &[Sample; LANES]) -> Hypotheses {
    let mut out = Hypotheses {
        entries: [[0.0; LANES]; 9],
    };
    for from in (0..LANES).step_by(V::COUNT) {
        // SAFETY: LANES is a multiple of every vector's length; the rest is the caller's.
        unsafe {
            let [x, y, u, v] = corners_of::<V>(pairs, samples, from);
            let (before, after) = (areas_of(&x, &y), areas_of(&u, &v));
            let rows = [
                adjugate_row(&x, &y, 1, 2),
                adjugate_row(&x, &y, 2, 0),
                adjugate_row(&x, &y, 0, 1),
            ];
            let mut weights = [before[3]; 3];
            for corner in 0..3 {
                weights[corner] = after[corner].div(before[corner]).flipped_by(before[3]);
            }
            for column in 0..3 {
                let term = [
                    weights[0].mul(rows[0][column]),
                    weights[1].mul(rows[1][column]),
                    weights[2].mul(rows[2][column]),
                ];
                weighted(&u, term).store(out.entries[column].as_mut_ptr().add(from));
                weighted(&v, term).store(out.entries[3 + column].as_mut_ptr().add(from));
                term[0]
                    .add(term[1])
                    .add(term[2])
                    .store(out.entries[6 + column].as_mut_ptr().add(from));
            }
        }
    }
    out
}

/// # Safety
/// The level of `V` must be available.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn count_vectors<V: Vector>(
    pairs: &PointPairs,
    homography: &[f32; 9],
    floor: usize,
) -> usize {
    let [xs, ys, us, vs] = &pairs.coordinates;
    let padded = xs.len();
    assert!(ys.len() == padded && us.len() == padded && vs.len() == padded && padded % LANES == 0);
    // SAFETY: the caller's.
    let [a, b, c, d, e, f, g, h, i] = homography.map(|entry| unsafe { V::splat(entry) });
    let (mut count, mut point) = (0, 0);
    while point < padded {
        if point % STRIDE == 0 && count + (pairs.len() - point) <= floor {
            return count;
        }
        // SAFETY: `point + V::COUNT <= padded`, the length of all four, as LANES is a multiple of
        // every vector's length; the rest is the caller's.
        unsafe {
            let (x, y) = (
                V::load(xs.as_ptr().add(point)),
                V::load(ys.as_ptr().add(point)),
            );
            let (u, v) = (
                V::load(us.as_ptr().add(point)),
                V::load(vs.as_ptr().add(point)),
            );
            let row = |p: V, q: V, r: V| p.mul(x).add(q.mul(y)).add(r);
            let w = row(g, h, i);
            let (dx, dy) = (row(a, b, c).sub(u.mul(w)), row(d, e, f).sub(v.mul(w)));
            let error = dx.mul(dx).add(dy.mul(dy));
            count += error.within_and_positive(w.mul(w), w).count_ones() as usize;
        }
        point += V::COUNT;
    }
    count
}

/// Compares `simd` with the scalar twin on small odd inputs.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    for (n, seed) in [(4, 1), (5, 2), (37, 3), (131, 4)] {
        let pairs = sample_pairs(n, seed);
        let mut twin = draw::OneByOne(seed);
        let expected: [Sample; LANES] = std::array::from_fn(|_| twin.next(n));
        let mut samples = [[0; 4]; LANES];
        Sampler::new(seed).fill(simd, n, &mut samples);
        if samples != expected {
            return Err(format!("samples of {n} correspondences"));
        }
        let (ours, are_proper) = (
            proper(simd, &pairs, &samples, 1e-3),
            proper_scalar(&pairs, &samples, 1e-3),
        );
        if ours != are_proper {
            return Err(format!(
                "which samples of {n} correspondences are proper: {ours:b} instead of {are_proper:b}"
            ));
        }
        let (ours, twin) = (
            solve(simd, &pairs, &samples),
            solve_scalar(&pairs, &samples),
        );
        for lane in (0..LANES).filter(|lane| are_proper >> lane & 1 == 1) {
            if ours.get(lane).map(f32::to_bits) != twin.get(lane).map(f32::to_bits) {
                return Err(format!("four-point solutions among {n} correspondences"));
            }
            for floor in [0, n / 2, n] {
                let homography = twin.get(lane);
                let ours = count_inliers(simd, &pairs, &homography, floor);
                let twin = count_scalar(&pairs, &homography, floor);
                if ours != twin {
                    return Err(format!(
                        "{ours} instead of {twin} inliers among {n} correspondences"
                    ));
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
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) % 64
    };
    let mut pairs = PointPairs::default();
    pairs.fill((0..n).map(|i| {
        let (x, y) = (next() as f32 / 2.0, next() as f32 / 2.0);
        if i % 2 == 0 {
            [x, y, x + 1.25, y * 1.1 - 2.0]
        } else {
            [x, y, next() as f32 / 2.0, next() as f32 / 2.0]
        }
    }));
    pairs
}

#[cfg(test)]
mod tests;

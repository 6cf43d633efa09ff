//! The homography most correspondences agree with (paper III-D, step 7): RANSAC with local optimisation.
//!
//! Samples of four are drawn, solved and screened eight at a time; each surviving homography is scored on all
//! correspondences. Whenever one beats the best so far, least squares on the correspondences near it tries to gain
//! more. The search stops once a sample free of outliers, had the best share of inliers been the true one, would have
//! been drawn with the confidence asked for.
//!
//! Correspondences are sorted and the generator is seeded from their coordinates, so a pair's outcome depends on its
//! content alone: not on time, threads, machine, or the order of the correspondences.

use super::refine::refit;
use crate::kernels::Simd;
use crate::kernels::homography::{self, LANES, PointPairs, Samples};

/// A sample's triangles must be larger than this, in squared tolerances (twice the area). On a grid of patches 2/3 of
/// the tolerance apart the smallest proper triangle has 0.11 (half-patch offsets) to 0.44.
const MIN_AREA: f32 = 0.05;

/// Samples drawn for every homography that may be scored: among false matches about one sample in eight keeps its
/// orientation.
const DRAWS_PER_HOMOGRAPHY: usize = 8;

/// Settings of the search.
#[derive(Debug, Clone, Copy)]
pub(super) struct RansacSettings {
    /// Largest transfer error of an inlier, in reference pixels.
    pub(super) tolerance_px: f32,
    /// Most homographies scored.
    pub(super) max_iterations: u32,
    /// Probability of having drawn a sample free of outliers when stopping early.
    pub(super) confidence: f64,
}

/// The best homography found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimate {
    /// Row-major, query to reference pixels, scaled so that `w` is positive for inliers.
    pub(super) homography: [f64; 9],
    /// Correspondences within tolerance and in front.
    pub(super) inliers: u32,
}

/// Working memory of one thread.
#[derive(Debug, Default)]
pub(super) struct Ransac {
    sorted: Vec<[f32; 4]>,
    points: PointPairs,
}

impl Ransac {
    /// Finds the homography of `correspondences` (`x, y` in query, `u, v` in reference pixels); `None` where there are
    /// fewer than four, or no four of them make a proper quadrilateral in both images.
    pub(super) fn estimate(
        &mut self,
        simd: Simd,
        correspondences: impl Iterator<Item = [f32; 4]>,
        settings: &RansacSettings,
    ) -> Option<Estimate> {
        self.sorted.clear();
        self.sorted.extend(correspondences);
        if self.sorted.len() < 4 {
            return None;
        }
        self.sorted.sort_unstable_by_key(|pair| pair.map(f32::to_bits));
        let frame = Frame::of(&self.sorted, f64::from(settings.tolerance_px));
        self.points.fill(self.sorted.iter().map(|&pair| frame.normalise(pair)));
        let mut search = Search { simd, points: &self.points, best: 0, homography: None };
        search.run(seed_of(&self.sorted), settings);
        let homography = frame.denormalise(&search.homography?);
        let near = |pair: &&[f32; 4]| is_inlier(&homography, **pair, settings.tolerance_px);
        let inliers = self.sorted.iter().filter(near).count() as u32;
        Some(Estimate { homography, inliers })
    }
}

/// Whether the one-directional transfer error of a correspondence is within tolerance, with `w` strictly positive.
pub(super) fn is_inlier(homography: &[f64; 9], pair: [f32; 4], tolerance_px: f32) -> bool {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let [x, y, u, v] = pair.map(f64::from);
    let w = g * x + h * y + i;
    let (dx, dy) = (a * x + b * y + c - u * w, d * x + e * y + f - v * w);
    let reach = f64::from(tolerance_px) * w;
    w > 0.0 && dx * dx + dy * dy <= reach * reach
}

/// Coordinates with the origin at the correspondences' centre and the tolerance as unit, in both images.
struct Frame {
    centre: [f64; 4],
    unit: f64,
}

impl Frame {
    fn of(correspondences: &[[f32; 4]], unit: f64) -> Self {
        let mut centre = [0.0; 4];
        for pair in correspondences {
            centre.iter_mut().zip(pair).for_each(|(sum, &value)| *sum += f64::from(value));
        }
        Self { centre: centre.map(|sum| sum / correspondences.len() as f64), unit }
    }

    fn normalise(&self, pair: [f32; 4]) -> [f32; 4] {
        std::array::from_fn(|axis| ((f64::from(pair[axis]) - self.centre[axis]) / self.unit) as f32)
    }

    /// The homography in pixels: `T(u, v)^-1 H T(x, y)`.
    fn denormalise(&self, homography: &[f64; 9]) -> [f64; 9] {
        let [cx, cy, cu, cv] = self.centre;
        let mut out = [0.0; 9];
        for row in 0..3 {
            let [p, q, r] = [0, 1, 2].map(|column| homography[row * 3 + column]);
            (out[row * 3], out[row * 3 + 1]) = (p / self.unit, q / self.unit);
            out[row * 3 + 2] = r - (p * cx + q * cy) / self.unit;
        }
        for column in 0..3 {
            out[column] = out[column] * self.unit + cu * out[6 + column];
            out[3 + column] = out[3 + column] * self.unit + cv * out[6 + column];
        }
        out
    }
}

/// FNV-1a over the coordinates.
fn seed_of(sorted: &[[f32; 4]]) -> u64 {
    sorted.iter().flatten().fold(0xcbf2_9ce4_8422_2325, |hash: u64, value| {
        (hash ^ u64::from(value.to_bits())).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

/// SplitMix64 (Steele, Lea, Flood 2014): its numbers are part of every score, so they must never change with a
/// library's version.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    /// Four different numbers below `n`, which is at least 4 and below 2^16.
    fn four_of(&mut self, n: usize) -> [usize; 4] {
        loop {
            let bits = self.next();
            let four = [0, 16, 32, 48].map(|shift| (((bits >> shift) & 0xffff) as usize * n) >> 16);
            let [a, b, c, d] = four;
            // Without short cuts, which would be mispredicted.
            if !((a == b) | (a == c) | (a == d) | (b == c) | (b == d) | (c == d)) {
                return four;
            }
        }
    }
}

/// The state of one search, in normalised coordinates.
struct Search<'a> {
    simd: Simd,
    points: &'a PointPairs,
    best: usize,
    homography: Option<[f64; 9]>,
}

impl Search<'_> {
    fn run(&mut self, seed: u64, settings: &RansacSettings) {
        let mut random = Random(seed);
        let most_scored = settings.max_iterations as usize;
        let (mut drawn, mut scored, mut needed) = (0, 0, most_scored * DRAWS_PER_HOMOGRAPHY);
        while drawn < needed && scored < most_scored {
            let samples = self.draw(&mut random);
            let hypotheses = homography::solve_four(self.simd, &samples, MIN_AREA);
            for lane in (0..LANES).filter(|&lane| hypotheses.valid[lane]) {
                scored += 1;
                if self.consider(&hypotheses.get(lane)) {
                    needed = needed.min(self.draws_needed(settings));
                }
            }
            drawn += LANES;
        }
    }

    fn draw(&self, random: &mut Random) -> Samples {
        let mut samples = [[[0.0; LANES]; 4]; 4];
        #[allow(clippy::needless_range_loop, reason = "the lane is the innermost of three indices")]
        for lane in 0..LANES {
            for (corner, i) in random.four_of(self.points.len()).into_iter().enumerate() {
                let pair = self.points.get(i);
                (0..4).for_each(|axis| samples[axis][corner][lane] = pair[axis]);
            }
        }
        samples
    }

    /// Takes a homography that beats the best, and improves it locally; tells whether it did.
    fn consider(&mut self, hypothesis: &[f32; 9]) -> bool {
        let count = homography::count_inliers(self.simd, self.points, hypothesis, self.best);
        if count <= self.best {
            return false;
        }
        let scale = f64::from(hypothesis[8]);
        let wide = hypothesis.map(f64::from);
        self.take(wide, count);
        if scale > 0.0 {
            self.improve(wide.map(|entry| entry / scale));
        }
        true
    }

    fn take(&mut self, homography: [f64; 9], count: usize) {
        (self.best, self.homography) = (count, Some(homography));
    }

    /// Refits on what lies within a shrinking reach, taking whatever gains inliers.
    fn improve(&mut self, mut homography: [f64; 9]) {
        for radius in LOCAL_RADII {
            let Some(refined) = refit(self.points, &homography, radius) else { return };
            homography = refined;
            let count =
                homography::count_inliers(self.simd, self.points, &homography.map(|entry| entry as f32), self.best);
            if count > self.best {
                self.take(homography, count);
            }
        }
    }

    /// Draws after which a sample of inliers only was among them with the confidence asked for.
    fn draws_needed(&self, settings: &RansacSettings) -> usize {
        let share = self.best as f64 / self.points.len() as f64;
        let all_inliers = share.powi(4);
        if all_inliers >= 1.0 {
            return 0;
        }
        let draws = (1.0 - settings.confidence).ln() / (-all_inliers).ln_1p();
        // A negligible share gives infinity, which the cast saturates.
        draws.ceil().max(0.0) as usize
    }
}

/// Reaches of the successive refits, in tolerances.
const LOCAL_RADII: [f64; 4] = [1.5, 1.2, 1.0, 1.0];

//! The homography most correspondences agree with (paper III-D, step 7): RANSAC with local
//! optimisation.
//!
//! Samples of four are drawn and screened many at a time; those that could be corners of one plane
//! are gathered, solved and scored on all correspondences. Whenever one beats the best so far,
//! least squares on the correspondences near it tries to gain more. The search stops once a sample
//! free of outliers, had the best share of inliers been the true one, would have been drawn with
//! the confidence asked for.
//!
//! Correspondences are sorted and the generator is seeded from their coordinates, so a pair's
//! outcome depends on its content alone: not on time, threads, machine, or the order of the
//! correspondences.

use super::refine::refit;
use placeformer_kernels::Simd;
use placeformer_kernels::homography::{self, Hypotheses, LANES, PointPairs, Sample, Sampler};

/// A sample's triangles must be larger than this, in squared tolerances (twice the area). On a grid
/// of patches 2/3 of the tolerance apart the smallest proper triangle has 0.11 (half-patch offsets)
/// to 0.44.
const MIN_AREA: f32 = 0.05;

/// Samples drawn for every homography that may be scored: among false matches about one sample in
/// eight keeps its orientation.
const DRAWS_PER_HOMOGRAPHY: usize = 8;

/// Samples drawn and screened at once.
const CHUNK: usize = 4 * LANES;

/// Whether to go on is asked before every so many samples. Scores depend on it, and on it alone:
/// not on how many are drawn or solved at once.
const ROUND: usize = 8;

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
    /// Finds the homography of `correspondences` (`x, y` in query, `u, v` in reference pixels);
    /// `None` where there are fewer than four, or no four of them make a proper quadrilateral in
    /// both images.
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
        self.sorted.sort_unstable_by_key(key);
        let frame = Frame::of(&self.sorted, f64::from(settings.tolerance_px));
        self.points
            .fill(self.sorted.iter().map(|&pair| frame.normalise(pair)));
        let mut search = Search {
            simd,
            points: &self.points,
            best: 0,
            homography: None,
        };
        search.run(seed_of(&self.sorted), settings);
        let homography = frame.denormalise(&search.homography?);
        let near = |pair: &&[f32; 4]| is_inlier(&homography, **pair, settings.tolerance_px);
        let inliers = self.sorted.iter().filter(near).count() as u32;
        Some(Estimate {
            homography,
            inliers,
        })
    }
}

/// The bits of all coordinates in one number, so that one comparison orders two correspondences.
fn key(pair: &[f32; 4]) -> u128 {
    pair.iter()
        .fold(0, |key, value| key << 32 | u128::from(value.to_bits()))
}

/// Whether the one-directional transfer error of a correspondence is within tolerance, with `w`
/// strictly positive.
pub(super) fn is_inlier(homography: &[f64; 9], pair: [f32; 4], tolerance_px: f32) -> bool {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let [x, y, u, v] = pair.map(f64::from);
    let w = g * x + h * y + i;
    let (dx, dy) = (a * x + b * y + c - u * w, d * x + e * y + f - v * w);
    let reach = f64::from(tolerance_px) * w;
    w > 0.0 && dx * dx + dy * dy <= reach * reach
}

/// Coordinates with the origin at the correspondences' centre and the tolerance as unit, in both
/// images.
struct Frame {
    centre: [f64; 4],
    unit: f64,
}

impl Frame {
    fn of(correspondences: &[[f32; 4]], unit: f64) -> Self {
        let mut centre = [0.0; 4];
        for pair in correspondences {
            centre
                .iter_mut()
                .zip(pair)
                .for_each(|(sum, &value)| *sum += f64::from(value));
        }
        Self {
            centre: centre.map(|sum| sum / correspondences.len() as f64),
            unit,
        }
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
    sorted
        .iter()
        .flatten()
        .fold(0xcbf2_9ce4_8422_2325, |hash: u64, value| {
            (hash ^ u64::from(value.to_bits())).wrapping_mul(0x0000_0100_0000_01b3)
        })
}

/// How far a search has come.
struct Progress {
    /// Homographies scored.
    scored: usize,
    most_scored: usize,
    /// Samples to draw; shrinks as inliers are found.
    needed: usize,
}

impl Progress {
    /// Whether to go on after `drawn` samples.
    fn goes_on(&self, drawn: usize) -> bool {
        drawn < self.needed && self.scored < self.most_scored
    }
}

/// The proper samples of a chunk and their numbers in it.
struct Gathered {
    samples: [Sample; CHUNK],
    numbers: [u8; CHUNK],
    len: usize,
}

impl Default for Gathered {
    fn default() -> Self {
        // What is not filled is solved along with the rest, and must name pairs that are there.
        Self {
            samples: [[0; 4]; CHUNK],
            numbers: [0; CHUNK],
            len: 0,
        }
    }
}

impl Gathered {
    /// Replaces what was gathered by what is proper of the next chunk.
    fn gather(&mut self, simd: Simd, points: &PointPairs, samples: &[Sample; CHUNK]) {
        self.len = 0;
        for (group, sixteen) in samples.as_chunks::<LANES>().0.iter().enumerate() {
            let mut bits = homography::proper(simd, points, sixteen, MIN_AREA);
            while bits != 0 {
                let lane = bits.trailing_zeros() as usize;
                bits &= bits - 1;
                // Below CHUNK, which fits.
                (self.samples[self.len], self.numbers[self.len]) =
                    (sixteen[lane], (group * LANES + lane) as u8);
                self.len += 1;
            }
        }
    }

    /// Groups to solve at once, each with the position of its first.
    fn groups(&self) -> impl Iterator<Item = (usize, &[Sample; LANES])> {
        let groups = self.len.div_ceil(LANES);
        self.samples.as_chunks::<LANES>().0[..groups]
            .iter()
            .enumerate()
            .map(|(group, samples)| (group * LANES, samples))
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
        let mut sampler = Sampler::new(seed);
        let most_scored = settings.max_iterations as usize;
        let mut progress = Progress {
            scored: 0,
            most_scored,
            needed: most_scored * DRAWS_PER_HOMOGRAPHY,
        };
        let (mut samples, mut proper) = ([[0; 4]; CHUNK], Gathered::default());
        for drawn in (0..).step_by(CHUNK) {
            if !progress.goes_on(drawn) {
                return;
            }
            sampler.fill(self.simd, self.points.len(), &mut samples);
            proper.gather(self.simd, self.points, &samples);
            if !self.try_samples(&proper, drawn, &mut progress, settings) {
                return;
            }
        }
    }

    /// Scores the samples gathered from a chunk, the first of which was number `drawn`; false once
    /// the search is over.
    fn try_samples(
        &mut self,
        proper: &Gathered,
        drawn: usize,
        progress: &mut Progress,
        settings: &RansacSettings,
    ) -> bool {
        let mut round = usize::MAX;
        for (from, sixteen) in proper.groups() {
            let hypotheses: Hypotheses = homography::solve(self.simd, self.points, sixteen);
            for lane in 0..LANES.min(proper.len - from) {
                let begun = drawn + usize::from(proper.numbers[from + lane]) / ROUND * ROUND;
                if begun != round && !progress.goes_on(begun) {
                    return false;
                }
                round = begun;
                progress.scored += 1;
                if self.consider(&hypotheses.get(lane)) {
                    progress.needed = progress.needed.min(self.draws_needed(settings));
                }
            }
        }
        true
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
            let Some(refined) = refit(self.points, &homography, radius) else {
                return;
            };
            homography = refined;
            let count = homography::count_inliers(
                self.simd,
                self.points,
                &homography.map(|entry| entry as f32),
                self.best,
            );
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

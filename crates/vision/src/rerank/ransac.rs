//! The homography that most correspondences agree with (paper III-D, step 7): RANSAC with local
//! optimisation.
//!
//! Four correspondences determine a homography. Random samples of four are drawn and screened;
//! from those that pass, homographies are computed, and the correspondences that agree with each
//! are counted. Whenever one beats the best so far, a least-squares fit on the correspondences
//! near it tries to gain more. A homography that no camera can cause ([`View`]) does not count,
//! however many inliers it has. The search stops when a sample without outliers would have been
//! drawn with the required confidence, if the best share of inliers found so far were the true
//! one.
//!
//! Correspondences are sorted, and the random generator is seeded from their coordinates. So the
//! result depends on the correspondences alone: not on their order, on time, threads, or the
//! machine.

use super::frame::Frame;
use super::proper_samples::{CHUNK, ProperSamples};
use super::refine::refit;
use super::view::{InlierMoments, View};
use placeformer_kernels::Simd;
use placeformer_kernels::homography::{self, PointPairs, Sample, Sampler};

/// Most samples that are drawn, for each homography that may be scored. Among false matches about
/// one sample in eight is proper.
const DRAWS_PER_HOMOGRAPHY: usize = 8;

/// Every so many samples the search decides whether it goes on.
///
/// The number of homographies that are scored, and with it the result, depends on this constant. It
/// is separate from [`CHUNK`], so that results do not change when samples are drawn or solved in
/// groups of another size.
const ROUND: usize = 8;

/// Reaches of the successive least-squares fits after an improvement, in tolerances. The first one
/// is wide, because the homography of a sample is inexact.
const LOCAL_RADII: [f64; 4] = [1.5, 1.2, 1.0, 1.0];

/// Inliers from which on it is looked at how they lie before a homography is taken for the best. Of
/// fewer it is looked at in the end, because false matches have as many again and again.
const EXAMINED_FROM: usize = 8;

/// Examining how inliers lie takes as long as scoring so many homographies, and counts as such: so
/// that correspondences on a line, where every homography is refused, take no longer than others.
const COST_OF_EXAMINING: usize = 8;

/// Settings of the search.
#[derive(Debug, Clone, Copy)]
pub(super) struct RansacSettings {
    /// Largest transfer error of an inlier, in reference pixels.
    pub(super) tolerance_px: f32,
    /// Most homographies that are scored.
    pub(super) max_iterations: u32,
    /// The search stops early once a sample without outliers has been drawn with this probability.
    pub(super) confidence: f64,
}

/// The best homography that was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimate {
    /// `[3, 3]` row-major, from query to reference pixels; its sign is such that `w` is positive
    /// for inliers.
    pub(super) homography: [f64; 9],
    /// Number of inliers; see [`is_inlier`].
    pub(super) inliers: u32,
    /// How the inliers lie and see the plane; lengths are in pixels.
    pub(super) view: View,
}

/// Working memory of one thread.
#[derive(Debug, Default)]
pub(super) struct Ransac {
    sorted: Vec<[f32; 4]>,
    points: PointPairs,
}

impl Ransac {
    /// Finds the homography of `correspondences` (`x, y` in query, `u, v` in reference pixels).
    ///
    /// `None` if there are fewer than four, no four of them form a proper quadrilateral in both
    /// images, or no camera can cause what most of them agree with.
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
        self.sorted.sort_unstable_by_key(sort_key);
        let frame = Frame::of(&self.sorted, f64::from(settings.tolerance_px));
        let normalised = self.sorted.iter().map(|&pair| frame.normalise(pair));
        self.points.fill(normalised);

        let mut search = Search::new(simd, &self.points, settings);
        search.run(seed_of(&self.sorted));
        let homography = frame.denormalise(&search.homography?);
        let tolerance_px = settings.tolerance_px;
        let pairs = self.sorted.iter().copied();
        let inliers = pairs.filter(|&pair| is_inlier(&homography, pair, tolerance_px));
        let moments = InlierMoments::of_inliers(inliers, &homography);
        let view = moments.view(&homography);
        view.is_plausible(f64::from(tolerance_px))
            .then_some(Estimate {
                homography,
                inliers: moments.count(),
                view,
            })
    }
}

/// Whether a correspondence is an inlier: its transfer error from query to reference is within the
/// tolerance, and `w` is positive, so that the point is in front of the camera.
pub(super) fn is_inlier(homography: &[f64; 9], pair: [f32; 4], tolerance_px: f32) -> bool {
    let [a, b, c, d, e, f, g, h, i] = *homography;
    let [x, y, u, v] = pair.map(f64::from);
    let w = g * x + h * y + i;
    // The error times w, which saves the divisions.
    let dx = a * x + b * y + c - u * w;
    let dy = d * x + e * y + f - v * w;
    let reach = f64::from(tolerance_px) * w;
    w > 0.0 && dx * dx + dy * dy <= reach * reach
}

/// The bits of all coordinates as one number, so that a single comparison orders two
/// correspondences.
fn sort_key(pair: &[f32; 4]) -> u128 {
    let mut key = 0;
    for value in pair {
        key = key << 32 | u128::from(value.to_bits());
    }
    key
}

/// A hash (FNV-1a) of all coordinates.
fn seed_of(sorted: &[[f32; 4]]) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for value in sorted.as_flattened() {
        hash ^= u64::from(value.to_bits());
        hash = hash.wrapping_mul(0x0000_0100_0000_01b3);
    }
    hash
}

/// One search, in normalised coordinates.
struct Search<'a> {
    simd: Simd,
    points: &'a PointPairs,
    /// As in [`RansacSettings`].
    confidence: f64,
    /// Most homographies that are scored.
    most_scored: usize,
    /// Number of homographies scored so far.
    scored: usize,
    /// Number of samples to draw; it shrinks as inliers are found.
    needed: usize,
    /// Number of inliers of the best homography.
    best: usize,
    homography: Option<[f64; 9]>,
}

impl<'a> Search<'a> {
    fn new(simd: Simd, points: &'a PointPairs, settings: &RansacSettings) -> Self {
        let most_scored = settings.max_iterations as usize;
        Self {
            simd,
            points,
            confidence: settings.confidence,
            most_scored,
            scored: 0,
            needed: most_scored * DRAWS_PER_HOMOGRAPHY,
            best: 0,
            homography: None,
        }
    }

    fn run(&mut self, seed: u64) {
        let mut sampler = Sampler::new(seed);
        let mut chunk: [Sample; CHUNK] = [[0; 4]; CHUNK];
        let mut proper = ProperSamples::new();
        let mut drawn = 0;
        while !self.is_over(drawn) {
            sampler.fill(self.simd, self.points.len(), &mut chunk);
            proper.gather(self.simd, self.points, &chunk);
            self.score_samples(&proper, drawn);
            drawn += CHUNK;
        }
    }

    /// Whether the search is over after this many samples.
    fn is_over(&self, drawn: usize) -> bool {
        drawn >= self.needed || self.scored >= self.most_scored
    }

    /// Scores the homographies of a chunk whose first sample has the number `drawn`. Stops when the
    /// search is over.
    fn score_samples(&mut self, proper: &ProperSamples, drawn: usize) {
        let mut current_round = None;
        for (samples, numbers) in proper.groups() {
            let hypotheses = homography::solve(self.simd, self.points, samples);
            for (lane, &number) in numbers.iter().enumerate() {
                let round = drawn + usize::from(number) / ROUND * ROUND;
                if current_round != Some(round) && self.is_over(round) {
                    return;
                }
                current_round = Some(round);
                self.scored += 1;
                self.consider(&hypotheses.get(lane));
            }
        }
    }

    /// Takes a homography if it beats the best one, and tries to improve it.
    fn consider(&mut self, hypothesis: &[f32; 9]) {
        let count = homography::count_inliers(self.simd, self.points, hypothesis, self.best);
        if count <= self.best {
            return;
        }
        let homography = hypothesis.map(f64::from);
        if !self.may_be_seen(&homography, count) {
            return;
        }
        self.take(homography, count);
        let scale = homography[8];
        if scale > 0.0 {
            self.improve(homography.map(|entry| entry / scale));
        }
        self.needed = self.needed.min(self.draws_needed());
    }

    fn take(&mut self, homography: [f64; 9], count: usize) {
        self.best = count;
        self.homography = Some(homography);
    }

    /// Fits the correspondences within a shrinking reach again and again, and takes every fit that
    /// gains inliers. The last entry of `homography` is 1.
    fn improve(&mut self, mut homography: [f64; 9]) {
        for radius in LOCAL_RADII {
            let Some(refined) = refit(self.points, &homography, radius) else {
                return;
            };
            homography = refined;
            let rounded = homography.map(|entry| entry as f32);
            let count = homography::count_inliers(self.simd, self.points, &rounded, self.best);
            if count > self.best && self.may_be_seen(&homography, count) {
                self.take(homography, count);
            }
        }
    }

    /// Whether a camera can cause a homography with so many inliers, as far as that is examined
    /// now.
    fn may_be_seen(&mut self, homography: &[f64; 9], count: usize) -> bool {
        if count < EXAMINED_FROM {
            return true;
        }
        self.scored += COST_OF_EXAMINING;
        let rounded = homography.map(|entry| entry as f32);
        let moments = InlierMoments::of_points(self.points, &rounded);
        // The points are normalised.
        moments.view(homography).is_plausible(1.0)
    }

    /// Number of samples among which one has inliers only, with the required confidence, if the
    /// best share of inliers is the true one.
    fn draws_needed(&self) -> usize {
        let share = self.best as f64 / self.points.len() as f64;
        let all_inliers = share.powi(4);
        if all_inliers >= 1.0 {
            return 0;
        }
        let draws = (1.0 - self.confidence).ln() / (-all_inliers).ln_1p();
        // For a tiny share this is infinite, and the conversion gives the largest integer.
        draws.ceil().max(0.0) as usize
    }
}

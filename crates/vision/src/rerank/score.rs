//! The score of a pair of images (paper III-E, step 8): S adds up the inliers of every configured
//! union of scales.

use super::mutual_nn::{Matcher, Pair, PreparedQuery, centres_of};
use super::ransac::{Estimate, Ransac, RansacSettings, is_inlier};
use super::{CombinationMatch, CombinationScore, Correspondence, PairScore, RerankConfig};
use placeformer_core::types::{PackedPatches, ScaleSet};
use placeformer_kernels::Simd;
use std::cell::RefCell;

/// What one thread needs to score a pair; kept from pair to pair.
#[derive(Debug, Default)]
pub(super) struct Workspace {
    matcher: Matcher,
    ransac: Ransac,
    pairs: Vec<Pair>,
    centres: Vec<[f32; 2]>,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
    static PREPARED: RefCell<Vec<PreparedQuery>> = const { RefCell::new(Vec::new()) };
}

/// Lends this thread's workspace.
pub(super) fn with_workspace<T>(work: impl FnOnce(&mut Workspace) -> T) -> T {
    WORKSPACE.with_borrow_mut(work)
}

/// Prepares `query` in memory this thread kept from an earlier one, and lends it.
///
/// The memory is taken out meanwhile: while `work` waits for other threads, this one may be given
/// another query.
pub(super) fn with_prepared<T>(
    simd: Simd,
    query: &PackedPatches,
    work: impl FnOnce(&PreparedQuery) -> T,
) -> T {
    let kept = PREPARED.with_borrow_mut(|kept| kept.pop_if(|kept| kept.simd() == simd));
    let mut prepared = kept.unwrap_or_else(|| PreparedQuery::new(simd));
    prepared.prepare(query);
    let result = work(&prepared);
    PREPARED.with_borrow_mut(|kept| {
        if kept.is_empty() {
            kept.push(prepared);
        }
    });
    result
}

impl Workspace {
    /// Scores one reference.
    pub(super) fn score(
        &mut self,
        simd: Simd,
        config: &RerankConfig,
        query: &PreparedQuery,
        reference: &PackedPatches,
    ) -> PairScore {
        self.compare(config, query, reference);
        let mut combinations = Vec::with_capacity(config.scales.len());
        for &scales in &config.scales {
            let (score, _) = self.verify(simd, config, query, reference, scales);
            combinations.push(score);
        }
        PairScore {
            spatial_score: combinations
                .iter()
                .map(|combination| combination.inliers)
                .sum(),
            combinations,
        }
    }

    /// Scores one reference and keeps who matched whom.
    pub(super) fn explain(
        &mut self,
        simd: Simd,
        config: &RerankConfig,
        query: &PreparedQuery,
        reference: &PackedPatches,
    ) -> Vec<CombinationMatch> {
        self.compare(config, query, reference);
        let one = |&scales: &ScaleSet| {
            let (score, estimate) = self.verify(simd, config, query, reference, scales);
            let tolerance_px = tolerance_px(config, reference);
            let correspondences = self.pairs.iter().map(|&pair| Correspondence {
                query: pair.0,
                reference: pair.1,
                inlier: estimate.is_some_and(|found| {
                    is_inlier(&found.homography, self.points(query, pair), tolerance_px)
                }),
            });
            CombinationMatch {
                score,
                correspondences: correspondences.collect(),
                homography: estimate.map(|found| scaled(found.homography)),
            }
        };
        config.scales.iter().map(one).collect()
    }

    /// Verifies correspondences that were found otherwise.
    pub(super) fn homography(
        &mut self,
        simd: Simd,
        config: &RerankConfig,
        correspondences: &[[f32; 4]],
        tolerance_px: f32,
    ) -> Option<([f64; 9], u32)> {
        let RerankConfig {
            max_iterations,
            confidence,
            ..
        } = *config;
        let settings = RansacSettings {
            tolerance_px,
            max_iterations,
            confidence,
        };
        let estimate = self
            .ransac
            .estimate(simd, correspondences.iter().copied(), &settings)?;
        Some((scaled(estimate.homography), estimate.inliers))
    }

    fn compare(&mut self, config: &RerankConfig, query: &PreparedQuery, reference: &PackedPatches) {
        self.matcher.compare(query, reference, &config.scales);
        centres_of(reference, &mut self.centres);
    }

    /// Leaves the mutual pairs of one union in `self.pairs`.
    fn verify(
        &mut self,
        simd: Simd,
        config: &RerankConfig,
        query: &PreparedQuery,
        reference: &PackedPatches,
        scales: ScaleSet,
    ) -> (CombinationScore, Option<Estimate>) {
        self.matcher
            .mutual_pairs(query, reference, scales, &mut self.pairs);
        let settings = RansacSettings {
            tolerance_px: tolerance_px(config, reference),
            max_iterations: config.max_iterations,
            confidence: config.confidence,
        };
        let Self {
            ransac,
            pairs,
            centres,
            ..
        } = self;
        let points = pairs
            .iter()
            .map(|&pair| points_of(&query.centres, centres, pair));
        let estimate = ransac.estimate(simd, points, &settings);
        let inliers = estimate.map_or(0, |found| found.inliers);
        (
            CombinationScore {
                scales,
                matches: self.pairs.len() as u32,
                inliers,
            },
            estimate,
        )
    }

    fn points(&self, query: &PreparedQuery, pair: Pair) -> [f32; 4] {
        points_of(&query.centres, &self.centres, pair)
    }
}

/// Centres of a pair: x, y in the query, u, v in the reference.
fn points_of(query: &[[f32; 2]], reference: &[[f32; 2]], (i, j): Pair) -> [f32; 4] {
    let ([x, y], [u, v]) = (query[i as usize], reference[j as usize]);
    [x, y, u, v]
}

/// The base patch's size counts, whatever the scale.
fn tolerance_px(config: &RerankConfig, reference: &PackedPatches) -> f32 {
    config.tolerance_patches * f32::from(reference.grid.patch_px)
}

/// Scaled to a last entry of 1 where that is possible.
fn scaled(homography: [f64; 9]) -> [f64; 9] {
    let last = homography[8];
    if last == 0.0 {
        homography
    } else {
        homography.map(|entry| entry / last)
    }
}

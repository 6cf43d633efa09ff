//! The score of a pair of images (paper III-E, step 8): S adds up the inliers of every configured
//! combination of scales.

use super::config::RerankConfig;
use super::features::CosineSums;
use super::mutual_nn::{Matcher, Pair, PreparedQuery, centres_of};
use super::outcome::{
    CombinationFeatures, CombinationMatch, CombinationScore, Correspondence, HomographyFeatures,
    PairFeatures, PairScore,
};
use super::ransac::{Estimate, Ransac, RansacSettings, is_inlier};
use placeformer_core::types::{PackedPatches, ScaleSet};
use placeformer_kernels::Simd;
use std::cell::RefCell;

/// The memory that one thread needs to score a pair of images; kept from pair to pair.
#[derive(Debug, Default)]
pub(super) struct Workspace {
    matcher: Matcher,
    ransac: Ransac,
    /// Mutual pairs of the combination at hand.
    pairs: Vec<Pair>,
    /// Centres of the reference's patches, in pixels.
    centres: Vec<[f32; 2]>,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
    static PREPARED: RefCell<Vec<PreparedQuery>> = const { RefCell::new(Vec::new()) };
}

/// Calls `work` with this thread's workspace.
pub(super) fn with_workspace<T>(work: impl FnOnce(&mut Workspace) -> T) -> T {
    WORKSPACE.with_borrow_mut(work)
}

/// Prepares `query`, in memory that this thread has kept from an earlier query, and calls `work`
/// with it.
///
/// The memory is taken out of the thread-local variable for that time: while `work` waits for other
/// threads, this thread may be given another query to prepare.
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
        let mut features = Vec::with_capacity(config.scales.len());
        let mut spatial_score = 0;
        for &scales in &config.scales {
            let (score, estimate) = self.verify(simd, config, query, reference, scales);
            spatial_score += score.inliers;
            combinations.push(score);
            features.push(self.features(config, query, reference, scales, estimate));
        }
        PairScore {
            spatial_score,
            combinations,
            features: PairFeatures {
                combinations: features,
            },
        }
    }

    /// What is known of the combination that was just verified, beside the counts.
    fn features(
        &self,
        config: &RerankConfig,
        query: &PreparedQuery,
        reference: &PackedPatches,
        scales: ScaleSet,
        estimate: Option<Estimate>,
    ) -> CombinationFeatures {
        let tolerance_px = tolerance_px(config, reference);
        let mut matches = CosineSums::default();
        let mut inliers = CosineSums::default();
        for &pair in &self.pairs {
            let cosine = self.matcher.cosine(query, scales, pair);
            matches.add(cosine);
            let points = points_of(&query.centres, &self.centres, pair);
            if estimate.is_some_and(|found| is_inlier(&found.homography, points, tolerance_px)) {
                inliers.add(cosine);
            }
        }
        let patch_px = f64::from(reference.grid.patch_px);
        CombinationFeatures {
            match_cosine: matches.mean(),
            homography: estimate.map(|found| HomographyFeatures {
                inlier_cosine: inliers.mean(),
                inlier_cosine_deviation: inliers.deviation(),
                scale: found.view.scale,
                stretch: found.view.stretch,
                spread: found.view.spread[0].min(found.view.spread[1]) / patch_px,
            }),
        }
    }

    /// Scores one reference and returns which patches matched.
    pub(super) fn explain(
        &mut self,
        simd: Simd,
        config: &RerankConfig,
        query: &PreparedQuery,
        reference: &PackedPatches,
    ) -> Vec<CombinationMatch> {
        self.compare(config, query, reference);
        let tolerance_px = tolerance_px(config, reference);
        let mut matches = Vec::with_capacity(config.scales.len());
        for &scales in &config.scales {
            let (score, estimate) = self.verify(simd, config, query, reference, scales);
            let to_correspondence = |&pair: &Pair| {
                let points = points_of(&query.centres, &self.centres, pair);
                Correspondence {
                    query: pair.0,
                    reference: pair.1,
                    inlier: estimate
                        .is_some_and(|found| is_inlier(&found.homography, points, tolerance_px)),
                }
            };
            matches.push(CombinationMatch {
                score,
                correspondences: self.pairs.iter().map(to_correspondence).collect(),
                homography: estimate.map(|found| with_last_entry_one(found.homography)),
            });
        }
        matches
    }

    /// The homography of correspondences (`x, y, u, v` in pixels) that were found in another way.
    pub(super) fn homography(
        &mut self,
        simd: Simd,
        config: &RerankConfig,
        correspondences: &[[f32; 4]],
        tolerance_px: f32,
    ) -> Option<([f64; 9], u32)> {
        let settings = ransac_settings(config, tolerance_px);
        let correspondences = correspondences.iter().copied();
        let estimate = self.ransac.estimate(simd, correspondences, &settings)?;
        Some((with_last_entry_one(estimate.homography), estimate.inliers))
    }

    /// Compares all patches of the two images, as all combinations need it.
    fn compare(&mut self, config: &RerankConfig, query: &PreparedQuery, reference: &PackedPatches) {
        self.matcher.compare(query, reference, &config.scales);
        centres_of(reference, &mut self.centres);
    }

    /// Scores one combination. Its mutual pairs remain in `self.pairs`.
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
        let settings = ransac_settings(config, tolerance_px(config, reference));
        let points = self
            .pairs
            .iter()
            .map(|&pair| points_of(&query.centres, &self.centres, pair));
        let estimate = self.ransac.estimate(simd, points, &settings);
        let score = CombinationScore {
            scales,
            matches: self.pairs.len() as u32,
            inliers: estimate.map_or(0, |found| found.inliers),
        };
        (score, estimate)
    }
}

/// The centres of a pair: x, y in the query, u, v in the reference, in pixels.
fn points_of(query: &[[f32; 2]], reference: &[[f32; 2]], pair: Pair) -> [f32; 4] {
    let [x, y] = query[pair.0 as usize];
    let [u, v] = reference[pair.1 as usize];
    [x, y, u, v]
}

fn ransac_settings(config: &RerankConfig, tolerance_px: f32) -> RansacSettings {
    RansacSettings {
        tolerance_px,
        max_iterations: config.max_iterations,
        confidence: config.confidence,
    }
}

/// The inlier tolerance in pixels. It follows from the size of a base patch at every scale.
fn tolerance_px(config: &RerankConfig, reference: &PackedPatches) -> f32 {
    config.tolerance_patches * f32::from(reference.grid.patch_px)
}

/// The same homography with a last entry of 1, unless that entry is 0.
fn with_last_entry_one(homography: [f64; 9]) -> [f64; 9] {
    let last = homography[8];
    if last == 0.0 {
        homography
    } else {
        homography.map(|entry| entry / last)
    }
}

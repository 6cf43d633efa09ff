//! Scores all candidates of a query in parallel.

use super::config::RerankConfig;
use super::mutual_nn::PreparedQuery;
use super::outcome::{CombinationMatch, PairScore, Ranked, Reranked};
use super::score::{with_prepared, with_workspace};
use placeformer_core::types::{Deadline, PackedPatches};
use placeformer_kernels::simd::{self, Simd};
use rayon::prelude::*;
use std::cmp::Reverse;
use std::ops::Deref;

/// Re-ranks candidates (paper III-D and III-E) with fixed settings.
#[derive(Debug, Clone)]
pub struct Reranker {
    config: RerankConfig,
    simd: Simd,
}

impl Reranker {
    /// A re-ranker that uses the SIMD level of this process.
    ///
    /// # Panics
    /// If `PLACEFORMER_SIMD` asks for a level that the CPU lacks. Programs rule that out at start,
    /// by [`placeformer_kernels::self_check`].
    pub fn new(config: RerankConfig) -> Self {
        Self::with_simd(config, simd::selected())
    }

    /// A re-ranker that uses the given SIMD level. All levels give the same scores.
    pub fn with_simd(config: RerankConfig, simd: Simd) -> Self {
        Self { config, simd }
    }

    /// Its settings.
    pub fn config(&self) -> &RerankConfig {
        &self.config
    }

    /// Scores one pair of images.
    ///
    /// The result depends on the two images alone: the random samples are seeded from their
    /// content.
    ///
    /// # Panics
    /// If the two were made by different models, so that their descriptors differ in length; or if
    /// the parts of one image contradict each other.
    pub fn score(&self, query: &PackedPatches, reference: &PackedPatches) -> PairScore {
        with_prepared(self.simd, query, |prepared| {
            self.score_prepared(prepared, reference)
        })
    }

    /// Scores one pair of images, and returns the evidence: one match for each combination of
    /// scales.
    ///
    /// # Panics
    /// As [`score`](Self::score).
    pub fn explain(
        &self,
        query: &PackedPatches,
        reference: &PackedPatches,
    ) -> Vec<CombinationMatch> {
        with_prepared(self.simd, query, |prepared| {
            with_workspace(|workspace| {
                workspace.explain(self.simd, &self.config, prepared, reference)
            })
        })
    }

    /// The homography that most of `correspondences` (`x, y` in query, `u, v` in reference pixels)
    /// agree with to within `tolerance_px` pixels, row-major, and how many agree.
    ///
    /// `None` if no four correspondences form a proper quadrilateral in both images.
    pub fn homography(
        &self,
        correspondences: &[[f32; 4]],
        tolerance_px: f32,
    ) -> Option<([f64; 9], u32)> {
        with_workspace(|workspace| {
            workspace.homography(self.simd, &self.config, correspondences, tolerance_px)
        })
    }

    /// Scores the candidates `0..count` in parallel, loading each one through `load`.
    ///
    /// Runs on the rayon pool in which it is called. After the deadline no further candidate is
    /// started. A candidate takes about a millisecond, so the answer is late by no more than that.
    ///
    /// # Panics
    /// As [`score`](Self::score).
    pub fn rerank<P, E>(
        &self,
        query: &PackedPatches,
        count: usize,
        load: impl Fn(usize) -> Result<P, E> + Sync,
        deadline: Option<Deadline>,
    ) -> Reranked<E>
    where
        P: Deref<Target = PackedPatches>,
        E: Send,
    {
        let is_late = || deadline.is_some_and(Deadline::has_passed);
        if is_late() {
            return Reranked::DeadlinePassed;
        }
        let score_one = |prepared: &PreparedQuery, candidate: usize| {
            if is_late() {
                return None;
            }
            let reference = match load(candidate) {
                Ok(reference) => reference,
                Err(error) => return Some(Err(error)),
            };
            // Loading may have taken long.
            if is_late() {
                return None;
            }
            Some(Ok(self.score_prepared(prepared, &reference)))
        };
        let outcomes: Option<Vec<Result<PairScore, E>>> =
            with_prepared(self.simd, query, |prepared| {
                // Candidates differ in cost, so each one is a task of its own.
                (0..count)
                    .into_par_iter()
                    .with_max_len(1)
                    .map(|candidate| score_one(prepared, candidate))
                    .collect()
            });
        match outcomes {
            Some(outcomes) => in_order(outcomes),
            None => Reranked::DeadlinePassed,
        }
    }

    fn score_prepared(&self, query: &PreparedQuery, reference: &PackedPatches) -> PairScore {
        with_workspace(|workspace| workspace.score(self.simd, &self.config, query, reference))
    }
}

/// Sorts the scored candidates, and lists the failed ones separately.
fn in_order<E>(outcomes: Vec<Result<PairScore, E>>) -> Reranked<E> {
    let mut ranked = Vec::with_capacity(outcomes.len());
    let mut failed = Vec::new();
    for (candidate, outcome) in outcomes.into_iter().enumerate() {
        match outcome {
            Ok(score) => ranked.push(Ranked { candidate, score }),
            Err(error) => failed.push((candidate, error)),
        }
    }
    // The sort is stable, so equal scores keep the order of the global search.
    ranked.sort_by_key(|ranked| Reverse(ranked.score.spatial_score));
    Reranked::Complete { ranked, failed }
}

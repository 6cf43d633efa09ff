//! Key patches of a query against those of its candidates: mutual nearest neighbours, homography,
//! score (paper III-D and III-E).
//!
//! | module | step |
//! |---|---|
//! | `mutual_nn` | 6: best partners both ways, each pair of scales compared once |
//! | `ransac`, `refine` | 7: the homography most pairs agree with |
//! | `score` | 8: inliers added up over the configured unions of scales |
//!
//! Working memory is kept by each thread, so that scoring a candidate allocates nothing but its
//! answer.

mod mutual_nn;
mod ransac;
mod refine;
mod score;
#[cfg(test)]
mod tests;

use mutual_nn::PreparedQuery;
use placeformer_core::types::{Deadline, InvalidValue, PackedPatches, RerankId, ScaleSet};
use placeformer_kernels::simd::{self, Simd};
use rayon::prelude::*;
use score::{with_prepared, with_workspace};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Settings of re-ranking. The comments of the fields are printed as the manual of the
/// configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RerankConfig {
    /// The scale combinations whose inlier counts add up to the spatial score S. The best row of
    /// the paper's table is 1, 1+2, 2+3.
    #[schema(value_type = Vec<String>)]
    pub scales: Vec<ScaleSet>,
    /// Inlier tolerance of the homography in multiples of the base patch size.
    pub tolerance_patches: f32,
    /// Most homographies scored for one combination; samples refused as degenerate or twisted do
    /// not count.
    pub max_iterations: u32,
    /// The search for a homography stops early once the best one has been seen with this
    /// probability.
    pub confidence: f64,
}

/// Beyond this one candidate takes seconds.
const MOST_ITERATIONS: u32 = 1_000_000;

impl Default for RerankConfig {
    fn default() -> Self {
        Self {
            scales: ScaleSet::paper_default(),
            tolerance_patches: 1.5,
            max_iterations: 2000,
            confidence: 0.995,
        }
    }
}

impl RerankConfig {
    /// Refuses settings under which no candidate could be scored, or only wrongly.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let refuse = |field, reason: String| Err(InvalidValue::new(field, reason));
        if self.scales.is_empty() {
            return refuse(
                "rerank.scales",
                "no scale combination is given, so every S would be 0".into(),
            );
        }
        if let Some(twice) = self
            .scales
            .iter()
            .enumerate()
            .find(|(i, set)| self.scales[..*i].contains(set))
        {
            return refuse("rerank.scales", format!("{} is given twice", twice.1));
        }
        if !(self.tolerance_patches.is_finite() && self.tolerance_patches > 0.0) {
            return refuse(
                "rerank.tolerance_patches",
                format!("{} is not a positive number", self.tolerance_patches),
            );
        }
        if !(1..=MOST_ITERATIONS).contains(&self.max_iterations) {
            return refuse(
                "rerank.max_iterations",
                format!("{} is outside 1 to {MOST_ITERATIONS}", self.max_iterations),
            );
        }
        if !(self.confidence > 0.0 && self.confidence < 1.0) {
            return refuse(
                "rerank.confidence",
                format!("{} is not between 0 and 1", self.confidence),
            );
        }
        Ok(())
    }

    /// Everything that S depends on beyond the descriptors: `1,1+2,2+3:t1.5:i2000:c0.995`.
    pub fn id(&self) -> RerankId {
        let scales: Vec<String> = self.scales.iter().map(ToString::to_string).collect();
        let Self {
            tolerance_patches,
            max_iterations,
            confidence,
            ..
        } = self;
        RerankId::new(format!(
            "{}:t{tolerance_patches}:i{max_iterations}:c{confidence}",
            scales.join(",")
        ))
    }
}

/// Outcome of one scale combination for one candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CombinationScore {
    /// Which scales were matched jointly.
    pub scales: ScaleSet,
    /// Mutual nearest neighbours.
    pub matches: u32,
    /// Of these, inliers of the best homography: the score of this combination.
    pub inliers: u32,
}

/// Outcome of one candidate.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PairScore {
    /// S: the sum of all combinations' inliers.
    pub spatial_score: u32,
    /// In the order of the configuration.
    pub combinations: Vec<CombinationScore>,
}

/// A correspondence between two key patches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Correspondence {
    /// Row in the query's [`PackedPatches`].
    pub query: u32,
    /// Row in the reference's.
    pub reference: u32,
    /// Whether the homography explains it.
    pub inlier: bool,
}

/// One combination with its evidence.
#[derive(Debug, Clone, PartialEq)]
pub struct CombinationMatch {
    /// The counts.
    pub score: CombinationScore,
    /// Every mutual pair.
    pub correspondences: Vec<Correspondence>,
    /// Row-major homography from query to reference pixels (of the model's input), scaled to h33 =
    /// 1; left as it is where h33 is 0 (the horizon passes through the corner of the query).
    pub homography: Option<[f64; 9]>,
}

/// A candidate's outcome: its position in the list given, and its score.
#[derive(Debug, Clone, PartialEq)]
pub struct Ranked {
    /// Index into the candidates as given, which is the global order.
    pub candidate: usize,
    /// Its score.
    pub score: PairScore,
}

/// What re-ranking made of the candidates.
#[derive(Debug)]
pub enum Reranked<E> {
    /// All were scored: best first, ties in the global order. Candidates that failed to load are
    /// listed apart.
    Complete {
        /// Scored candidates.
        ranked: Vec<Ranked>,
        /// Those whose patches could not be loaded.
        failed: Vec<(usize, E)>,
    },
    /// The deadline passed first; the global order stands.
    DeadlinePassed,
}

/// The matcher with its settings.
#[derive(Debug, Clone)]
pub struct Reranker {
    config: RerankConfig,
    simd: Simd,
}

impl Reranker {
    /// Prepares a matcher that computes with the process's SIMD level.
    ///
    /// # Panics
    /// Where `PLACEFORMER_SIMD` asks for a level the CPU lacks; programs have checked that at start
    /// ([`placeformer_kernels::self_check`]).
    pub fn new(config: RerankConfig) -> Self {
        Self::with_simd(config, simd::selected())
    }

    /// Prepares a matcher that computes at the given level. Every level gives the same scores.
    pub fn with_simd(config: RerankConfig, simd: Simd) -> Self {
        Self { config, simd }
    }

    /// Its settings.
    pub fn config(&self) -> &RerankConfig {
        &self.config
    }

    /// Scores one pair. Deterministic: the random samples are seeded from the pair's content.
    ///
    /// # Panics
    /// Where the two were made by different models (descriptors of different lengths), or the parts
    /// of one contradict each other.
    pub fn score(&self, query: &PackedPatches, reference: &PackedPatches) -> PairScore {
        with_prepared(self.simd, query, |prepared| {
            self.score_prepared(prepared, reference)
        })
    }

    /// Scores one pair and keeps the evidence.
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
    /// agree with, row-major, and how many do to within `tolerance_px`; `None` where no four of
    /// them make a proper quadrilateral in both images.
    pub fn homography(
        &self,
        correspondences: &[[f32; 4]],
        tolerance_px: f32,
    ) -> Option<([f64; 9], u32)> {
        with_workspace(|workspace| {
            workspace.homography(self.simd, &self.config, correspondences, tolerance_px)
        })
    }

    /// Scores `count` candidates in parallel, loading each through `load`.
    ///
    /// Runs on the rayon pool it is called in. Once the deadline has passed no further candidate is
    /// begun. A candidate takes about a millisecond, so the answer is late by no more than that.
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
        P: std::ops::Deref<Target = PackedPatches>,
        E: Send,
    {
        let late = || deadline.is_some_and(Deadline::has_passed);
        if late() {
            return Reranked::DeadlinePassed;
        }
        let outcomes: Option<Vec<Result<PairScore, E>>> =
            with_prepared(self.simd, query, |prepared| {
                let one = |candidate: usize| {
                    if late() {
                        return None;
                    }
                    let reference = match load(candidate) {
                        Ok(reference) => reference,
                        Err(error) => return Some(Err(error)),
                    };
                    if late() {
                        return None;
                    }
                    Some(Ok(self.score_prepared(prepared, &reference)))
                };
                // Candidates differ in cost, so every one may be stolen.
                (0..count)
                    .into_par_iter()
                    .with_max_len(1)
                    .map(one)
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

/// Sorts the scored by S, ties in the order given, and lists the failed apart.
fn in_order<E>(outcomes: Vec<Result<PairScore, E>>) -> Reranked<E> {
    let (mut ranked, mut failed) = (Vec::with_capacity(outcomes.len()), Vec::new());
    for (candidate, outcome) in outcomes.into_iter().enumerate() {
        match outcome {
            Ok(score) => ranked.push(Ranked { candidate, score }),
            Err(error) => failed.push((candidate, error)),
        }
    }
    // The sort is stable, which keeps the global order among equals.
    ranked.sort_by_key(|ranked| std::cmp::Reverse(ranked.score.spatial_score));
    Reranked::Complete { ranked, failed }
}

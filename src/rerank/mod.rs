//! Key patches of a query against those of its candidates: mutual nearest neighbours, homography, score
//! (paper III-D and III-E).

use crate::types::{Deadline, PackedPatches, ScaleSet};
use serde::{Deserialize, Serialize};

/// Settings of re-ranking.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RerankConfig {
    /// The scale combinations whose inlier counts add up to S.
    pub scales: Vec<ScaleSet>,
    /// Inlier tolerance in multiples of the base patch size.
    pub tolerance_patches: f32,
    /// Most homographies tried for one combination.
    pub max_iterations: u32,
    /// Probability with which the best homography should have been seen when the search stops early.
    pub confidence: f64,
}

impl Default for RerankConfig {
    fn default() -> Self {
        Self { scales: ScaleSet::paper_default(), tolerance_patches: 1.5, max_iterations: 2000, confidence: 0.995 }
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
    /// Row-major homography from query to reference pixels (of the model's input), scaled to h33 = 1.
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
    /// All were scored: best first, ties in the global order. Candidates that failed to load are listed apart.
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
pub struct Reranker {}

impl Reranker {
    /// Prepares a matcher.
    pub fn new(_config: RerankConfig) -> Self {
        unimplemented!()
    }

    /// Scores one pair. Deterministic: the random samples are seeded from the pair's content.
    pub fn score(&self, _query: &PackedPatches, _reference: &PackedPatches) -> PairScore {
        unimplemented!()
    }

    /// Scores one pair and keeps the evidence.
    pub fn explain(&self, _query: &PackedPatches, _reference: &PackedPatches) -> Vec<CombinationMatch> {
        unimplemented!()
    }

    /// Scores `count` candidates in parallel, loading each through `load`.
    pub fn rerank<P, E>(
        &self,
        _query: &PackedPatches,
        _count: usize,
        _load: impl Fn(usize) -> Result<P, E> + Sync,
        _deadline: Option<Deadline>,
    ) -> Reranked<E>
    where
        P: std::ops::Deref<Target = PackedPatches>,
        E: Send,
    {
        unimplemented!()
    }
}

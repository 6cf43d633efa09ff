//! What re-ranking gives: scores, and the evidence for them.

use placeformer_core::types::ScaleSet;

/// The score of one candidate in one combination of scales.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CombinationScore {
    /// The scales that were matched jointly.
    pub scales: ScaleSet,
    /// Number of mutual nearest neighbours (paper III-D).
    pub matches: u32,
    /// How many of these are inliers of the best homography: the score of this combination.
    pub inliers: u32,
}

/// The score of one candidate.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PairScore {
    /// S, the sum of the inliers of all combinations (paper III-E).
    pub spatial_score: u32,
    /// In the order of the configuration.
    pub combinations: Vec<CombinationScore>,
    /// What else is known of the pair.
    pub features: PairFeatures,
}

/// What matching and verification learn about a pair of images beside the counts. Computed anyway,
/// it tells places from chance where counts alone do not.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PairFeatures {
    /// One for each combination, in the order of the configuration; none where only the counts are
    /// known.
    pub combinations: Vec<CombinationFeatures>,
}

/// What is known of one combination of scales beside its counts.
///
/// The values do not depend on the order of patches, and are the same on every machine.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CombinationFeatures {
    /// Mean cosine of the descriptors of all mutual pairs; 0 if there are none.
    pub match_cosine: f64,
    /// The homography and its inliers, if there is one.
    pub homography: Option<HomographyFeatures>,
}

/// What is known of a homography beside the number of its inliers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HomographyFeatures {
    /// Mean cosine of the descriptors of the inliers.
    pub inlier_cosine: f64,
    /// Its standard deviation.
    pub inlier_cosine_deviation: f64,
    /// How much larger the reference shows the plane: the root of the determinant of the
    /// derivative where the inliers are.
    pub scale: f64,
    /// How much more one direction is stretched than the other, from 1: the ratio of the singular
    /// values of that derivative.
    pub stretch: f64,
    /// Deviation of the inliers from their best line, in base patches, in the image where it is
    /// smaller.
    pub spread: f64,
}

/// A pair of key patches that are each other's nearest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Correspondence {
    /// Row in the query's [`PackedPatches`](placeformer_core::types::PackedPatches).
    pub query: u32,
    /// Row in the reference's patches.
    pub reference: u32,
    /// Whether the pair is an inlier of the homography.
    pub inlier: bool,
}

/// The score of one combination, with its evidence.
#[derive(Debug, Clone, PartialEq)]
pub struct CombinationMatch {
    /// The counts.
    pub score: CombinationScore,
    /// Every mutual pair.
    pub correspondences: Vec<Correspondence>,
    /// The homography from query to reference pixels of the model's input, `[3, 3]` row-major,
    /// scaled so that the last entry is 1. If the last entry is 0 (the horizon passes through the
    /// top left corner of the query), the scale is arbitrary. `None` if there is no homography.
    pub homography: Option<[f64; 9]>,
}

/// A candidate and its score.
#[derive(Debug, Clone, PartialEq)]
pub struct Ranked {
    /// Index into the list of candidates as it was given, which is the order of the global search.
    pub candidate: usize,
    /// Its score.
    pub score: PairScore,
}

/// The result of re-ranking a list of candidates.
#[derive(Debug)]
pub enum Reranked<E> {
    /// All candidates were scored, or could not be loaded.
    Complete {
        /// The scored candidates: best first, equal scores in the order of the global search.
        ranked: Vec<Ranked>,
        /// Index and error of the candidates whose patches could not be loaded.
        failed: Vec<(usize, E)>,
    },
    /// The deadline passed first, so the order of the global search remains the answer.
    DeadlinePassed,
}

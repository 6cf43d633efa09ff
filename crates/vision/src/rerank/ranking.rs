//! What candidates are ordered by: the paper's S, S fused with the global similarity, or a score
//! that was learned from all that is known of a candidate.
//!
//! S counts inliers, whatever they are worth: a false candidate far down the global ranking can
//! have as many as the place itself. The other two weigh them against the evidence there is
//! besides.

use super::outcome::{CombinationFeatures, CombinationScore, PairScore};
use placeformer_core::types::{LearnedScore, ScaleSet, ScoreKind};

/// What the global search says about a candidate, and what its key patches do.
#[derive(Debug, Clone, Copy)]
pub struct Evidence<'a> {
    /// From key patches.
    pub score: &'a PairScore,
    /// Euclidean distance between the global descriptors, which are normalised.
    pub distance: f32,
}

/// What candidates are ordered by.
#[derive(Debug, Clone, Copy)]
pub enum Ranking<'a> {
    /// By S.
    Paper,
    /// By ln(S + 10) + 2 c, where c is the cosine of the global descriptors.
    Fused,
    /// By a learned score.
    Learned(&'a LearnedScore),
}

impl Ranking<'_> {
    /// Its kind.
    pub fn kind(&self) -> ScoreKind {
        match self {
            Self::Paper => ScoreKind::Paper,
            Self::Fused => ScoreKind::Fused,
            Self::Learned(_) => ScoreKind::Learned,
        }
    }

    /// The value of each of a query's candidates; the largest is the best.
    ///
    /// A learned score compares candidates with each other, so all must be given.
    pub fn values(&self, candidates: &[Evidence<'_>]) -> Vec<f64> {
        let s = |candidate: &Evidence<'_>| f64::from(candidate.score.spatial_score);
        match self {
            Self::Paper => candidates.iter().map(s).collect(),
            Self::Fused => candidates
                .iter()
                .map(|candidate| (s(candidate) + 10.0).ln() + 2.0 * cosine(candidate.distance))
                .collect(),
            Self::Learned(score) => {
                let vectors = feature_vectors(candidates);
                vectors.iter().map(|vector| score.logit(vector)).collect()
            }
        }
    }

    /// Orders a query's candidates, the best first, and gives each its value. Equal ones stay in
    /// the order given.
    pub fn order<T>(
        &self,
        candidates: Vec<T>,
        evidence: impl Fn(&T) -> Evidence<'_>,
    ) -> Vec<(f64, T)> {
        let seen: Vec<Evidence<'_>> = candidates.iter().map(evidence).collect();
        let values = self.values(&seen);
        let mut ordered: Vec<(f64, T)> = values.into_iter().zip(candidates).collect();
        ordered.sort_by(|a, b| b.0.total_cmp(&a.0));
        ordered
    }
}

/// The cosine of two normalised vectors from their Euclidean distance.
fn cosine(distance: f32) -> f64 {
    let distance = f64::from(distance);
    1.0 - distance * distance / 2.0
}

/// Features of each combination.
const OF_COMBINATION: [&str; 8] = [
    "inliers",
    "inlier_share",
    "match_cosine",
    "inlier_cosine",
    "cosine_deviation",
    "scale",
    "stretch",
    "spread",
];

/// Features of a candidate as a whole.
const OF_CANDIDATE: [&str; 3] = ["global.cosine", "global.margin", "inliers.margin"];

/// Names of the features that a learned score has for these combinations of scales, such as
/// `s11.inliers`.
pub fn feature_names(scales: &[ScaleSet]) -> Vec<String> {
    let mut names = Vec::new();
    for set in scales {
        let combination = set.score_name();
        names.extend(OF_COMBINATION.map(|feature| format!("{combination}.{feature}")));
    }
    names.extend(OF_CANDIDATE.map(str::to_owned));
    names
}

/// The features of each of a query's candidates, in the order of [`feature_names`].
///
/// Counts and ratios enter as logarithms, because twice as many inliers mean as much from 10 as
/// from 100. Margins are over the best of the other candidates.
pub fn feature_vectors(candidates: &[Evidence<'_>]) -> Vec<Vec<f64>> {
    let cosines: Vec<f64> = candidates.iter().map(|one| cosine(one.distance)).collect();
    let inliers = |one: &Evidence<'_>| f64::from(one.score.spatial_score).ln_1p();
    let inliers: Vec<f64> = candidates.iter().map(inliers).collect();
    let cosine_margins = margins(&cosines);
    let inlier_margins = margins(&inliers);
    let mut vectors = Vec::with_capacity(candidates.len());
    for (at, candidate) in candidates.iter().enumerate() {
        let PairScore {
            combinations,
            features,
            ..
        } = candidate.score;
        let mut vector = Vec::new();
        for (counts, features) in combinations.iter().zip(&features.combinations) {
            vector.extend(of_combination(counts, features));
        }
        vector.extend([cosines[at], cosine_margins[at], inlier_margins[at]]);
        vectors.push(vector);
    }
    vectors
}

/// In the order of [`OF_COMBINATION`]. Without a homography, its features are what they would be
/// for one that changes nothing.
fn of_combination(
    counts: &CombinationScore,
    features: &CombinationFeatures,
) -> [f64; OF_COMBINATION.len()] {
    let mut values = [0.0; OF_COMBINATION.len()];
    values[0] = f64::from(counts.inliers).ln_1p();
    values[1] = f64::from(counts.inliers) / f64::from(counts.matches.max(1));
    values[2] = features.match_cosine;
    if let Some(homography) = features.homography {
        values[3] = homography.inlier_cosine - features.match_cosine;
        values[4] = homography.inlier_cosine_deviation;
        values[5] = homography.scale.ln().abs();
        values[6] = homography.stretch.ln();
        values[7] = homography.spread.ln_1p();
    }
    values
}

/// How far each value lies above the largest of the others; 0 for a single one.
fn margins(values: &[f64]) -> Vec<f64> {
    let mut largest = f64::NEG_INFINITY;
    let mut second = f64::NEG_INFINITY;
    for &value in values {
        if value > largest {
            second = largest;
            largest = value;
        } else if value > second {
            second = value;
        }
    }
    let margin = |&value: &f64| {
        let other = if value >= largest { second } else { largest };
        if other.is_finite() {
            value - other
        } else {
            0.0
        }
    };
    values.iter().map(margin).collect()
}

#[cfg(test)]
mod tests {
    use super::super::outcome::{HomographyFeatures, PairFeatures};
    use super::*;
    use placeformer_core::types::ScoreTerm;

    fn pair(inliers: u32, has_homography: bool) -> PairScore {
        let homography = HomographyFeatures {
            inlier_cosine: 0.75,
            inlier_cosine_deviation: 0.125,
            scale: 0.5,
            stretch: 1.0,
            spread: 3.0,
        };
        PairScore {
            spatial_score: inliers,
            combinations: vec![CombinationScore {
                scales: ScaleSet::new(&[1]).unwrap(),
                matches: 40,
                inliers,
            }],
            features: PairFeatures {
                combinations: vec![CombinationFeatures {
                    match_cosine: 0.5,
                    homography: has_homography.then_some(homography),
                }],
            },
        }
    }

    #[test]
    fn features_are_those_that_their_names_say() {
        let pairs = [pair(10, true), pair(0, false), pair(30, true)];
        let distances = [0.0, 1.0, 1.2];
        let evidence: Vec<_> = pairs
            .iter()
            .zip(distances)
            .map(|(score, distance)| Evidence { score, distance })
            .collect();
        let names = feature_names(&[ScaleSet::new(&[1]).unwrap()]);
        let vectors = feature_vectors(&evidence);
        let get = |candidate: usize, name: &str| {
            let at = names.iter().position(|known| known == name).unwrap();
            vectors[candidate][at]
        };
        assert!(vectors.iter().all(|vector| vector.len() == names.len()));
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-6, "{a} {b}");
        close(get(0, "s11.inliers"), 11f64.ln());
        close(get(0, "s11.inlier_share"), 0.25);
        close(get(0, "s11.inlier_cosine"), 0.25);
        close(get(0, "s11.scale"), 2f64.ln());
        close(get(0, "s11.stretch"), 0.0);
        close(get(0, "s11.spread"), 4f64.ln());
        close(get(1, "s11.match_cosine"), 0.5);
        close(get(1, "s11.spread"), 0.0);
        close(get(0, "global.cosine"), 1.0);
        close(get(0, "global.margin"), 0.5);
        close(get(1, "global.margin"), -0.5);
        close(get(2, "inliers.margin"), (31f64 / 11.0).ln());
        close(get(0, "inliers.margin"), (11f64 / 31.0).ln());
    }

    #[test]
    fn each_ranking_orders_by_its_own_value() {
        // The first has few inliers and is near; the second has many and is far.
        let candidates = [
            (pair(40, true), 0.5),
            (pair(60, true), 1.3),
            (pair(40, true), 0.5),
        ];
        let order = |ranking: Ranking<'_>| {
            let numbered: Vec<_> = candidates.iter().enumerate().collect();
            let ordered = ranking.order(numbered, |one| Evidence {
                score: &one.1.0,
                distance: one.1.1,
            });
            ordered.iter().map(|one| one.1.0).collect::<Vec<_>>()
        };
        assert_eq!(order(Ranking::Paper), [1, 0, 2]);
        assert_eq!(order(Ranking::Fused), [0, 2, 1]);
        let names = feature_names(&[ScaleSet::new(&[1]).unwrap()]);
        let term = |feature: String| ScoreTerm {
            weight: if feature == "s11.inliers" { -1.0 } else { 0.0 },
            feature,
            mean: 0.0,
            deviation: 1.0,
        };
        let few = LearnedScore::new(0.0, names.into_iter().map(term).collect()).unwrap();
        assert_eq!(order(Ranking::Learned(&few)), [0, 2, 1]);
        assert!(order(Ranking::Learned(&few)) != order(Ranking::Paper));
    }

    #[test]
    fn the_best_has_its_margin_over_the_second_and_the_others_theirs_over_the_best() {
        assert_eq!(margins(&[3.0, 5.0, 1.0]), [-2.0, 2.0, -4.0]);
        assert_eq!(margins(&[5.0, 5.0]), [0.0, 0.0]);
        assert_eq!(margins(&[4.0]), [0.0]);
        assert!(margins(&[]).is_empty());
    }
}

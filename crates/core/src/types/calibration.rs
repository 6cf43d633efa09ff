//! How far a best answer can be trusted: from its score and distance to a probability, and from
//! that to yes or no.
//!
//! A [`Calibration`] holds two curves, because an answer that was not re-ranked has no score and
//! needs an honest confidence of its own. Where candidates are ranked by a learned score, it holds
//! that, too, because its curve means nothing without it. It says how it was fitted and for which
//! model and re-ranking it holds; anywhere else its numbers mean nothing. As JSON it is a file, a
//! column of the store and a body of the web surface alike.

use super::ids::{ModelId, RerankId};
use super::score::{LearnedScore, ScoreKind};
use crate::invalid::InvalidValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The version of the JSON without a learned score, as the first release wrote it.
const FORMAT: u32 = 1;
/// The version with one.
const FORMAT_WITH_SCORE: u32 = 2;
/// Largest magnitude of a weight. Scores are logarithms and a distance is at most 2, so that no
/// sum of such weights overflows.
const LARGEST_WEIGHT: f64 = 1e6;
/// Longest name of the data a calibration was fitted on, in characters.
const LONGEST_DATA: usize = 200;

/// Weights of a logistic curve: confidence = sigmoid(bias + score e + distance d). The evidence e
/// is ln(1 + S) where candidates are ranked by S, else the score that they are ranked by.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceWeights {
    /// Constant term.
    pub bias: f64,
    /// Weight of the evidence, not negative: more inliers never make an answer less sure. 0 in a
    /// curve without a score.
    #[schema(minimum = 0)]
    pub score: f64,
    /// Weight of the global distance, not positive: a farther answer is never surer.
    #[schema(maximum = 0)]
    pub distance: f64,
}

impl ConfidenceWeights {
    /// Probability, 0 to 1, that an answer with this evidence (see [`ScoreKind::evidence`];
    /// `None`: not re-ranked) and Euclidean distance is right.
    pub fn confidence(&self, evidence: Option<f64>, global_distance: f64) -> f64 {
        let evidence = self.score * evidence.unwrap_or(0.0);
        let logit = self.bias + evidence + self.distance * global_distance;
        1.0 / (1.0 + (-logit).exp())
    }

    fn check(&self) -> Result<(), InvalidValue> {
        let named = [
            ("bias", self.bias),
            ("score", self.score),
            ("distance", self.distance),
        ];
        for (field, value) in named {
            // NaN is in no range.
            if !(-LARGEST_WEIGHT..=LARGEST_WEIGHT).contains(&value) {
                let reason = format!("{value} is outside -{LARGEST_WEIGHT} to {LARGEST_WEIGHT}");
                return Err(InvalidValue::new(field, reason));
            }
        }
        if self.score < 0.0 {
            let reason = format!("{} would make more inliers less sure", self.score);
            return Err(InvalidValue::new("score", reason));
        }
        if self.distance > 0.0 {
            let reason = format!("{} would make farther answers surer", self.distance);
            return Err(InvalidValue::new("distance", reason));
        }
        Ok(())
    }
}

/// A curve, where on it trust begins, and what it was fitted on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceCurve {
    /// The curve.
    pub weights: ConfidenceWeights,
    /// An answer is trusted (`matched`) from this confidence on.
    #[schema(minimum = 0, maximum = 1)]
    pub threshold: f64,
    /// Right best answers among those it was fitted on.
    pub right: u64,
    /// Wrong ones, those included that have no right answer.
    pub wrong: u64,
    /// Of the wrong ones, how many had no right answer: their place was not in the database.
    pub without_match: u64,
    /// Share of right answers among those at or above the threshold, cross-validated.
    #[schema(minimum = 0, maximum = 1)]
    pub precision: f64,
    /// Right answers at or above the threshold, as a share of the queries whose place was in the
    /// database, cross-validated.
    #[schema(minimum = 0, maximum = 1)]
    pub recall: f64,
    /// How far confidence and share of right answers lie apart on average, cross-validated.
    #[schema(minimum = 0, maximum = 1)]
    pub expected_calibration_error: f64,
}

impl ConfidenceCurve {
    /// Whether an answer of this confidence is trusted.
    pub fn trusts(&self, confidence: f64) -> bool {
        confidence >= self.threshold
    }

    fn check(&self) -> Result<(), InvalidValue> {
        self.weights.check()?;
        if self.without_match > self.wrong {
            let reason = format!(
                "{} are more than the {} wrong",
                self.without_match, self.wrong
            );
            return Err(InvalidValue::new("without_match", reason));
        }
        check_share("threshold", self.threshold)?;
        check_share("precision", self.precision)?;
        check_share("recall", self.recall)?;
        check_share(
            "expected_calibration_error",
            self.expected_calibration_error,
        )
    }
}

/// What turns the best answers of one model and one re-ranking into confidences.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "UncheckedCalibration", deny_unknown_fields)]
pub struct Calibration {
    /// Version of this JSON.
    #[schema(minimum = 1, maximum = 2)]
    format: u32,
    /// The model whose distances and scores it was fitted on.
    #[schema(value_type = String)]
    model: ModelId,
    /// The re-ranking whose scores it was fitted on.
    #[schema(value_type = String, example = "1,1+2,2+3:t1.5:i2000:c0.995")]
    rerank: RerankId,
    /// Name of the data it was fitted on.
    #[schema(max_length = 200)]
    data: String,
    /// The share of right answers that the thresholds were chosen for.
    #[schema(minimum = 0, maximum = 1)]
    target_precision: f64,
    /// For answers that were re-ranked.
    reranked: ConfidenceCurve,
    /// For answers that were not: by distance alone.
    global: ConfidenceCurve,
    /// What candidates are ranked by, where the re-ranking is by a learned score; format 2.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = LearnedScore, required = false)]
    learned_score: Option<LearnedScore>,
}

/// The fields of a [`Calibration`] before they are checked.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UncheckedCalibration {
    format: u32,
    model: ModelId,
    rerank: RerankId,
    data: String,
    target_precision: f64,
    reranked: ConfidenceCurve,
    global: ConfidenceCurve,
    #[serde(default)]
    learned_score: Option<LearnedScore>,
}

impl TryFrom<UncheckedCalibration> for Calibration {
    type Error = InvalidValue;

    fn try_from(raw: UncheckedCalibration) -> Result<Self, Self::Error> {
        if !(FORMAT..=FORMAT_WITH_SCORE).contains(&raw.format) {
            let reason = format!(
                "{} is not known; this release reads {FORMAT} and {FORMAT_WITH_SCORE}",
                raw.format
            );
            return Err(InvalidValue::new("format", reason));
        }
        let has_score = raw.format == FORMAT_WITH_SCORE;
        if has_score != raw.learned_score.is_some() {
            let reason = "it belongs to format 2, and that to it";
            return Err(InvalidValue::new("learned_score", reason));
        }
        let is_learned = raw.rerank.score() == ScoreKind::Learned;
        let calibration = Self::new(
            raw.model,
            raw.rerank,
            raw.data,
            raw.target_precision,
            [raw.reranked, raw.global],
        )?;
        match raw.learned_score {
            Some(score) => calibration.with_score(score),
            None if is_learned => {
                let reason = "the re-ranking is by a learned score, so it must be given";
                Err(InvalidValue::new("learned_score", reason))
            }
            None => Ok(calibration),
        }
    }
}

impl Calibration {
    /// A calibration of two curves: for re-ranked answers, and for answers by distance alone.
    ///
    /// # Errors
    /// Names the first number that is not finite or not in its range.
    pub fn new(
        model: ModelId,
        rerank: RerankId,
        data: impl Into<String>,
        target_precision: f64,
        curves: [ConfidenceCurve; 2],
    ) -> Result<Self, InvalidValue> {
        let data = data.into();
        if data.chars().count() > LONGEST_DATA {
            let reason = format!("it has more than {LONGEST_DATA} characters");
            return Err(InvalidValue::new("data", reason));
        }
        check_share("target_precision", target_precision)?;
        curves.iter().try_for_each(ConfidenceCurve::check)?;
        let [reranked, global] = curves;
        if global.weights.score != 0.0 {
            return Err(InvalidValue::new(
                "global",
                "its weight of S must be 0: there is no S without re-ranking",
            ));
        }
        Ok(Self {
            format: FORMAT,
            model,
            rerank,
            data,
            target_precision,
            reranked,
            global,
            learned_score: None,
        })
    }

    /// The same with the score that candidates are ranked by.
    ///
    /// # Errors
    /// The re-ranking is not by a learned score.
    pub fn with_score(self, score: LearnedScore) -> Result<Self, InvalidValue> {
        if self.rerank.score() != ScoreKind::Learned {
            let reason = format!("the re-ranking {} is not by a learned score", self.rerank);
            return Err(InvalidValue::new("learned_score", reason));
        }
        Ok(Self {
            format: FORMAT_WITH_SCORE,
            learned_score: Some(score),
            ..self
        })
    }

    /// What candidates are ranked by, where that was learned.
    pub fn learned_score(&self) -> Option<&LearnedScore> {
        self.learned_score.as_ref()
    }

    /// The model it holds for.
    pub fn model(&self) -> &ModelId {
        &self.model
    }

    /// The re-ranking whose scores it was fitted on; answers by distance alone do not depend on
    /// it.
    pub fn rerank(&self) -> &RerankId {
        &self.rerank
    }

    /// Name of the data it was fitted on.
    pub fn data(&self) -> &str {
        &self.data
    }

    /// The share of right answers that the thresholds were chosen for.
    pub fn target_precision(&self) -> f64 {
        self.target_precision
    }

    /// The curve for answers that were re-ranked, or for those that were not.
    pub fn curve(&self, reranked: bool) -> &ConfidenceCurve {
        if reranked {
            &self.reranked
        } else {
            &self.global
        }
    }
}

/// Checks that a value lies in 0 to 1; NaN does not.
fn check_share(field: &'static str, value: f64) -> Result<(), InvalidValue> {
    if (0.0..=1.0).contains(&value) {
        return Ok(());
    }
    let reason = format!("{value} is outside 0 to 1");
    Err(InvalidValue::new(field, reason))
}

#[cfg(test)]
mod tests;

//! How far a best answer can be trusted: from its score and distance to a probability, and from
//! that to yes or no.
//!
//! A [`Calibration`] holds two curves, because an answer that was not re-ranked has no S and needs
//! an honest confidence of its own. It says how it was fitted and for which model and re-ranking
//! it holds; anywhere else its numbers mean nothing. As JSON it is a file, a column of the store
//! and a body of the web surface alike.

use super::ids::{ModelId, RerankId};
use crate::invalid::InvalidValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The version of the JSON that this release reads and writes.
const FORMAT: u32 = 1;
/// Largest magnitude of a weight. S is below a million and a distance at most 2, so that no sum of
/// such weights overflows.
const LARGEST_WEIGHT: f64 = 1e6;
/// Longest name of the data a calibration was fitted on, in characters.
const LONGEST_DATA: usize = 200;

/// Weights of a logistic curve: confidence = sigmoid(bias + score ln(1 + S) + distance d).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceWeights {
    /// Constant term.
    pub bias: f64,
    /// Weight of ln(1 + S), not negative: more inliers never make an answer less sure. 0 in a
    /// curve without S.
    #[schema(minimum = 0)]
    pub score: f64,
    /// Weight of the global distance, not positive: a farther answer is never surer.
    #[schema(maximum = 0)]
    pub distance: f64,
}

impl ConfidenceWeights {
    /// Probability, 0 to 1, that an answer with this S (`None`: not re-ranked) and Euclidean
    /// distance is right.
    pub fn confidence(&self, spatial_score: Option<f64>, global_distance: f64) -> f64 {
        let evidence = self.score * spatial_score.unwrap_or(0.0).max(0.0).ln_1p();
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
    #[schema(minimum = 1, maximum = 1)]
    format: u32,
    /// The model whose distances and scores it was fitted on.
    #[schema(value_type = String)]
    model: ModelId,
    /// The re-ranking whose S it was fitted on.
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
}

impl TryFrom<UncheckedCalibration> for Calibration {
    type Error = InvalidValue;

    fn try_from(raw: UncheckedCalibration) -> Result<Self, Self::Error> {
        if raw.format != FORMAT {
            let reason = format!("{} is not known; this release reads {FORMAT}", raw.format);
            return Err(InvalidValue::new("format", reason));
        }
        Self::new(
            raw.model,
            raw.rerank,
            raw.data,
            raw.target_precision,
            [raw.reranked, raw.global],
        )
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
        })
    }

    /// The model it holds for.
    pub fn model(&self) -> &ModelId {
        &self.model
    }

    /// The re-ranking whose S it was fitted on; answers by distance alone do not depend on it.
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
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::{Value, json};

    fn curve(score: f64) -> Value {
        json!({
            "weights": {"bias": -4.5, "score": score, "distance": -2.25},
            "threshold": 0.75,
            "right": 90,
            "wrong": 40,
            "without_match": 30,
            "precision": 0.99,
            "recall": 0.875,
            "expected_calibration_error": 0.02
        })
    }

    fn whole() -> Value {
        json!({
            "format": 1,
            "model": "m",
            "rerank": "r",
            "data": "town",
            "target_precision": 0.99,
            "reranked": curve(1.5),
            "global": curve(0.0)
        })
    }

    #[test]
    fn json_survives_and_keeps_its_shape() {
        let read: Calibration = serde_json::from_value(whole()).unwrap();
        assert_eq!(serde_json::to_value(&read).unwrap(), whole());
        assert_eq!(
            (
                read.model().as_str(),
                read.rerank().as_str(),
                read.curve(true).right
            ),
            ("m", "r", 90)
        );
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (pointer, value, named) in [
            ("/format", json!(2), "format"),
            ("/target_precision", json!(1.5), "target_precision"),
            ("/data", json!("x".repeat(201)), "data"),
            ("/reranked/threshold", json!(-0.1), "threshold"),
            ("/reranked/weights/score", json!(-1), "score"),
            ("/global/weights/distance", json!(0.5), "distance"),
            ("/global/weights/score", json!(0.5), "global"),
            ("/global/right", json!(-1), "-1"),
            ("/global/recall", Value::Null, "null"),
            ("/reranked/weights/bias", json!(1e308), "bias"),
            ("/reranked/weights/score", json!(1e308), "score"),
            ("/reranked/weights/distance", json!(-1e308), "distance"),
            ("/global/without_match", json!(41), "without_match"),
        ] {
            let mut changed = whole();
            *changed.pointer_mut(pointer).unwrap() = value;
            let error = serde_json::from_value::<Calibration>(changed)
                .unwrap_err()
                .to_string();
            assert!(error.contains(named), "{pointer}: {error}");
        }
        let mut more = whole();
        more["reranked"]["comment"] = json!("x");
        assert!(
            serde_json::from_value::<Calibration>(more)
                .unwrap_err()
                .to_string()
                .contains("comment")
        );
        let endless = ConfidenceWeights {
            bias: f64::INFINITY,
            score: 0.0,
            distance: 0.0,
        };
        let read: Calibration = serde_json::from_value(whole()).unwrap();
        let broken = ConfidenceCurve {
            weights: endless,
            ..read.curve(false).clone()
        };
        let built = Calibration::new(
            ModelId::new("m"),
            RerankId::new("r"),
            "",
            0.9,
            [broken.clone(), broken],
        );
        assert!(built.unwrap_err().to_string().contains("bias"));
    }

    /// Two numbers below `end`, the smaller first.
    fn ordered(end: f64) -> impl Strategy<Value = (f64, f64)> {
        (0.0..end, 0.0..end).prop_map(|(a, b)| (a.min(b), a.max(b)))
    }

    proptest! {
        #[test]
        fn confidence_is_a_probability_that_follows_the_evidence(
            bias in prop_oneof![-50.0..50.0f64, -LARGEST_WEIGHT..=LARGEST_WEIGHT],
            score in prop_oneof![0.0..10.0f64, 0.0..=LARGEST_WEIGHT],
            distance in prop_oneof![-20.0..0.0f64, -LARGEST_WEIGHT..=0.0],
            (fewer, more) in ordered(2000.0),
            (near, far) in ordered(2.0),
        ) {
            let weights = ConfidenceWeights { bias, score, distance };
            let confidence = weights.confidence(Some(fewer), far);
            prop_assert!((0.0..=1.0).contains(&confidence));
            prop_assert!(confidence <= weights.confidence(Some(more), far));
            prop_assert!(confidence <= weights.confidence(Some(fewer), near));
        }
    }
}

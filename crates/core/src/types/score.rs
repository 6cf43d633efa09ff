//! What candidates are ranked by; and a score that was learned from pairs of photos known to show
//! one place or not.
//!
//! The learned score is a logistic regression: every feature of a candidate is standardised,
//! weighted and added up. The sum is the logarithm of the odds that the candidate shows the place.
//! The features are named in the file, so that a score is never applied to other ones than it was
//! fitted on.

use crate::invalid::InvalidValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Largest magnitude of a number: sums of so many terms cannot overflow.
const LARGEST: f64 = 1e6;
/// Most features.
const MOST_TERMS: usize = 200;
/// Longest name of a feature in bytes.
const LONGEST_NAME: usize = 64;

/// What re-ranked candidates are ordered by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ScoreKind {
    /// S, the number of inliers (paper III-E).
    #[default]
    Paper,
    /// ln(S + 10) + 2 c, where c is the cosine of the global descriptors. Nothing is learned, and
    /// candidates that only their inliers speak for come less far.
    Fused,
    /// A [`LearnedScore`].
    Learned,
}

impl ScoreKind {
    /// All kinds, in the order of their description.
    pub const ALL: [Self; 3] = [Self::Paper, Self::Fused, Self::Learned];

    /// Its name in settings and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Fused => "fused",
            Self::Learned => "learned",
        }
    }

    /// What a candidate's value counts for in a calibration: ln(1 + S), or the value itself, which
    /// is a logarithm.
    pub fn evidence(self, value: f64) -> f64 {
        match self {
            Self::Paper => value.max(0.0).ln_1p(),
            Self::Fused | Self::Learned => value,
        }
    }
}

/// One feature and what it counts for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ScoreTerm {
    /// Name of the feature, such as `s11.inliers`.
    #[schema(max_length = 64)]
    pub feature: String,
    /// Its mean over the pairs of the fit.
    pub mean: f64,
    /// Its standard deviation over them.
    #[schema(exclusive_minimum = 0)]
    pub deviation: f64,
    /// What one standard deviation above the mean adds to the score.
    pub weight: f64,
}

/// A logistic regression over named features.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "UncheckedScore", deny_unknown_fields)]
pub struct LearnedScore {
    /// Constant term.
    bias: f64,
    /// The other terms.
    #[schema(min_items = 1, max_items = 200)]
    terms: Vec<ScoreTerm>,
}

/// The fields of a [`LearnedScore`] before they are checked.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UncheckedScore {
    bias: f64,
    terms: Vec<ScoreTerm>,
}

impl TryFrom<UncheckedScore> for LearnedScore {
    type Error = InvalidValue;

    fn try_from(raw: UncheckedScore) -> Result<Self, Self::Error> {
        Self::new(raw.bias, raw.terms)
    }
}

impl LearnedScore {
    /// A score of these terms.
    ///
    /// # Errors
    /// There are no terms or too many; or a number is out of range, and the error names it.
    pub fn new(bias: f64, terms: Vec<ScoreTerm>) -> Result<Self, InvalidValue> {
        if !(1..=MOST_TERMS).contains(&terms.len()) {
            let reason = format!("{} are not 1 to {MOST_TERMS}", terms.len());
            return Err(InvalidValue::new("terms", reason));
        }
        check("bias", bias, -LARGEST..=LARGEST)?;
        for term in &terms {
            if term.feature.len() > LONGEST_NAME {
                let reason = format!("it has more than {LONGEST_NAME} bytes");
                return Err(InvalidValue::new("feature", reason));
            }
            check("mean", term.mean, -LARGEST..=LARGEST)?;
            check("deviation", term.deviation, 1.0 / LARGEST..=LARGEST)?;
            check("weight", term.weight, -LARGEST..=LARGEST)?;
        }
        Ok(Self { bias, terms })
    }

    /// Refuses other features than those it was fitted on.
    ///
    /// # Errors
    /// Names the first feature that differs.
    pub fn check_features(&self, names: &[String]) -> Result<(), InvalidValue> {
        let own: Vec<&str> = self.terms.iter().map(|it| it.feature.as_str()).collect();
        if own == *names {
            return Ok(());
        }
        let differs = |at: &usize| own.get(*at).copied() != names.get(*at).map(String::as_str);
        let first = (0..own.len().max(names.len())).find(differs);
        let first = first.unwrap_or_default();
        let [given, wanted] = [
            own.get(first).copied(),
            names.get(first).map(String::as_str),
        ];
        let name = |name: Option<&str>| name.unwrap_or("nothing").to_owned();
        let reason = format!(
            "its feature {} is {} where this program has {}",
            first + 1,
            name(given),
            name(wanted)
        );
        Err(InvalidValue::new("learned_score", reason))
    }

    /// The logarithm of the odds that a candidate of these features shows the place. `features`
    /// are in the order of the terms.
    pub fn logit(&self, features: &[f64]) -> f64 {
        debug_assert_eq!(features.len(), self.terms.len());
        let terms = self.terms.iter().zip(features);
        let sum: f64 = terms
            .map(|(term, value)| term.weight * ((value - term.mean) / term.deviation))
            .sum();
        self.bias + sum
    }

    /// Its terms.
    pub fn terms(&self) -> &[ScoreTerm] {
        &self.terms
    }
}

fn check(
    field: &'static str,
    value: f64,
    range: std::ops::RangeInclusive<f64>,
) -> Result<(), InvalidValue> {
    // NaN is in no range.
    if range.contains(&value) {
        return Ok(());
    }
    let reason = format!("{value} is outside {} to {}", range.start(), range.end());
    Err(InvalidValue::new(field, reason))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn whole() -> Value {
        json!({"bias": -1.5, "terms": [
            {"feature": "a", "mean": 2.0, "deviation": 0.5, "weight": 3.0},
            {"feature": "b", "mean": -1.0, "deviation": 2.0, "weight": -0.25},
        ]})
    }

    #[test]
    fn features_are_standardised_weighted_and_added_up() {
        let score: LearnedScore = serde_json::from_value(whole()).unwrap();
        assert_eq!(score.logit(&[2.0, -1.0]), -1.5);
        assert_eq!(score.logit(&[3.0, 1.0]), -1.5 + 3.0 * 2.0 - 0.25);
        assert_eq!(serde_json::to_value(&score).unwrap(), whole());
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (pointer, value, named) in [
            ("/bias", json!(1e9), "bias"),
            ("/terms", json!([]), "terms"),
            ("/terms/0/deviation", json!(0.0), "deviation"),
            ("/terms/1/weight", Value::Null, "null"),
            ("/terms/1/mean", json!(-1e9), "mean"),
            ("/terms/1/feature", json!("x".repeat(65)), "feature"),
        ] {
            let mut changed = whole();
            *changed.pointer_mut(pointer).unwrap() = value;
            let error = serde_json::from_value::<LearnedScore>(changed).unwrap_err();
            assert!(error.to_string().contains(named), "{pointer}: {error}");
        }
    }

    #[test]
    fn other_features_are_refused_by_name() {
        let score: LearnedScore = serde_json::from_value(whole()).unwrap();
        let names = |names: &[&str]| names.iter().map(ToString::to_string).collect::<Vec<_>>();
        score.check_features(&names(&["a", "b"])).unwrap();
        for (given, named) in [
            (names(&["a", "c"]), "2 is b where this program has c"),
            (names(&["a"]), "2 is b where this program has nothing"),
            (
                names(&["a", "b", "d"]),
                "3 is nothing where this program has d",
            ),
        ] {
            let error = score.check_features(&given).unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
    }
}

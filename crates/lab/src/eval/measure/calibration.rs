//! From scores to a probability that the best answer is right, and the threshold from which on it
//! is trusted.
//!
//! The curve is fitted on all answers. Everything that is told about it as a promise (calibration
//! error, precision, recall) comes from fits and thresholds that have not seen the places they are
//! judged on.

use super::answers::TopOne;
use super::cross_validation::{FOLDS, cross_validate, predictions_of};
use super::fit::{CalibrationError, RIDGE, fit, predict};
use super::reliability::{calibration_error, reliability};
use super::threshold::{ThresholdCheck, check_threshold, choose_threshold};
use placeformer_core::types::{ConfidenceCurve, ConfidenceWeights};

/// A curve with all that is known about it.
#[derive(Debug, Clone, PartialEq)]
pub struct FittedCurve {
    /// The curve; its precision and recall are those of `check`.
    pub curve: ConfidenceCurve,
    /// Calibration error on the answers it was fitted on.
    pub in_sample_error: f64,
    /// What its threshold is worth elsewhere.
    pub check: ThresholdCheck,
}

/// Fits a curve, and judges it on what it has not seen.
///
/// Weights and shares are rounded to six digits, so that a file shows what is meant.
///
/// # Errors
/// All answers are right, or all are wrong.
pub fn fit_curve(
    answers: &[TopOne],
    target: f64,
    seed: u64,
) -> Result<FittedCurve, CalibrationError> {
    let raw = fit(answers, RIDGE)?;
    let weights = ConfidenceWeights {
        bias: rounded(raw.bias),
        score: rounded(raw.score),
        distance: rounded(raw.distance),
    };
    let unseen = cross_validate(answers, RIDGE, FOLDS, seed);
    let predictions = predictions_of(&unseen);
    let check = check_threshold(&unseen, target);
    let count =
        |wanted: fn(&TopOne) -> bool| answers.iter().filter(|answer| wanted(answer)).count() as u64;
    let curve = ConfidenceCurve {
        weights,
        threshold: rounded(choose_threshold(&predictions, target).threshold),
        right: count(|answer| answer.correct),
        wrong: count(|answer| !answer.correct),
        without_match: count(|answer| !answer.has_match),
        precision: rounded(check.precision),
        recall: rounded(check.recall),
        expected_calibration_error: rounded(calibration_error(&reliability(&predictions))),
    };
    let in_sample_error = calibration_error(&reliability(&predict(&weights, answers)));
    Ok(FittedCurve {
        curve,
        in_sample_error,
        check,
    })
}

fn rounded(value: f64) -> f64 {
    // Adding zero turns -0 into 0.
    (value * 1e6).round() / 1e6 + 0.0
}

#[cfg(test)]
mod tests;

//! Logistic regression on the evidence of a score, ln(1 + S) for S itself, and the global
//! distance.
//!
//! Fitted by Newton's method with a small ridge penalty, so that separable data do not send the
//! weights to infinity. A slope of the wrong sign (fewer inliers making an answer surer) is an
//! accident of few data: it is held at zero.

use super::answers::{Prediction, TopOne};
use nalgebra::{Matrix3, Vector3};
use placeformer_core::types::ConfidenceWeights;

/// Why no calibration could be fitted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CalibrationError {
    /// Without both kinds there is nothing to tell apart.
    #[error(
        "calibration needs right and wrong answers; there are {right} right and {wrong} wrong ones"
    )]
    OneSided {
        /// Right answers.
        right: usize,
        /// Wrong answers.
        wrong: usize,
    },
}

/// The penalty that suits hundreds to thousands of answers.
pub const RIDGE: f64 = 1e-2;

/// Fits the weights. `ridge` penalises the two slopes (not the bias); [`RIDGE`] is a sensible
/// value.
///
/// # Errors
/// All answers are right, or all are wrong.
pub fn fit(answers: &[TopOne], ridge: f64) -> Result<ConfidenceWeights, CalibrationError> {
    let right = answers.iter().filter(|answer| answer.correct).count();
    let wrong = answers.len() - right;
    if right == 0 || wrong == 0 {
        return Err(CalibrationError::OneSided { right, wrong });
    }
    let mut use_score = 1.0;
    let mut use_distance = 1.0;
    // Each round but the last holds one of the two slopes at zero, so the third round is the last.
    loop {
        let used = Vector3::new(1.0, use_score, use_distance);
        let weights = maximum_likelihood(answers, ridge, used);
        let score = weights[1];
        let distance = weights[2];
        if score < 0.0 {
            use_score = 0.0;
        } else if distance > 0.0 {
            use_distance = 0.0;
        } else {
            return Ok(ConfidenceWeights {
                bias: weights[0],
                score,
                distance,
            });
        }
    }
}

/// Newton's method on the penalised likelihood; features whose `used` is 0 get weight 0.
fn maximum_likelihood(answers: &[TopOne], ridge: f64, used: Vector3<f64>) -> Vector3<f64> {
    let features = |answer: &TopOne| {
        let evidence = answer.evidence.unwrap_or(0.0);
        Vector3::new(1.0, evidence, answer.global_distance).component_mul(&used)
    };
    let penalty = Matrix3::from_diagonal(&Vector3::new(1e-9, ridge, ridge));
    let loss = |w: &Vector3<f64>| -> f64 {
        let data: f64 = answers
            .iter()
            .map(|answer| {
                let margin = w.dot(&features(answer)) * if answer.correct { 1.0 } else { -1.0 };
                // ln(1 + e^-m) without overflow.
                (-margin).max(0.0) + (-margin.abs()).exp().ln_1p()
            })
            .sum();
        data + 0.5 * w.dot(&(penalty * w))
    };
    let mut weights = Vector3::zeros();
    for _ in 0..100 {
        let mut gradient = penalty * weights;
        let mut hessian = penalty;
        for answer in answers {
            let x = features(answer);
            let p = sigmoid(weights.dot(&x));
            gradient += x * (p - f64::from(u8::from(answer.correct)));
            hessian += x * x.transpose() * (p * (1.0 - p));
        }
        let Some(step) = hessian.cholesky().map(|factor| factor.solve(&gradient)) else {
            break;
        };
        // A full step can overshoot where the curve is flat; halve it until the loss falls.
        let mut share = 1.0;
        while loss(&(weights - step * share)) > loss(&weights) && share > 1e-6 {
            share /= 2.0;
        }
        weights -= step * share;
        if step.norm() * share < 1e-10 {
            break;
        }
    }
    weights
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// What `weights` say about every answer.
pub fn predict(weights: &ConfidenceWeights, answers: &[TopOne]) -> Vec<Prediction> {
    let one = |answer: &TopOne| Prediction {
        confidence: weights.confidence(answer.evidence, answer.global_distance),
        correct: answer.correct,
        has_match: answer.has_match,
    };
    answers.iter().map(one).collect()
}

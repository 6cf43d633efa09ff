//! From scores to a probability that the best answer is right.
//!
//! Logistic regression on ln(1 + S) and the global distance, fitted by Newton's method with a small ridge penalty, so
//! that separable data do not send the weights to infinity. How well it holds is told by the expected calibration
//! error: queries are put into ten bins of confidence, and the mean confidence is compared with the share of right
//! answers.

use nalgebra::{Matrix3, Vector3};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// A query's best answer with what is known about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TopOne {
    /// S of the best answer.
    pub spatial_score: f64,
    /// Its Euclidean distance.
    pub global_distance: f64,
    /// Whether it is a positive; false where no match exists.
    pub correct: bool,
}

/// Fitted weights: confidence = sigmoid(bias + score ln(1 + S) + distance d).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Constant term.
    pub bias: f64,
    /// Weight of ln(1 + S).
    pub score: f64,
    /// Weight of the global distance.
    pub distance: f64,
}

/// Why no calibration could be fitted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CalibrationError {
    /// Without both kinds there is nothing to tell apart.
    #[error("calibration needs right and wrong answers; there are {right} right and {wrong} wrong ones")]
    OneSided {
        /// Right answers.
        right: usize,
        /// Wrong answers.
        wrong: usize,
    },
}

impl Calibration {
    /// Probability, 0 to 1, that an answer with this score and distance is right.
    pub fn confidence(&self, spatial_score: f64, global_distance: f64) -> f64 {
        sigmoid(self.bias + self.score * spatial_score.max(0.0).ln_1p() + self.distance * global_distance)
    }
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Fits a calibration. `ridge` penalises the two slopes (not the bias); 1e-2 is a sensible value.
pub fn fit(answers: &[TopOne], ridge: f64) -> Result<Calibration, CalibrationError> {
    let right = answers.iter().filter(|answer| answer.correct).count();
    let wrong = answers.len() - right;
    if right == 0 || wrong == 0 {
        return Err(CalibrationError::OneSided { right, wrong });
    }
    let features = |answer: &TopOne| Vector3::new(1.0, answer.spatial_score.max(0.0).ln_1p(), answer.global_distance);
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
        let Some(step) = hessian.cholesky().map(|factor| factor.solve(&gradient)) else { break };
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
    Ok(Calibration { bias: weights[0], score: weights[1], distance: weights[2] })
}

/// The penalty that suits hundreds to thousands of answers.
pub const RIDGE: f64 = 1e-2;

/// Confidence of every answer from a fit that has not seen it, with whether it was right. Each fold holds its share of
/// right and of wrong answers; an answer whose other folds are one-sided is left out.
pub fn cross_validate(answers: &[TopOne], ridge: f64, folds: usize, seed: u64) -> Vec<(f64, bool)> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut right, mut wrong): (Vec<TopOne>, Vec<TopOne>) = answers.iter().partition(|answer| answer.correct);
    right.shuffle(&mut random);
    wrong.shuffle(&mut random);
    let dealt: Vec<(usize, TopOne)> =
        right.into_iter().chain(wrong).enumerate().map(|(i, answer)| (i % folds.max(2), answer)).collect();
    let mut predictions = Vec::new();
    for fold in 0..folds.max(2) {
        let others: Vec<TopOne> = dealt.iter().filter(|(own, _)| *own != fold).map(|(_, answer)| *answer).collect();
        let Ok(fitted) = fit(&others, ridge) else { continue };
        let held_out = dealt.iter().filter(|(own, _)| *own == fold);
        predictions.extend(held_out.map(|(_, a)| (fitted.confidence(a.spatial_score, a.global_distance), a.correct)));
    }
    predictions
}

/// One bin of confidence.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ReliabilityBin {
    /// Mean confidence of its answers.
    pub confidence: f64,
    /// Share of right answers.
    pub accuracy: f64,
    /// How many.
    pub count: usize,
}

/// Ten bins of equal width; empty ones are left out.
pub fn reliability(predictions: &[(f64, bool)]) -> Vec<ReliabilityBin> {
    let mut bins = [(0.0, 0usize, 0usize); 10];
    for &(confidence, correct) in predictions {
        let bin = &mut bins[((confidence * 10.0) as usize).min(9)];
        bin.0 += confidence;
        bin.1 += usize::from(correct);
        bin.2 += 1;
    }
    let filled = bins.into_iter().filter(|bin| bin.2 > 0);
    filled
        .map(|(sum, right, count)| ReliabilityBin {
            confidence: sum / count as f64,
            accuracy: right as f64 / count as f64,
            count,
        })
        .collect()
}

/// Expected calibration error, 0 to 1: how far confidence and accuracy lie apart, weighted by the bins' counts.
pub fn calibration_error(bins: &[ReliabilityBin]) -> f64 {
    let total: usize = bins.iter().map(|bin| bin.count).sum();
    bins.iter().map(|bin| (bin.confidence - bin.accuracy).abs() * bin.count as f64 / total.max(1) as f64).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn planted_weights_are_recovered() {
        let truth = Calibration { bias: -3.0, score: 1.5, distance: -2.0 };
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let answers: Vec<TopOne> = (0..20_000)
            .map(|_| {
                let (spatial_score, global_distance) = (random.random_range(0.0..120.0), random.random_range(0.0..1.5));
                let correct = random.random::<f64>() < truth.confidence(spatial_score, global_distance);
                TopOne { spatial_score, global_distance, correct }
            })
            .collect();
        let fitted = fit(&answers, 1e-3).unwrap();
        for (a, b) in [(fitted.bias, truth.bias), (fitted.score, truth.score), (fitted.distance, truth.distance)] {
            assert!((a - b).abs() < 0.25, "{fitted:?}");
        }
        let predictions: Vec<_> =
            answers.iter().map(|a| (fitted.confidence(a.spatial_score, a.global_distance), a.correct)).collect();
        assert!(calibration_error(&reliability(&predictions)) < 0.02);
        let unseen = cross_validate(&answers, 1e-3, 5, 1);
        assert_eq!(unseen.len(), answers.len());
        assert!(calibration_error(&reliability(&unseen)) < 0.02);
    }

    #[test]
    fn separable_answers_stay_finite_and_one_kind_is_refused() {
        let answer = |spatial_score, correct| TopOne { spatial_score, global_distance: 0.5, correct };
        let answers = [answer(100.0, true), answer(90.0, true), answer(5.0, false), answer(8.0, false)];
        let fitted = fit(&answers, 1e-2).unwrap();
        assert!(fitted.confidence(100.0, 0.5) > 0.9 && fitted.confidence(5.0, 0.5) < 0.1, "{fitted:?}");
        assert!(fitted.score.is_finite());
        assert_eq!(fit(&answers[..2], 1e-2), Err(CalibrationError::OneSided { right: 2, wrong: 0 }));
    }

    #[test]
    fn calibration_error_by_hand() {
        // Confidence 0.95 with half of them right; confidence 0.05 with none right.
        let predictions = [(0.95, true), (0.95, false), (0.05, false), (0.05, false)];
        let error = calibration_error(&reliability(&predictions));
        assert!((error - (0.45 * 0.5 + 0.05 * 0.5)).abs() < 1e-12, "{error}");
        assert_eq!(calibration_error(&[]), 0.0);
    }
}

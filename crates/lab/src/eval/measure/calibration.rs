//! From scores to a probability that the best answer is right, and the threshold from which on it
//! is trusted.
//!
//! Logistic regression on ln(1 + S) and the global distance, fitted by Newton's method with a small
//! ridge penalty, so that separable data do not send the weights to infinity. A slope of the wrong
//! sign (fewer inliers making an answer surer) is an accident of few data: it is held at zero. How
//! well the curve holds is told by the expected calibration error: queries are put into ten bins of
//! confidence, and the mean confidence is compared with the share of right answers. What is told
//! about unseen queries comes from cross-validation by place: neighbouring frames of one street are
//! nearly the same photo, so a fit that has seen one has seen the other. The threshold is judged
//! the same way, on places that had no say in choosing it; chosen and judged on the same answers,
//! it would keep its promise by construction.

use super::folds::folds_of;
use nalgebra::{Matrix3, Vector3};
use placeformer_core::types::{ConfidenceCurve, ConfidenceWeights};
use serde::Serialize;
use std::collections::BTreeSet;

/// A query's best answer with what is known about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TopOne {
    /// The place asked about: answers to one query (with and without its place in the database)
    /// share it, and so do queries that show the same place.
    pub place: usize,
    /// S of the best answer; `None` if it was not re-ranked.
    pub spatial_score: Option<f64>,
    /// Its Euclidean distance.
    pub global_distance: f64,
    /// Whether it is a positive; false where no match exists.
    pub correct: bool,
    /// Whether the database searched shows the place at all.
    pub has_match: bool,
}

/// An answer with the confidence given to it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// Probability, 0 to 1, that it is right.
    pub confidence: f64,
    /// Whether it is.
    pub correct: bool,
    /// Whether the database searched shows the place at all.
    pub has_match: bool,
}

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

/// Parts in which answers are divided to judge a fit by what it has not seen.
pub const FOLDS: usize = 5;

/// Fits the weights. `ridge` penalises the two slopes (not the bias); [`RIDGE`] is a sensible
/// value.
pub fn fit(answers: &[TopOne], ridge: f64) -> Result<ConfidenceWeights, CalibrationError> {
    let right = answers.iter().filter(|answer| answer.correct).count();
    let wrong = answers.len() - right;
    if right == 0 || wrong == 0 {
        return Err(CalibrationError::OneSided { right, wrong });
    }
    let (mut use_score, mut use_distance) = (1.0, 1.0);
    // Each round can only take a slope away, so three rounds always end.
    loop {
        let weights =
            maximum_likelihood(answers, ridge, Vector3::new(1.0, use_score, use_distance));
        match (weights[1] < 0.0, weights[2] > 0.0) {
            (false, false) => {
                return Ok(ConfidenceWeights {
                    bias: weights[0],
                    score: weights[1],
                    distance: weights[2],
                });
            }
            (score_is_wrong, _) if score_is_wrong => use_score = 0.0,
            _ => use_distance = 0.0,
        }
    }
}

/// Newton's method on the penalised likelihood; features whose `used` is 0 get weight 0.
fn maximum_likelihood(answers: &[TopOne], ridge: f64, used: Vector3<f64>) -> Vector3<f64> {
    let features = |answer: &TopOne| {
        let inliers = answer.spatial_score.unwrap_or(0.0).max(0.0).ln_1p();
        Vector3::new(1.0, inliers, answer.global_distance).component_mul(&used)
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
        confidence: weights.confidence(answer.spatial_score, answer.global_distance),
        correct: answer.correct,
        has_match: answer.has_match,
    };
    answers.iter().map(one).collect()
}

/// A prediction by a fit that has not seen its place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unseen {
    /// The part it was left out with.
    pub fold: usize,
    /// The place asked about.
    pub place: usize,
    /// What the fit to the other parts said.
    pub prediction: Prediction,
}

/// Confidence of every answer from a fit that has not seen its place; a fold whose others are
/// one-sided is left out.
pub fn cross_validate(answers: &[TopOne], ridge: f64, folds: usize, seed: u64) -> Vec<Unseen> {
    let fold_of = folds_of(answers, folds, seed);
    let with_fold = || answers.iter().copied().zip(fold_of.iter().copied());
    let mut unseen = Vec::new();
    for fold in 0..folds.max(2) {
        let others: Vec<TopOne> = with_fold()
            .filter(|one| one.1 != fold)
            .map(|one| one.0)
            .collect();
        let own: Vec<TopOne> = with_fold()
            .filter(|one| one.1 == fold)
            .map(|one| one.0)
            .collect();
        let Ok(fitted) = fit(&others, ridge) else {
            continue;
        };
        let predictions = predict(&fitted, &own);
        unseen.extend(own.iter().zip(predictions).map(|(one, prediction)| Unseen {
            fold,
            place: one.place,
            prediction,
        }));
    }
    unseen
}

/// The predictions alone.
pub fn predictions_of(unseen: &[Unseen]) -> Vec<Prediction> {
    unseen.iter().map(|one| one.prediction).collect()
}

/// How well a threshold keeps its promise on places that had no say in choosing it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ThresholdCheck {
    /// Answers trusted.
    pub count: usize,
    /// Places they show.
    pub places: usize,
    /// Share of right ones among them, 0 to 1; 1 if there are none.
    pub precision: f64,
    /// 95% interval of the precision (Wilson's, each place counted once, because answers within one
    /// go together).
    pub interval: [f64; 2],
    /// Right ones among them as a share of the queries that have a match, 0 to 1.
    pub recall: f64,
}

/// Chooses a threshold on all folds but one and applies it to that one, in turn.
pub fn check_threshold(unseen: &[Unseen], target: f64) -> ThresholdCheck {
    let folds: BTreeSet<usize> = unseen.iter().map(|one| one.fold).collect();
    let mut trusted: Vec<&Unseen> = Vec::new();
    for fold in folds {
        let (own, others): (Vec<&Unseen>, Vec<&Unseen>) =
            unseen.iter().partition(|one| one.fold == fold);
        let others: Vec<Prediction> = others.into_iter().map(|one| one.prediction).collect();
        let threshold = choose_threshold(&others, target).threshold;
        trusted.extend(
            own.into_iter()
                .filter(|one| one.prediction.confidence >= threshold),
        );
    }
    let right = trusted.iter().filter(|one| one.prediction.correct).count();
    let with_match = unseen.iter().filter(|one| one.prediction.has_match).count();
    let places = trusted
        .iter()
        .map(|one| one.place)
        .collect::<BTreeSet<_>>()
        .len();
    let precision = if trusted.is_empty() {
        1.0
    } else {
        right as f64 / trusted.len() as f64
    };
    ThresholdCheck {
        count: trusted.len(),
        places,
        precision,
        interval: wilson(precision, places),
        recall: right as f64 / with_match.max(1) as f64,
    }
}

/// Wilson's 95% interval of a share seen in `count` independent trials; everything is possible
/// without any.
fn wilson(share: f64, count: usize) -> [f64; 2] {
    const Z: f64 = 1.959_963_984_540_054;
    if count == 0 {
        return [0.0, 1.0];
    }
    let (n, z2) = (count as f64, Z * Z);
    let centre = (share + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = Z / (1.0 + z2 / n) * (share * (1.0 - share) / n + z2 / (4.0 * n * n)).sqrt();
    [(centre - half).max(0.0), (centre + half).min(1.0)]
}

/// Where on a curve trust begins, and what it costs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Trusted {
    /// Answers of this confidence or more are trusted.
    pub threshold: f64,
    /// Answers that are.
    pub count: usize,
    /// Share of right ones among them, 0 to 1; 1 if there are none.
    pub precision: f64,
    /// Right ones among them as a share of the queries that have a match, 0 to 1.
    pub recall: f64,
}

/// What trusting from `threshold` on comes to.
pub fn trusted(predictions: &[Prediction], threshold: f64) -> Trusted {
    let accepted = || predictions.iter().filter(|one| one.confidence >= threshold);
    let (count, right) = (
        accepted().count(),
        accepted().filter(|one| one.correct).count(),
    );
    let with_match = predictions.iter().filter(|one| one.has_match).count();
    Trusted {
        threshold,
        count,
        precision: if count == 0 {
            1.0
        } else {
            right as f64 / count as f64
        },
        recall: right as f64 / with_match.max(1) as f64,
    }
}

/// The lowest threshold from which on the share of right answers reaches `target`, but never below
/// one half: an answer that is more likely wrong than right is not trusted, however few wrong ones
/// there are. Where even the surest answers miss the target it is 1, which trusts nothing but
/// certainty.
pub fn choose_threshold(predictions: &[Prediction], target: f64) -> Trusted {
    let mut candidates: Vec<f64> = predictions
        .iter()
        .map(|one| one.confidence)
        .filter(|confidence| *confidence >= 0.5)
        .collect();
    candidates.push(0.5);
    candidates.sort_unstable_by(f64::total_cmp);
    candidates.dedup();
    let reached = candidates
        .into_iter()
        .map(|threshold| trusted(predictions, threshold));
    let mut reached = reached.filter(|point| point.count > 0 && point.precision >= target);
    reached.next().unwrap_or_else(|| trusted(predictions, 1.0))
}

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
    let (predictions, check) = (predictions_of(&unseen), check_threshold(&unseen, target));
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
pub fn reliability(predictions: &[Prediction]) -> Vec<ReliabilityBin> {
    let mut bins = [(0.0, 0usize, 0usize); 10];
    for prediction in predictions {
        let bin = &mut bins[((prediction.confidence * 10.0) as usize).min(9)];
        bin.0 += prediction.confidence;
        bin.1 += usize::from(prediction.correct);
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

/// Expected calibration error, 0 to 1: how far confidence and accuracy lie apart, weighted by the
/// bins' counts.
pub fn calibration_error(bins: &[ReliabilityBin]) -> f64 {
    let total: usize = bins.iter().map(|bin| bin.count).sum();
    bins.iter()
        .map(|bin| (bin.confidence - bin.accuracy).abs() * bin.count as f64 / total.max(1) as f64)
        .sum()
}

#[cfg(test)]
mod tests;

//! Confidences of answers from fits that have not seen their places.
//!
//! Neighbouring frames of one street are nearly the same photo, so a fit that has seen one has seen
//! the other. Answers are therefore divided by place.

use super::answers::{Prediction, TopOne};
use super::fit::{fit, predict};
use super::folds::folds_of;

/// Parts in which answers are divided to judge a fit by what it has not seen.
pub const FOLDS: usize = 5;

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
    let labels: Vec<(usize, bool)> = answers.iter().map(|it| (it.place, it.correct)).collect();
    let fold_of = folds_of(&labels, folds, seed);
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

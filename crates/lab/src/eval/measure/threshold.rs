//! From which confidence on an answer is trusted, and what that is worth.
//!
//! A threshold that is chosen and judged on the same answers keeps its promise by construction. It
//! is therefore judged on places that had no part in choosing it.

use super::answers::Prediction;
use super::cross_validation::Unseen;
use serde::Serialize;
use std::collections::BTreeSet;

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
    let places: BTreeSet<usize> = trusted.iter().map(|one| one.place).collect();
    let precision = if trusted.is_empty() {
        1.0
    } else {
        right as f64 / trusted.len() as f64
    };
    ThresholdCheck {
        count: trusted.len(),
        places: places.len(),
        precision,
        interval: wilson(precision, places.len()),
        recall: right as f64 / with_match.max(1) as f64,
    }
}

/// Wilson's 95% interval of a share seen in `count` independent trials; everything is possible
/// without any.
pub(super) fn wilson(share: f64, count: usize) -> [f64; 2] {
    const Z: f64 = 1.959_963_984_540_054;
    if count == 0 {
        return [0.0, 1.0];
    }
    let n = count as f64;
    let z2 = Z * Z;
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
    let count = accepted().count();
    let right = accepted().filter(|one| one.correct).count();
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

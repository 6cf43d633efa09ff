//! How far confidences can be believed: the expected calibration error.
//!
//! Answers are put into ten bins of confidence, and the mean confidence of each is compared with
//! its share of right answers.

use super::answers::Prediction;
use serde::Serialize;

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

/// What is added up in a bin.
#[derive(Clone, Copy, Default)]
struct Sums {
    confidence: f64,
    right: usize,
    count: usize,
}

/// Ten bins of equal width; empty ones are left out.
pub fn reliability(predictions: &[Prediction]) -> Vec<ReliabilityBin> {
    let mut bins = [Sums::default(); 10];
    for prediction in predictions {
        let bin = &mut bins[((prediction.confidence * 10.0) as usize).min(9)];
        bin.confidence += prediction.confidence;
        bin.right += usize::from(prediction.correct);
        bin.count += 1;
    }
    bins.into_iter()
        .filter(|bin| bin.count > 0)
        .map(|bin| ReliabilityBin {
            confidence: bin.confidence / bin.count as f64,
            accuracy: bin.right as f64 / bin.count as f64,
            count: bin.count,
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

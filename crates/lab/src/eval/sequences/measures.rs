//! The numbers of a drive, as pure functions of its frames.

use super::SequenceOptions;
use super::drive::Frame;
use crate::eval::measure::{Prediction, ReliabilityBin, calibration_error, reliability};
use placeformer_core::types::{ConfidenceCurve, GeoPoint};
use serde::Serialize;

/// Shares of errors that the accuracy is compared at.
const SHARES: [f64; 6] = [0.2, 0.4, 0.5, 0.68, 0.8, 0.95];

/// The share that an accuracy is a radius of.
const ACCURACY_SHARE: f64 = 0.68;

/// What was measured on the queries as sequences.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SequenceSummary {
    /// How they were driven.
    pub options: SequenceOptions,
    /// Whether the data set gives no positions, so that a spacing was assumed.
    pub positions_assumed: bool,
    /// How far single answers can be believed.
    pub alone: Certainty,
    /// How far answers of a track can be believed.
    pub tracked: Certainty,
    /// From the first frame to one that is right and trusted.
    pub first_found: Finding,
    /// The same from each frame on before which the vehicle was carried elsewhere.
    pub found_again: Finding,
    /// Frames after which the vehicle was thought to be at no known place.
    pub frames_lost: usize,
    /// Shares of trusted positions whose error was within what the accuracy says; none where
    /// positions are not known.
    pub accuracy: Vec<AccuracyPoint>,
    /// Median error in metres of trusted positions.
    pub median_error_m: Option<f64>,
    /// The same of the first answers' own positions.
    pub median_error_of_best_m: Option<f64>,
    /// Mean milliseconds that the filter takes for one frame.
    pub step_ms: f64,
}

/// How far answers can be believed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Certainty {
    /// Mean gap between confidence and share of right answers, 0 to 1.
    pub expected_calibration_error: f64,
    /// Frames that are trusted.
    pub trusted: usize,
    /// Of these, frames whose first answer is wrong: confident and wrong.
    pub trusted_and_wrong: usize,
    /// Frames of known truth.
    pub judged: usize,
    /// The gap by confidence.
    pub bins: Vec<ReliabilityBin>,
}

/// How many frames it takes until a vehicle is found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Frames until one was right and trusted, that one included, for each beginning; sorted.
    pub frames: Vec<usize>,
    /// Beginnings from which it was not found before the next.
    pub never: usize,
}

/// A point of the curve of accuracy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AccuracyPoint {
    /// The share of errors that should be within the radius.
    pub expected: f64,
    /// The share that is.
    pub observed: f64,
}

impl Certainty {
    /// Of frames whose confidences are trusted as `curve` says.
    pub(super) fn of(frames: &[Frame], curve: &ConfidenceCurve) -> Self {
        let judged: Vec<&Frame> = frames.iter().filter(|frame| frame.is_judged).collect();
        let predictions: Vec<Prediction> = judged
            .iter()
            .map(|frame| Prediction {
                confidence: frame.probability,
                correct: frame.is_right(),
                has_match: !frame.positives.is_empty(),
            })
            .collect();
        let bins = reliability(&predictions);
        let trusted = || {
            predictions
                .iter()
                .filter(|one| curve.trusts(one.confidence))
        };
        Self {
            expected_calibration_error: calibration_error(&bins),
            trusted: trusted().count(),
            trusted_and_wrong: trusted().filter(|one| !one.correct).count(),
            judged: judged.len(),
            bins,
        }
    }
}

impl Finding {
    /// From each of the frames `starts`, ascending, until the next.
    pub(super) fn of(frames: &[Frame], starts: &[usize], curve: &ConfidenceCurve) -> Self {
        let is_found = |frame: &Frame| frame.is_right() && curve.trusts(frame.probability);
        let mut found = Vec::new();
        let mut never = 0;
        for (i, &start) in starts.iter().enumerate() {
            let end = starts.get(i + 1).copied().unwrap_or(frames.len());
            match frames[start..end].iter().position(is_found) {
                Some(position) => found.push(position + 1),
                None => never += 1,
            }
        }
        found.sort_unstable();
        Self {
            frames: found,
            never,
        }
    }

    /// The median, if any was found.
    pub fn median(&self) -> Option<usize> {
        self.frames.get(self.frames.len() / 2).copied()
    }
}

/// How many errors of trusted positions are within the radius that the accuracy promises for each
/// share. Errors in two dimensions follow Rayleigh's distribution if each is normal.
pub(super) fn accuracy(frames: &[Frame], curve: &ConfidenceCurve) -> Vec<AccuracyPoint> {
    let estimated: Vec<_> = trusted(frames, curve)
        .filter_map(|frame| frame.estimated)
        .collect();
    if estimated.is_empty() {
        return Vec::new();
    }
    let point = |expected: f64| {
        let factor = ((1.0 - expected).ln() / (1.0 - ACCURACY_SHARE).ln()).sqrt();
        let within = estimated
            .iter()
            .filter(|one| one.error_m <= factor * one.accuracy_m);
        AccuracyPoint {
            expected,
            observed: within.count() as f64 / estimated.len() as f64,
        }
    };
    SHARES.into_iter().map(point).collect()
}

/// Median error in metres of the estimates of trusted frames.
pub(super) fn median_error(frames: &[Frame], curve: &ConfidenceCurve) -> Option<f64> {
    median(trusted(frames, curve).filter_map(|frame| Some(frame.estimated?.error_m)))
}

/// Median error in metres of the first answers of trusted frames.
pub(super) fn median_error_of_best(frames: &[Frame], curve: &ConfidenceCurve) -> Option<f64> {
    median(trusted(frames, curve).filter_map(|frame| frame.error_of_best_m))
}

/// Mean milliseconds of the filter.
pub(super) fn mean_step_ms(frames: &[Frame]) -> f64 {
    let total: f64 = frames.iter().map(|frame| frame.step.as_secs_f64()).sum();
    1e3 * total / frames.len().max(1) as f64
}

fn trusted<'a>(frames: &'a [Frame], curve: &'a ConfidenceCurve) -> impl Iterator<Item = &'a Frame> {
    frames
        .iter()
        .filter(move |frame| curve.trusts(frame.probability))
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Metres from the point at no latitude and no longitude.
pub(super) fn from_origin_m(point: GeoPoint) -> f64 {
    // Zero degrees are in range.
    GeoPoint::new(0.0, 0.0).map_or(f64::NAN, |origin| origin.distance_m(point))
}

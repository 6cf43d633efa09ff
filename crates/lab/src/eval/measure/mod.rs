//! What the rankings are worth: pure functions from ranks, scores and poses to numbers.
//!
//! Rankings arrive as database indices, best first; positives as sorted indices. Percentages are 0
//! to 100.

mod calibration;
mod folds;
mod poses;
mod ranking;
mod rejection;

pub use calibration::{
    CalibrationError, FOLDS, FittedCurve, Prediction, RIDGE, ReliabilityBin, ThresholdCheck,
    TopOne, Trusted, Unseen, calibration_error, check_threshold, choose_threshold, cross_validate,
    fit, fit_curve, predict, predictions_of, reliability, trusted,
};
pub use poses::{POSE_THRESHOLDS, PoseAccuracy, pose_accuracy};
pub use ranking::{Interval, RECALL_AT, average_precision, bootstrap_recall, first_hit, recall_at};
pub use rejection::{Judged, PrecisionRecall, Rejection, rejection};

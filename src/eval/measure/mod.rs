//! What the rankings are worth: pure functions from ranks, scores and poses to numbers.
//!
//! Rankings arrive as database indices, best first; positives as sorted indices. Percentages are 0 to 100.

mod calibration;
mod poses;
mod ranking;
mod rejection;

pub use calibration::{
    Calibration, CalibrationError, RIDGE, ReliabilityBin, TopOne, calibration_error, cross_validate, fit, reliability,
};
pub use poses::{POSE_THRESHOLDS, PoseAccuracy, pose_accuracy};
pub use ranking::{Interval, RECALL_AT, average_precision, bootstrap_recall, first_hit, recall_at};
pub use rejection::{Judged, PrecisionRecall, Rejection, rejection};

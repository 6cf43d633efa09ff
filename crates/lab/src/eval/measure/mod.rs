//! What the rankings are worth: pure functions from ranks, scores and poses to numbers.
//!
//! Rankings arrive as database indices, best first; positives as sorted indices. Percentages are 0
//! to 100.

mod answers;
mod calibration;
mod cross_validation;
mod fit;
mod folds;
mod logistic;
mod poses;
mod ranking;
mod rejection;
mod reliability;
mod threshold;

pub use answers::{Prediction, TopOne};
pub use calibration::{FittedCurve, fit_curve};
pub use cross_validation::{FOLDS, Unseen, cross_validate, predictions_of};
pub use fit::{CalibrationError, RIDGE, fit, predict};
pub use folds::folds_of;
pub use logistic::{LabelledRows, logistic_regression};
pub use poses::{POSE_THRESHOLDS, PoseAccuracy, pose_accuracy};
pub use ranking::{Interval, RECALL_AT, average_precision, bootstrap_recall, first_hit, recall_at};
pub use rejection::{Judged, PrecisionRecall, Rejection, rejection};
pub use reliability::{ReliabilityBin, calibration_error, reliability};
pub use threshold::{ThresholdCheck, Trusted, check_threshold, choose_threshold, trusted};

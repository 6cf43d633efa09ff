//! Why a row could not be measured.

use super::names::NAMES;
use super::service::ServiceError;
use placeformer_store::StoreError;
use placeformer_vision::extract::ExtractError;
use placeformer_vision::image::ImageError;
use std::path::PathBuf;

/// Why a row could not be measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BenchError {
    /// No such row.
    #[error("there is no row {name:?}; there are {}", NAMES.join(", "))]
    UnknownRow {
        /// What was asked for.
        name: String,
    },
    /// Ours and the baseline do not compute the same.
    #[error("{row}: ours and the baseline disagree: {difference}")]
    Disagree {
        /// The row.
        row: &'static str,
        /// How.
        difference: String,
    },
    /// A quotient of two times that is not a number, such as where none passed.
    #[error(
        "{row}: {ours_ms} ms beside {baseline_ms} ms with a limit of {limit_ms} ms \
         cannot be compared"
    )]
    NotComparable {
        /// The row.
        row: String,
        /// Ours.
        ours_ms: f64,
        /// The baseline's.
        baseline_ms: f64,
        /// The limit.
        limit_ms: f64,
    },
    /// An image could not be decoded or resized.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The baseline's decoder failed.
    #[error("the baseline's decoder: {0}")]
    BaselineImage(#[from] image::ImageError),
    /// The model failed.
    #[error(transparent)]
    Extract(#[from] ExtractError),
    /// The baseline's matrix product failed.
    #[error("the baseline's matrix product: {0}")]
    Candle(#[from] candle_core::Error),
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The whole service failed.
    #[error("the service: {0}")]
    Service(ServiceError),
    /// Working files could not be kept.
    #[error("cannot use {}: {source}", path.display())]
    Io {
        /// The folder or file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// What is measured could not be set up.
    #[error("cannot set the service up: {0}")]
    Setup(String),
}

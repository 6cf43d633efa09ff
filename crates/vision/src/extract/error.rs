//! Everything that can go wrong between a normalised image and its descriptor.

use placeformer_core::error::ErrorCode;
use placeformer_core::types::{ImageSize, InvalidValue};
use placeformer_kernels::SimdError;
use std::path::{Path, PathBuf};

/// Why extraction, or loading what it needs, failed.
#[derive(Debug, thiserror::Error)]
pub enum ExtractError {
    /// A setting breaks its rule.
    #[error(transparent)]
    Config(#[from] InvalidValue),
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file as a whole is not what it should be.
    #[error("{}: {reason}", path.display())]
    BadFile {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Tensors are missing, unexpected, or of the wrong shape.
    #[error("{} does not hold {preset} weights: {}", path.display(), problems.join("; "))]
    WrongTensors {
        /// The file.
        path: PathBuf,
        /// The geometry that was asked for.
        preset: String,
        /// One sentence for each problem.
        problems: Vec<String>,
    },
    /// The bytes of a file are not those that were downloaded.
    #[error(
        "{}: SHA-256 is {actual}, expected {expected}; delete the file and pull the model again",
        path.display()
    )]
    HashMismatch {
        /// The file.
        path: PathBuf,
        /// The recorded hash, hexadecimal.
        expected: String,
        /// The hash of the file, hexadecimal.
        actual: String,
    },
    /// The head was fitted to the tokens of another backbone.
    #[error(
        "the head{} was fitted for {head_backbone}, the model is {backbone}",
        at(path)
    )]
    HeadMismatch {
        /// The head's file, unless it is the one built in.
        path: Option<PathBuf>,
        /// The backbone that the head names.
        head_backbone: String,
        /// The backbone it was to be used with.
        backbone: String,
    },
    /// The difference belongs to other weights.
    #[error(
        "the difference belongs to weights whose content hash is {base}, and these have {weights}"
    )]
    DifferenceMismatch {
        /// Content hash that the difference names.
        base: String,
        /// Content hash of the weights it was to be merged with.
        weights: String,
    },
    /// No head is built in for this backbone.
    #[error(
        "no head is built in for {backbone}: make one with `placeformer head fit --images DIR \
         --out FILE` and name it with --head FILE, or as extract.head in the configuration"
    )]
    NoHead {
        /// The backbone that lacks one.
        backbone: String,
    },
    /// The image has another size than the model takes.
    #[error("the model takes {expected} images, this one is {actual}")]
    WrongSize {
        /// The model's input size.
        expected: ImageSize,
        /// The image's size.
        actual: ImageSize,
    },
    /// The tensor does not hold 3 planes of its stated size.
    #[error("an image tensor of {size} needs {expected} values and holds {actual}")]
    WrongLength {
        /// The stated size.
        size: ImageSize,
        /// 3 * width * height.
        expected: usize,
        /// Values present.
        actual: usize,
    },
    /// The transformer's output is NaN or infinite, because the input or the weights are broken.
    #[error(
        "the transformer produced values that are not finite; the input image or the weights are \
         broken"
    )]
    NotFinite,
    /// The CPU lacks the instructions for a precision.
    #[error("precision {precision} is not available: {reason}")]
    Precision {
        /// The precision.
        precision: &'static str,
        /// Why not.
        reason: String,
    },
    /// The SIMD kernels cannot be used as the settings ask, or do not compute correctly.
    #[error(transparent)]
    Simd(#[from] SimdError),
    /// The tensor library failed.
    #[error("computing the transformer failed: {0}")]
    Compute(String),
    /// The pooled vectors that a map keeps were pooled in another way than the head needs.
    #[error(
        "the map keeps pooled vectors made by {stored}, the head takes those of {head}: one cannot \
         be made of the other without the images; import them anew with this head, or use a head \
         of {stored}"
    )]
    AggregateMismatch {
        /// How the stored vectors were pooled.
        stored: String,
        /// How the head needs them pooled.
        head: String,
    },
    /// A stored pooled vector has another length than the head takes, although the map's model says
    /// that it fits.
    #[error("a stored pooled vector has {actual} values, the head takes {expected}")]
    WrongPooledLength {
        /// Length that the head takes.
        expected: usize,
        /// Length of the stored vector.
        actual: usize,
    },
    /// Too few tokens to learn visual words from.
    #[error("{words} visual words cannot be learnt from {tokens} tokens")]
    TooFewTokens {
        /// Number of words asked for.
        words: usize,
        /// Number of tokens given.
        tokens: usize,
    },
    /// Too few images to fit a head.
    #[error("a head of {dim} dimensions needs more than {dim} images, got {images}")]
    TooFewImages {
        /// Length of the global descriptor.
        dim: usize,
        /// Number of images given.
        images: usize,
    },
}

/// The path after a space, or nothing.
fn at(path: &Option<PathBuf>) -> String {
    match path {
        Some(path) => format!(" {}", path.display()),
        None => String::new(),
    }
}

impl ExtractError {
    /// The stable code under which clients see it.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Simd(SimdError::Disagrees { .. }) => ErrorCode::Internal,
            Self::Simd(_) | Self::Config(_) => ErrorCode::InvalidParameter,
            Self::HeadMismatch { .. }
            | Self::DifferenceMismatch { .. }
            | Self::NoHead { .. }
            | Self::AggregateMismatch { .. } => ErrorCode::ModelMismatch,
            Self::WrongPooledLength { .. } => ErrorCode::CorruptRecord,
            Self::Io { .. }
            | Self::BadFile { .. }
            | Self::WrongTensors { .. }
            | Self::HashMismatch { .. }
            | Self::WrongSize { .. }
            | Self::WrongLength { .. }
            | Self::NotFinite
            | Self::Precision { .. }
            | Self::Compute(_)
            | Self::TooFewTokens { .. }
            | Self::TooFewImages { .. } => ErrorCode::Internal,
        }
    }

    /// The same error, about the file at `path` if it named none.
    pub(super) fn in_file(self, path: &Path) -> Self {
        match self {
            Self::BadFile { reason, .. } => Self::BadFile {
                path: path.to_owned(),
                reason,
            },
            other => other,
        }
    }

    /// For `map_err`: adds the path to an I/O error.
    pub fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, source }
    }
}

impl From<candle_core::Error> for ExtractError {
    fn from(error: candle_core::Error) -> Self {
        Self::Compute(error.to_string())
    }
}

//! Everything that can go wrong between a normalised image and its descriptor.

use placeformer_core::error::ErrorCode;
use placeformer_core::types::{ImageSize, InvalidValue};
use placeformer_kernels::SimdError;
use std::path::PathBuf;

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
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is not what it should be, as a whole.
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
        /// One sentence each.
        problems: Vec<String>,
    },
    /// The bytes of a file are not the bytes that were fetched.
    #[error("{}: SHA-256 is {actual}, expected {expected}; delete the file and pull the model again", path.display())]
    HashMismatch {
        /// The file.
        path: PathBuf,
        /// The recorded hash, hexadecimal.
        expected: String,
        /// The hash of what is there, hexadecimal.
        actual: String,
    },
    /// The head was made for other tokens.
    #[error(
        "the head{} was fitted for {head_backbone}, the model is {backbone}",
        at(path)
    )]
    HeadMismatch {
        /// The head's file, unless it is the one built in.
        path: Option<PathBuf>,
        /// What the head says it belongs to.
        head_backbone: String,
        /// What it was to be used with.
        backbone: String,
    },
    /// No head is known for these tokens.
    #[error(
        "no head is built in for {backbone}: make one with `placeformer head fit --images DIR --out FILE` and name it \
         with --head FILE, or as extract.head in the configuration"
    )]
    NoHead {
        /// The backbone that lacks one.
        backbone: String,
    },
    /// The image was resized to another size than the model's.
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
    /// NaN or infinity came out: the input or the weights are broken.
    #[error(
        "the transformer produced values that are not finite; the input image or the weights are broken"
    )]
    NotFinite,
    /// The machine cannot compute at the precision asked for.
    #[error("precision {precision} is not available: {reason}")]
    Precision {
        /// The precision.
        precision: &'static str,
        /// Why not.
        reason: String,
    },
    /// The kernels cannot be used as asked.
    #[error(transparent)]
    Simd(#[from] SimdError),
    /// The tensor library failed.
    #[error("computing the transformer failed: {0}")]
    Compute(String),
    /// A map keeps pooled vectors that the head cannot take.
    #[error(
        "the map keeps pooled vectors made by {stored}, the head takes those of {head}: one cannot be made of the other \
         without the images; import them anew with this head, or use a head of {stored}"
    )]
    AggregateMismatch {
        /// How the stored vectors were pooled.
        stored: String,
        /// How the head's would be.
        head: String,
    },
    /// Too few tokens to learn visual words from.
    #[error("{words} visual words cannot be learnt from {tokens} tokens")]
    TooFewTokens {
        /// Words asked for.
        words: usize,
        /// Tokens given.
        tokens: usize,
    },
    /// Too few images to fit a head.
    #[error("a head of {dim} dimensions needs more than {dim} images, got {images}")]
    TooFewImages {
        /// Output dimensions.
        dim: usize,
        /// Images seen.
        images: usize,
    },
}

fn at(path: &Option<PathBuf>) -> String {
    path.as_ref()
        .map(|path| format!(" {}", path.display()))
        .unwrap_or_default()
}

impl ExtractError {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Simd(SimdError::Disagrees { .. }) => ErrorCode::Internal,
            Self::Simd(_) | Self::Config(_) => ErrorCode::InvalidParameter,
            Self::HeadMismatch { .. } | Self::NoHead { .. } | Self::AggregateMismatch { .. } => {
                ErrorCode::ModelMismatch
            }
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

    /// Wraps an I/O error with the path it happened at.
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

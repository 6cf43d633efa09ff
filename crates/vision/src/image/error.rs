//! Why an image was refused.

use placeformer_core::error::ErrorCode;
use placeformer_core::types::ImageSize;

/// Why an image was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// No bytes at all.
    #[error("the image has no bytes")]
    Empty,
    /// More bytes than allowed.
    #[error("the image has {bytes} bytes; at most {limit} are accepted")]
    TooManyBytes {
        /// Bytes given.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// A side longer than allowed.
    #[error("the image is {size} pixels; no side may exceed {limit}")]
    SideTooLong {
        /// Size in the header.
        size: ImageSize,
        /// The limit.
        limit: u32,
    },
    /// More pixels than allowed.
    #[error(
        "the image is {size}, {} pixels; at most {limit} are accepted",
        u64::from(size.width) * u64::from(size.height)
    )]
    TooManyPixels {
        /// Size in the header.
        size: ImageSize,
        /// The limit.
        limit: u64,
    },
    /// A JPEG whose scans together are more work than allowed.
    #[error(
        "the image is {size} in {scans} scans, which visit {samples} samples; at most {limit} are \
         accepted"
    )]
    TooManyScans {
        /// Size in the header.
        size: ImageSize,
        /// How many scans it has.
        scans: usize,
        /// Samples that they visit.
        samples: u64,
        /// The limit.
        limit: u64,
    },
    /// Not too many pixels, but so many bytes for each that decoding would take more memory than
    /// the pixel limit allows.
    #[error("decoding the image takes {bytes} bytes; at most {limit} are allowed")]
    TooDeep {
        /// Bytes of the decoded samples.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// Neither JPEG, PNG nor WebP.
    #[error("the bytes are not a JPEG, PNG or WebP image: {found}")]
    UnknownFormat {
        /// What they look like.
        found: String,
    },
    /// The bytes begin like an image of a known format, but cannot be decoded.
    #[error("the {format} image cannot be decoded: {reason}")]
    Undecodable {
        /// JPEG, PNG or WebP.
        format: &'static str,
        /// The cause.
        reason: String,
    },
    /// The decoder panicked because of these bytes. Only this request fails.
    #[error("the image cannot be decoded: the decoder failed on it ({0})")]
    DecoderPanicked(String),
    /// The size to resize to has a side of zero pixels.
    #[error("an image cannot be resized to {0}")]
    EmptyTarget(ImageSize),
    /// Encoding failed.
    #[error("the image cannot be encoded as {format}: {reason}")]
    Unencodable {
        /// JPEG or PNG.
        format: &'static str,
        /// The cause.
        reason: String,
    },
}

impl ImageError {
    /// The stable code under which clients see it.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Empty => ErrorCode::EmptyImage,
            Self::TooManyBytes { .. } => ErrorCode::BodyTooLarge,
            Self::SideTooLong { .. }
            | Self::TooManyPixels { .. }
            | Self::TooManyScans { .. }
            | Self::TooDeep { .. } => ErrorCode::ImageTooLarge,
            Self::UnknownFormat { .. } => ErrorCode::UnsupportedMediaType,
            Self::Undecodable { .. } | Self::DecoderPanicked(_) => ErrorCode::ImageUndecodable,
            Self::EmptyTarget(_) | Self::Unencodable { .. } => ErrorCode::Internal,
        }
    }
}

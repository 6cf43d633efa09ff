//! Bytes to a normalised tensor: limits, decode, orient, resize, normalise.

use crate::error::ErrorCode;
use crate::types::{ImageSize, ImageTensor};
use serde::{Deserialize, Serialize};

/// Limits checked before decoding.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImageConfig {
    /// Largest image in bytes.
    pub max_bytes: usize,
    /// Longest side in pixels.
    pub max_side: u32,
    /// Most pixels.
    pub max_pixels: u64,
}

impl Default for ImageConfig {
    fn default() -> Self {
        Self { max_bytes: 20 << 20, max_side: 16_384, max_pixels: 64_000_000 }
    }
}

/// Why an image was refused.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {}

impl ImageError {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match *self {}
    }
}

/// An upright 8-bit RGB image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Width and height in pixels, after orientation.
    pub size: ImageSize,
    /// `[height, width, 3]` row-major.
    pub pixels: Vec<u8>,
}

/// Decodes an image at full size, upright.
pub fn decode(_bytes: &[u8], _config: &ImageConfig) -> Result<RgbImage, ImageError> {
    unimplemented!()
}

/// Decodes, orients, squashes to `size` and normalises: what the model sees of `bytes`.
pub fn load_tensor(_bytes: &[u8], _config: &ImageConfig, _size: ImageSize) -> Result<ImageTensor, ImageError> {
    unimplemented!()
}

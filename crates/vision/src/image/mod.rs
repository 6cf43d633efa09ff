//! Bytes to a normalised tensor: limits, decode, orient, resize, normalise.
//!
//! What arrives is whatever a camera, a phone or an attacker sent. So: the format is read from the
//! magic bytes and never from a name; the size is read from the header and checked before anything
//! is decoded or allocated; what the decoders report is turned into one error that names the cause;
//! and a decoder that panics costs one request.
//!
//! The pixels follow torchvision on a Pillow image, because the model was trained on those: 16-bit
//! samples keep their high byte, alpha is dropped (not blended), and the resize is Pillow's
//! antialiased bilinear filter. The one departure is EXIF orientation, which is honoured, on the
//! small image, after resizing.

mod decode;
mod encode;
mod error;
mod exif;
mod header;
mod resize;

pub use encode::{encode_jpeg, encode_png};
pub use error::ImageError;
pub use exif::{ExifInfo, read_exif};
pub use resize::{DEVIATION, MEAN};

use placeformer_core::types::{ImageSize, ImageTensor, InvalidValue};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Limits checked before decoding. The comments of the fields are printed as the manual of the
/// configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ImageConfig {
    /// Largest image in bytes.
    pub max_bytes: usize,
    /// Longest side of an image in pixels.
    pub max_side: u32,
    /// Most pixels, width times height.
    pub max_pixels: u64,
}

impl Default for ImageConfig {
    fn default() -> Self {
        Self {
            max_bytes: 20 << 20,
            max_side: 16_384,
            max_pixels: 64_000_000,
        }
    }
}

impl ImageConfig {
    /// Refuses limits that no image meets.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let limits = [
            ("image.max_bytes", self.max_bytes as u64),
            ("image.max_side", u64::from(self.max_side)),
            ("image.max_pixels", self.max_pixels),
        ];
        match limits.iter().find(|(_, value)| *value == 0) {
            Some((field, _)) => Err(InvalidValue::new(field, "0 would refuse every image")),
            None => Ok(()),
        }
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

impl RgbImage {
    /// An image of one colour.
    pub fn filled(size: ImageSize, colour: [u8; 3]) -> Self {
        Self {
            size,
            pixels: colour.repeat(size.width as usize * size.height as usize),
        }
    }

    /// The colour at column `x`, row `y`.
    ///
    /// # Panics
    /// Outside the image.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let start = (y as usize * self.size.width as usize + x as usize) * 3;
        [
            self.pixels[start],
            self.pixels[start + 1],
            self.pixels[start + 2],
        ]
    }

    /// The same image squashed to `size` with an antialiased bilinear filter.
    ///
    /// # Errors
    /// A side of zero pixels.
    pub fn resized(&self, size: ImageSize) -> Result<Self, ImageError> {
        resize::resize(self, size)
    }
}

/// Decodes an image at full size, upright.
///
/// # Errors
/// See [`ImageError`]; a truncated file is refused, not padded with grey.
pub fn decode(bytes: &[u8], config: &ImageConfig) -> Result<RgbImage, ImageError> {
    decode::contained(|| {
        let image = decode::decode_as_stored(bytes, config, None)?;
        Ok(decode::apply(exif::orientation(bytes), image))
    })
}

/// Decodes, orients, squashes to `size` and normalises: what the model sees of `bytes`.
///
/// # Errors
/// See [`ImageError`]; also when `size` has a side of zero pixels.
pub fn load_tensor(
    bytes: &[u8],
    config: &ImageConfig,
    size: ImageSize,
) -> Result<ImageTensor, ImageError> {
    decode::contained(|| {
        let orientation = exif::orientation(bytes);
        let stored =
            decode::decode_as_stored(bytes, config, Some(decode::stored_size(orientation, size)))?;
        let small = resize::resize(&stored, decode::stored_size(orientation, size))?;
        Ok(resize::normalise(&decode::apply(orientation, small)))
    })
}

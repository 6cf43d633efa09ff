//! The whole way from bytes to an image or a tensor.

use super::config::ImageConfig;
use super::decode::{catch_panic, decode_as_stored};
use super::error::ImageError;
use super::exif;
use super::header;
use super::orientation::{stored_size, turn_upright};
use super::resize;
use super::rgb::RgbImage;
use placeformer_core::types::{ImageSize, ImageTensor};

/// Decodes an image at full size, upright.
///
/// # Errors
/// See [`ImageError`]. A truncated file is refused; decoders would pad it with grey.
pub fn decode(bytes: &[u8], config: &ImageConfig) -> Result<RgbImage, ImageError> {
    catch_panic(|| {
        let stored = decode_as_stored(bytes, config, None)?;
        Ok(turn_upright(stored, exif::orientation(bytes)))
    })
}

/// Decodes an image, turns it upright, resizes it to `size` without keeping its aspect ratio, and
/// normalises it (paper IV-A): the input of the model, `[3, height, width]`.
///
/// # Errors
/// See [`ImageError`]; also if a side of `size` is zero.
pub fn load_tensor(
    bytes: &[u8],
    config: &ImageConfig,
    size: ImageSize,
) -> Result<ImageTensor, ImageError> {
    catch_panic(|| {
        // Nothing reads bytes that are no image, or too many.
        header::recognise(bytes, config)?;
        let orientation = exif::orientation(bytes);
        let stored_size = stored_size(orientation, size);
        let stored = decode_as_stored(bytes, config, Some(stored_size))?;
        let small = resize::resize(&stored, stored_size)?;
        let upright = turn_upright(small, orientation);
        Ok(resize::normalise(&upright))
    })
}

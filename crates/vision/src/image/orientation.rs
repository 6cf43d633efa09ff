//! Turning an image as its EXIF data says.

use super::rgb::RgbImage;
use ::image::DynamicImage;
use ::image::metadata::Orientation;
use placeformer_core::types::ImageSize;

/// The size that an image is stored with, if it has the size `upright` after it is turned.
pub(super) fn stored_size(orientation: Orientation, upright: ImageSize) -> ImageSize {
    match orientation {
        Orientation::Rotate90
        | Orientation::Rotate270
        | Orientation::Rotate90FlipH
        | Orientation::Rotate270FlipH => ImageSize {
            width: upright.height,
            height: upright.width,
        },
        _ => upright,
    }
}

/// Turns an image upright.
pub(super) fn turn_upright(image: RgbImage, orientation: Orientation) -> RgbImage {
    if orientation == Orientation::NoTransforms {
        return image;
    }
    let RgbImage { size, pixels } = image;
    // This is `None` only for fewer than width x height x 3 bytes, which neither the decoders nor
    // the resizer return.
    let buffer = ::image::RgbImage::from_raw(size.width, size.height, pixels).unwrap_or_default();
    let mut image = DynamicImage::ImageRgb8(buffer);
    image.apply_orientation(orientation);
    let size = ImageSize {
        width: image.width(),
        height: image.height(),
    };
    RgbImage {
        size,
        pixels: image.into_rgb8().into_raw(),
    }
}

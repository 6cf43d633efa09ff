//! Pictures made small enough for a page that stands alone.

use super::error::DrawError;
use base64::Engine;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{RgbImage, encode_jpeg};

/// Shrinks `image` so that it fits `longest_side` pixels, keeping its shape; never enlarges.
///
/// # Errors
/// An image or a side of zero pixels.
pub fn thumbnail(image: &RgbImage, longest_side: u32) -> Result<RgbImage, DrawError> {
    let longest = image.size.width.max(image.size.height);
    if longest == 0 || longest_side == 0 {
        return Err(DrawError::Size(image.size));
    }
    if longest <= longest_side {
        return Ok(image.clone());
    }
    // Both factors are 32-bit, so the product fits; the quotient is at most the side itself.
    let fit = |side: u32| {
        ((u64::from(side) * u64::from(longest_side) / u64::from(longest)) as u32).max(1)
    };
    Ok(image.resized(ImageSize {
        width: fit(image.size.width),
        height: fit(image.size.height),
    })?)
}

/// `image` as a `data:image/jpeg;base64,...` URI, for pages that must stand alone.
///
/// # Errors
/// An image that JPEG cannot hold.
pub fn jpeg_data_uri(image: &RgbImage, quality: u8) -> Result<String, DrawError> {
    let encoded = base64::engine::general_purpose::STANDARD.encode(encode_jpeg(image, quality)?);
    Ok(format!("data:image/jpeg;base64,{encoded}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_vision::image::{ImageConfig, decode};

    #[test]
    fn thumbnails_keep_the_shape_and_never_grow() {
        let image = RgbImage::filled(
            ImageSize {
                width: 640,
                height: 480,
            },
            [9, 9, 9],
        );
        assert_eq!(
            thumbnail(&image, 160).unwrap().size,
            ImageSize {
                width: 160,
                height: 120
            }
        );
        assert_eq!(thumbnail(&image, 1000).unwrap(), image);
        let line = RgbImage::filled(
            ImageSize {
                width: 3000,
                height: 1,
            },
            [9, 9, 9],
        );
        assert_eq!(
            thumbnail(&line, 100).unwrap().size,
            ImageSize {
                width: 100,
                height: 1
            }
        );
        assert!(thumbnail(&image, 0).is_err());
    }

    #[test]
    fn a_data_uri_holds_the_picture() {
        let image = RgbImage::filled(
            ImageSize {
                width: 16,
                height: 16,
            },
            [200, 30, 30],
        );
        let uri = jpeg_data_uri(&image, 90).unwrap();
        let payload = uri.strip_prefix("data:image/jpeg;base64,").unwrap();
        let bytes = base64::engine::general_purpose::STANDARD
            .decode(payload)
            .unwrap();
        assert_eq!(
            decode(&bytes, &ImageConfig::default()).unwrap().size,
            image.size
        );
    }
}

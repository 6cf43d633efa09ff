//! RGB images back to bytes: PNG without loss, JPEG for reports and data sets.

use super::{ImageError, RgbImage};
use ::image::ExtendedColorType::Rgb8;
use ::image::ImageEncoder;
use ::image::codecs::{jpeg::JpegEncoder, png::PngEncoder};

/// Encodes without loss.
///
/// # Errors
/// An image without pixels, or whose pixels do not fill its size.
pub fn encode_png(image: &RgbImage) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    write(image, "PNG", PngEncoder::new(&mut bytes))?;
    Ok(bytes)
}

/// Encodes as a JPEG of `quality` 1 to 100.
///
/// # Errors
/// An image without pixels, over 65,535 pixels wide or high, or whose pixels do not fill its size.
pub fn encode_jpeg(image: &RgbImage, quality: u8) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    write(
        image,
        "JPEG",
        JpegEncoder::new_with_quality(&mut bytes, quality.clamp(1, 100)),
    )?;
    Ok(bytes)
}

fn write(
    image: &RgbImage,
    format: &'static str,
    encoder: impl ImageEncoder,
) -> Result<(), ImageError> {
    let fail = |reason: String| ImageError::Unencodable { format, reason };
    let (width, height) = (image.size.width, image.size.height);
    // The encoders assert this; a typed error is kinder than their panic.
    if image.pixels.is_empty()
        || image.pixels.len() as u64 != u64::from(width) * u64::from(height) * 3
    {
        return Err(fail(format!(
            "{} bytes do not fill {} RGB pixels",
            image.pixels.len(),
            image.size
        )));
    }
    encoder
        .write_image(&image.pixels, width, height, Rgb8)
        .map_err(|error| fail(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::{ImageConfig, decode};
    use placeformer_core::types::ImageSize;

    #[test]
    fn png_returns_exactly_and_jpeg_nearly() {
        let size = ImageSize {
            width: 33,
            height: 17,
        };
        let pixels: Vec<u8> = (0..33 * 17)
            .flat_map(|i| [(i % 33 * 7) as u8, (i / 33 * 15) as u8, 90])
            .collect();
        let image = RgbImage { size, pixels };
        assert_eq!(
            decode(&encode_png(&image).unwrap(), &ImageConfig::default()).unwrap(),
            image
        );
        let lossy = decode(&encode_jpeg(&image, 95).unwrap(), &ImageConfig::default()).unwrap();
        assert!(
            lossy
                .pixels
                .iter()
                .zip(&image.pixels)
                .all(|(a, b)| a.abs_diff(*b) < 24)
        );
    }

    #[test]
    fn pixels_that_do_not_fill_the_size_are_refused() {
        let image = RgbImage {
            size: ImageSize {
                width: 4,
                height: 4,
            },
            pixels: vec![0; 7],
        };
        assert!(matches!(
            encode_png(&image),
            Err(ImageError::Unencodable { .. })
        ));
        assert!(matches!(
            encode_jpeg(&image, 80),
            Err(ImageError::Unencodable { .. })
        ));
    }
}

//! Images back to bytes: PNG without loss, JPEG for reports and data sets.

use super::error::ImageError;
use super::rgb::RgbImage;
use ::image::ExtendedColorType::Rgb8;
use ::image::ImageEncoder;
use ::image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
use placeformer_core::types::ImageSize;

/// Encodes as a PNG, without loss.
///
/// # Errors
/// [`ImageError::Unencodable`] if the image has no pixels, or not as many as its size says.
pub fn encode_png(image: &RgbImage) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    write(image, "PNG", PngEncoder::new(&mut bytes))?;
    Ok(bytes)
}

/// Encodes as a JPEG of `quality` 1 to 100.
///
/// # Errors
/// [`ImageError::Unencodable`] if the image has no pixels, or not as many as its size says, or a
/// side of more than 65,535 pixels.
pub fn encode_jpeg(image: &RgbImage, quality: u8) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut bytes, quality.clamp(1, 100));
    write(image, "JPEG", encoder)?;
    Ok(bytes)
}

fn write(
    image: &RgbImage,
    format: &'static str,
    encoder: impl ImageEncoder,
) -> Result<(), ImageError> {
    let fail = |reason: String| ImageError::Unencodable { format, reason };
    let ImageSize { width, height } = image.size;
    let len = image.pixels.len();
    let expected = u64::from(width) * u64::from(height) * 3;
    // The encoders would panic.
    if len == 0 || len as u64 != expected {
        return Err(fail(format!(
            "{len} bytes do not fill {} RGB pixels",
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
        let config = ImageConfig::default();
        let png = encode_png(&image).unwrap();
        assert_eq!(decode(&png, &config).unwrap(), image);
        let jpeg = encode_jpeg(&image, 95).unwrap();
        let lossy = decode(&jpeg, &config).unwrap();
        let mut pairs = lossy.pixels.iter().zip(&image.pixels);
        assert!(pairs.all(|(a, b)| a.abs_diff(*b) < 24));
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

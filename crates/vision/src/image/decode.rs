//! One decoder for each format. All of them end in 8-bit RGB, oriented as the file stores it.

use super::config::ImageConfig;
use super::error::ImageError;
use super::header::{self, ImageFormat};
use super::jpeg;
use super::rgb::RgbImage;
use ::image::codecs::{png::PngDecoder, webp::WebPDecoder};
use ::image::{DynamicImage, ImageDecoder, Limits};
use placeformer_core::types::ImageSize;
use std::error::Error;
use std::io::{self, Cursor, ErrorKind};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Why a file without all its bytes is refused.
const ENDS_TOO_EARLY: &str = "truncated: the bytes end too early";

/// Runs `work`, and turns a panic inside it into an error.
pub(super) fn catch_panic<T>(
    work: impl FnOnce() -> Result<T, ImageError>,
) -> Result<T, ImageError> {
    // `work` owns its buffers and shares nothing that it changes. So no half-changed state remains
    // after a panic, and asserting unwind safety is right.
    let result = catch_unwind(AssertUnwindSafe(work));
    result.unwrap_or_else(|panic| {
        let text = if let Some(text) = panic.downcast_ref::<&str>() {
            (*text).to_owned()
        } else if let Some(text) = panic.downcast_ref::<String>() {
            text.clone()
        } else {
            "no message".to_owned()
        };
        Err(ImageError::DecoderPanicked(text))
    })
}

/// Checks the limits, and decodes without turning the image upright.
///
/// If only the size `needed` (as stored) will be used, a far larger JPEG may come out smaller than
/// it is, but with sides at least twice those needed.
pub(super) fn decode_as_stored(
    bytes: &[u8],
    config: &ImageConfig,
    needed: Option<ImageSize>,
) -> Result<RgbImage, ImageError> {
    match header::recognise(bytes, config)? {
        ImageFormat::Jpeg => jpeg::decode(bytes, config, needed),
        ImageFormat::Png => png(bytes, config),
        ImageFormat::WebP => webp(bytes, config),
    }
}

fn png(bytes: &[u8], config: &ImageConfig) -> Result<RgbImage, ImageError> {
    let format = ImageFormat::Png;
    header::check_size(format, header::png_size(bytes)?, config)?;
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(decoded_limit(config));
    let decoder = PngDecoder::with_limits(Cursor::new(bytes), limits);
    let decoder = decoder.map_err(|error| image_error(format, &error))?;
    read_pixels(format, decoder, config)
}

fn webp(bytes: &[u8], config: &ImageConfig) -> Result<RgbImage, ImageError> {
    let format = ImageFormat::WebP;
    if !header::webp_is_complete(bytes) {
        return Err(format.undecodable(ENDS_TOO_EARLY));
    }
    let decoder = WebPDecoder::new(Cursor::new(bytes));
    let decoder = decoder.map_err(|error| image_error(format, &error))?;
    read_pixels(format, decoder, config)
}

/// Most bytes that decoded samples may take: RGBA at the pixel limit.
fn decoded_limit(config: &ImageConfig) -> u64 {
    config.max_pixels.saturating_mul(4)
}

/// Checks the limits against the decoder's header, and decodes.
fn read_pixels(
    format: ImageFormat,
    decoder: impl ImageDecoder,
    config: &ImageConfig,
) -> Result<RgbImage, ImageError> {
    let (width, height) = decoder.dimensions();
    let size = ImageSize { width, height };
    header::check_size(format, size, config)?;
    let bytes = decoder.total_bytes();
    let limit = decoded_limit(config);
    if bytes > limit {
        return Err(ImageError::TooDeep { bytes, limit });
    }
    let image = DynamicImage::from_decoder(decoder);
    let image = image.map_err(|error| image_error(format, &error))?;
    Ok(RgbImage {
        size,
        pixels: into_rgb(image),
    })
}

/// The pixels as 8-bit RGB, as Pillow converts them: 16-bit samples keep their high byte, alpha is
/// dropped, grey is repeated.
fn into_rgb(image: DynamicImage) -> Vec<u8> {
    let high = |sample: &u16| (sample >> 8) as u8;
    match image {
        DynamicImage::ImageRgb16(image) => image.as_raw().iter().map(high).collect(),
        DynamicImage::ImageRgba16(image) => image
            .as_raw()
            .chunks_exact(4)
            .flat_map(|rgba| [high(&rgba[0]), high(&rgba[1]), high(&rgba[2])])
            .collect(),
        DynamicImage::ImageLuma16(image) => image
            .as_raw()
            .iter()
            .flat_map(|grey| [high(grey); 3])
            .collect(),
        DynamicImage::ImageLumaA16(image) => image
            .as_raw()
            .chunks_exact(2)
            .flat_map(|grey| [high(&grey[0]); 3])
            .collect(),
        other => other.into_rgb8().into_raw(),
    }
}

/// The innermost cause of an error of the image crate, which is the one that says something.
fn image_error(format: ImageFormat, error: &::image::ImageError) -> ImageError {
    let mut cause: &(dyn Error + 'static) = error;
    let mut ended_early = is_unexpected_end(cause);
    while let Some(deeper) = cause.source() {
        cause = deeper;
        ended_early |= is_unexpected_end(cause);
    }
    let reason = cause.to_string();
    // The PNG decoder reports a missing end as a format error, which only its text tells apart.
    if ended_early || reason.contains("unexpected end of file") {
        return format.undecodable(ENDS_TOO_EARLY);
    }
    format.undecodable(reason)
}

fn is_unexpected_end(error: &(dyn Error + 'static)) -> bool {
    let io_error = error.downcast_ref::<io::Error>();
    io_error.is_some_and(|error| error.kind() == ErrorKind::UnexpectedEof)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error_that_quotes_it() {
        let error = catch_panic::<()>(|| panic!("index {} out of range", 7)).unwrap_err();
        assert_eq!(
            error,
            ImageError::DecoderPanicked("index 7 out of range".to_owned())
        );
        assert_eq!(error.code().as_str(), "image_undecodable");
    }
}

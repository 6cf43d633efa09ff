//! One decoder per format, all ending in 8-bit RGB as stored; orientation; containment of panics.

use super::header::{self, Format};
use super::{ImageConfig, ImageError, RgbImage};
use ::image::codecs::{png::PngDecoder, webp::WebPDecoder};
use ::image::metadata::Orientation;
use ::image::{DynamicImage, ImageDecoder, Limits};
use placeformer_core::types::ImageSize;
use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;
use zune_jpeg::errors::DecodeErrors;

/// Runs `work`; a panic inside becomes an error.
pub(super) fn contained<T>(work: impl FnOnce() -> Result<T, ImageError>) -> Result<T, ImageError> {
    // Unwind safety: `work` owns its buffers and shares nothing mutable, so nothing half-done
    // outlives the panic.
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
        Err(ImageError::DecoderPanicked(
            text.unwrap_or_else(|| "no message".to_owned()),
        ))
    })
}

/// Checks limits and decodes without turning the image upright. A JPEG far larger than what it is
/// `wanted` for (as stored) may come out smaller, but never less than twice as large.
pub(super) fn decode_as_stored(
    bytes: &[u8],
    config: &ImageConfig,
    wanted: Option<ImageSize>,
) -> Result<RgbImage, ImageError> {
    match header::sniff(bytes, config)? {
        Format::Jpeg => jpeg(bytes, config, wanted),
        Format::Png => {
            header::check_size(Format::Png, header::png_size(bytes)?, config)?;
            let mut limits = Limits::no_limits();
            limits.max_alloc = Some(decoded_limit(config));
            let decoder = PngDecoder::with_limits(Cursor::new(bytes), limits);
            raster(
                Format::Png,
                decoder.map_err(|error| image_error(Format::Png, &error))?,
                config,
            )
        }
        Format::WebP => {
            if !header::webp_is_complete(bytes) {
                return Err(Format::WebP.undecodable("truncated: the bytes end too early"));
            }
            let decoder = WebPDecoder::new(Cursor::new(bytes));
            raster(
                Format::WebP,
                decoder.map_err(|error| image_error(Format::WebP, &error))?,
                config,
            )
        }
    }
}

/// Most bytes that decoded samples may take: RGBA at the pixel limit.
fn decoded_limit(config: &ImageConfig) -> u64 {
    config.max_pixels.saturating_mul(4)
}

fn jpeg(
    bytes: &[u8],
    config: &ImageConfig,
    wanted: Option<ImageSize>,
) -> Result<RgbImage, ImageError> {
    let fail = |error: DecodeErrors| Format::Jpeg.undecodable(jpeg_reason(&error));
    // The decoder's own limits are opened wide: ours are checked below, on the header, with a
    // better message.
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(usize::from(u16::MAX))
        .set_max_height(usize::from(u16::MAX))
        .jpeg_set_max_scans(header::MAX_JPEG_SCANS)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(fail)?;
    let (width, height) = decoder.dimensions().unwrap_or_default();
    // A JPEG's sides are 16-bit numbers.
    let size = ImageSize {
        width: width as u32,
        height: height as u32,
    };
    header::check_size(Format::Jpeg, size, config)?;
    header::check_jpeg(bytes)?;
    let simple = matches!(decoder.input_colorspace(), Some(ColorSpace::YCbCr));
    if let Some(scale) = wanted
        .and_then(|wanted| reduction(size, wanted))
        .filter(|_| simple)
    {
        return jpeg_reduced(bytes, size, scale, config);
    }
    let pixels = decoder.decode().map_err(fail)?;
    match decoder.output_colorspace() {
        Some(ColorSpace::RGB) => Ok(RgbImage { size, pixels }),
        other => {
            Err(Format::Jpeg.undecodable(format!("its colours ({other:?}) cannot be shown as RGB")))
        }
    }
}

/// The largest of 1/8, 1/4 and 1/2 that leaves both sides at least twice what is wanted: the
/// antialiased resize that follows then averages what is left, and the result stays within a level
/// or two of a full decode.
fn reduction(size: ImageSize, wanted: ImageSize) -> Option<u32> {
    let leaves_enough = |scale: &u32| {
        size.width / scale >= 2 * wanted.width && size.height / scale >= 2 * wanted.height
    };
    [8, 4, 2].into_iter().find(leaves_enough)
}

/// Decodes at `1 / scale` of the size: fewer coefficients, fewer pixels, the same picture.
fn jpeg_reduced(
    bytes: &[u8],
    size: ImageSize,
    scale: u32,
    config: &ImageConfig,
) -> Result<RgbImage, ImageError> {
    let fail = |error: jpeg_decoder::Error| Format::Jpeg.undecodable(error.to_string());
    let mut decoder = jpeg_decoder::Decoder::new(bytes);
    decoder
        .set_max_decoding_buffer_size(usize::try_from(decoded_limit(config)).unwrap_or(usize::MAX));
    decoder.read_info().map_err(fail)?;
    // A JPEG's sides are 16-bit numbers.
    let side = |pixels: u32| pixels.div_ceil(scale) as u16;
    let (width, height) = decoder
        .scale(side(size.width), side(size.height))
        .map_err(fail)?;
    let pixels = decoder.decode().map_err(fail)?;
    let reduced = ImageSize {
        width: u32::from(width),
        height: u32::from(height),
    };
    if pixels.len() as u64 != u64::from(reduced.width) * u64::from(reduced.height) * 3 {
        return Err(Format::Jpeg.undecodable("its colours cannot be shown as RGB"));
    }
    Ok(RgbImage {
        size: reduced,
        pixels,
    })
}

/// The decoder's reason in words for the sender.
fn jpeg_reason(error: &DecodeErrors) -> String {
    match error {
        DecodeErrors::ExhaustedData | DecodeErrors::IoErrors(_) => {
            "truncated: the bytes end too early".to_owned()
        }
        DecodeErrors::FormatStatic("Premature end of buffer") => {
            "truncated: the bytes end too early".to_owned()
        }
        DecodeErrors::Format(reason) => reason.clone(),
        DecodeErrors::FormatStatic(reason) => (*reason).to_owned(),
        other => other.to_string(),
    }
}

fn raster(
    format: Format,
    decoder: impl ImageDecoder,
    config: &ImageConfig,
) -> Result<RgbImage, ImageError> {
    let (width, height) = decoder.dimensions();
    let size = ImageSize { width, height };
    header::check_size(format, size, config)?;
    if decoder.total_bytes() > decoded_limit(config) {
        return Err(ImageError::TooDeep {
            bytes: decoder.total_bytes(),
            limit: decoded_limit(config),
        });
    }
    let image = DynamicImage::from_decoder(decoder).map_err(|error| image_error(format, &error))?;
    Ok(RgbImage {
        size,
        pixels: into_rgb(image),
    })
}

/// 8-bit RGB as Pillow makes it: 16-bit samples keep their high byte, alpha is dropped, grey is
/// repeated.
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

/// What the image crate's decoders report, reduced to the innermost cause.
fn image_error(format: Format, error: &::image::ImageError) -> ImageError {
    let mut cause: &dyn std::error::Error = error;
    let mut ended_early = false;
    loop {
        let io = cause.downcast_ref::<std::io::Error>();
        ended_early |= io.is_some_and(|io| io.kind() == std::io::ErrorKind::UnexpectedEof);
        match cause.source() {
            Some(deeper) => cause = deeper,
            None => break,
        }
    }
    let reason = cause.to_string();
    // The PNG decoder reports a missing end as a format error of its own, known only by its text.
    if ended_early || reason.contains("unexpected end of file") {
        return format.undecodable("truncated: the bytes end too early");
    }
    format.undecodable(reason)
}

/// The size before orientation of an image that is `upright` after it.
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
pub(super) fn apply(orientation: Orientation, image: RgbImage) -> RgbImage {
    if orientation == Orientation::NoTransforms {
        return image;
    }
    let RgbImage { size, pixels } = image;
    // The decoders and the resizer always fill width x height x 3 bytes, which is all `from_raw`
    // asks.
    let mut image = DynamicImage::ImageRgb8(
        ::image::RgbImage::from_raw(size.width, size.height, pixels).unwrap_or_default(),
    );
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_far_too_large_is_reduced() {
        let size = |width, height| ImageSize { width, height };
        assert_eq!(reduction(size(640, 480), size(448, 336)), None);
        assert_eq!(reduction(size(1920, 1080), size(448, 336)), None);
        assert_eq!(reduction(size(1920, 1400), size(448, 336)), Some(2));
        assert_eq!(reduction(size(4032, 3024), size(448, 336)), Some(4));
        assert_eq!(
            reduction(size(8000, 700), size(448, 336)),
            None,
            "one side would become too short"
        );
        assert_eq!(reduction(size(16_000, 12_000), size(448, 336)), Some(8));
    }

    #[test]
    fn a_panic_becomes_an_error_that_quotes_it() {
        let error = contained::<()>(|| panic!("index {} out of range", 7)).unwrap_err();
        assert_eq!(
            error,
            ImageError::DecoderPanicked("index 7 out of range".to_owned())
        );
        assert_eq!(error.code().as_str(), "image_undecodable");
    }
}

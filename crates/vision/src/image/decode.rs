//! One decoder for each format. All of them end in 8-bit RGB, oriented as the file stores it.

use super::config::ImageConfig;
use super::error::ImageError;
use super::header::{self, ImageFormat};
use super::rgb::RgbImage;
use super::{jpeg, png, webp};
use placeformer_core::types::ImageSize;
use std::error::Error;
use std::io::{self, ErrorKind};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Why a file without all its bytes is refused.
pub(super) const ENDS_TOO_EARLY: &str = "truncated: the bytes end too early";

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
        ImageFormat::Png => png::decode(bytes, config),
        ImageFormat::WebP => webp::decode(bytes, config),
    }
}

/// Most bytes that decoded samples may take: RGBA at the pixel limit.
pub(super) fn decoded_limit(config: &ImageConfig) -> u64 {
    config.max_pixels.saturating_mul(4)
}

/// The innermost cause of a decoder's error, which is the one that says something.
pub(super) fn decoding_error(format: ImageFormat, error: &(dyn Error + 'static)) -> ImageError {
    let mut cause = error;
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

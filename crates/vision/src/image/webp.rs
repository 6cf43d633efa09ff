//! WebP: only the picture is decoded; of an animation the first frame.

use super::config::ImageConfig;
use super::decode::{ENDS_TOO_EARLY, decoded_limit, decoding_error};
use super::error::ImageError;
use super::header::{self, ImageFormat};
use super::rgb::RgbImage;
use ::image::ImageDecoder;
use ::image::codecs::webp::WebPDecoder;
use placeformer_core::types::ImageSize;
use std::borrow::Cow;
use std::io::Cursor;

const FORMAT: ImageFormat = ImageFormat::WebP;
/// Bytes of the file header: `RIFF`, a length, `WEBP`.
const HEADER: usize = 12;
/// Bytes of a chunk's header: its kind and its length.
const CHUNK_HEADER: usize = 8;

/// Checks the limits, and decodes the picture.
///
/// As in viewers, a picture whose metadata are cut off is whole, and so is one without the byte
/// that fills up an odd chunk.
pub(super) fn decode(bytes: &[u8], config: &ImageConfig) -> Result<RgbImage, ImageError> {
    let picture = picture(bytes)?;
    let canvas = canvas(bytes);
    if let Some(canvas) = canvas {
        header::check_size(FORMAT, canvas, config)?;
    }
    let decoder = WebPDecoder::new(Cursor::new(picture.as_ref())).map_err(error)?;
    let (width, height) = decoder.dimensions();
    let size = ImageSize { width, height };
    header::check_size(FORMAT, size, config)?;
    if canvas.is_some_and(|canvas| canvas != size) {
        let reason = "its picture has another size than its header says";
        return Err(FORMAT.undecodable(reason));
    }
    let bytes = decoder.total_bytes();
    let limit = decoded_limit(config);
    if bytes > limit {
        return Err(ImageError::TooDeep { bytes, limit });
    }
    let has_alpha = decoder.color_type().has_alpha();
    let mut pixels = vec![0; bytes as usize];
    decoder.read_image(&mut pixels).map_err(error)?;
    if has_alpha {
        pixels = pixels
            .chunks_exact(4)
            .flat_map(|rgba| [rgba[0], rgba[1], rgba[2]])
            .collect();
    }
    Ok(RgbImage { size, pixels })
}

/// A WebP that holds the picture alone; an animation stays as it is, because its frames are drawn
/// onto a canvas.
///
/// Metadata and a separate alpha channel are left out: nothing of them is used, so their bytes
/// shall cost nothing.
fn picture(bytes: &[u8]) -> Result<Cow<'_, [u8]>, ImageError> {
    let cut = || FORMAT.undecodable(ENDS_TOO_EARLY);
    let length = word(bytes, 4).ok_or_else(cut)?;
    let end = length.saturating_add(CHUNK_HEADER);
    let mut at = HEADER;
    loop {
        let length = word(bytes, at + 4).ok_or_else(cut)?;
        let kind = &bytes[at..at + 4];
        let chunk_end = (at + CHUNK_HEADER).saturating_add(length);
        if chunk_end > bytes.len() {
            return Err(cut());
        }
        if chunk_end > end {
            return Err(FORMAT.undecodable("a chunk is longer than the file says it is"));
        }
        match kind {
            b"VP8 " | b"VP8L" => return Ok(Cow::Owned(alone(&bytes[at..chunk_end]))),
            b"ANMF" => return Ok(Cow::Borrowed(bytes)),
            // An odd chunk is filled up with a byte.
            _ => at = chunk_end + length % 2,
        }
    }
}

/// A WebP of one chunk.
fn alone(chunk: &[u8]) -> Vec<u8> {
    let padding: &[u8] = if chunk.len() % 2 == 1 { &[0] } else { &[] };
    let length = 4 + chunk.len() + padding.len();
    // The chunk is part of an image whose bytes are limited, so its length fits.
    let length = (length as u32).to_le_bytes();
    [b"RIFF".as_slice(), &length[..], b"WEBP", chunk, padding].concat()
}

/// The size in the extended header, if there is one.
fn canvas(bytes: &[u8]) -> Option<ImageSize> {
    let chunk = bytes.get(HEADER..)?;
    let fields = chunk.strip_prefix(b"VP8X")?.get(8..14)?;
    let side = |at: usize| 1 + u32::from_le_bytes([fields[at], fields[at + 1], fields[at + 2], 0]);
    Some(ImageSize {
        width: side(0),
        height: side(3),
    })
}

fn word(bytes: &[u8], at: usize) -> Option<usize> {
    let word = bytes.get(at..)?.first_chunk()?;
    Some(u32::from_le_bytes(*word) as usize)
}

fn error(error: ::image::ImageError) -> ImageError {
    decoding_error(FORMAT, &error)
}

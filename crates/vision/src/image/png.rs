//! PNG: only the picture is decoded. Text and colour profiles, which are compressed too, never are.

use super::config::ImageConfig;
use super::decode::{decoded_limit, decoding_error};
use super::error::ImageError;
use super::header::{self, ImageFormat};
use super::rgb::RgbImage;
use ::png::{BitDepth, Decoder, DecodingError, Limits, Reader, Transformations};
use std::borrow::Cow;
use std::io::Cursor;

const FORMAT: ImageFormat = ImageFormat::Png;
/// Bytes before the first chunk.
const SIGNATURE: usize = 8;
/// Bytes of a chunk's length, kind and checksum.
const AROUND_DATA: usize = 12;
/// The last chunk.
const END: &[u8] = b"\0\0\0\0IEND\xae\x42\x60\x82";

/// Checks the limits, and decodes the picture; of an animation the one for viewers that show none.
///
/// As in viewers, a damaged chunk beside the picture is ignored, and so are bytes behind its end.
/// The end itself, and metadata before it, may be missing.
pub(super) fn decode(bytes: &[u8], config: &ImageConfig) -> Result<RgbImage, ImageError> {
    let size = header::png_size(bytes)?;
    header::check_size(FORMAT, size, config)?;
    let limit = decoded_limit(config);
    let limits = Limits {
        bytes: usize::try_from(limit).unwrap_or(usize::MAX),
    };
    let whole = with_end(bytes);
    let mut decoder = Decoder::new_with_limits(Cursor::new(whole.as_ref()), limits);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    decoder.set_transformations(Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(error)?;
    let samples = samples(&mut reader, limit)?;
    let (colour, depth) = reader.output_color_type();
    let channels = colour.samples();
    let pixels = match depth {
        // The high byte of a sample of 16 bits comes first.
        BitDepth::Sixteen => into_rgb(&samples, channels, 2),
        _ => into_rgb(&samples, channels, 1),
    };
    Ok(RgbImage { size, pixels })
}

/// The bytes with an end, if nothing but the end or metadata is cut off.
fn with_end(bytes: &[u8]) -> Cow<'_, [u8]> {
    let mut at = SIGNATURE;
    while let Some(head) = bytes.get(at..).and_then(|rest| rest.first_chunk::<8>()) {
        let [a, b, c, d, kind @ ..] = *head;
        let length = u32::from_be_bytes([a, b, c, d]) as usize;
        let next = at.saturating_add(length).saturating_add(AROUND_DATA);
        let is_end = &kind == b"IEND";
        if next > bytes.len() {
            // Without a chunk that matters the picture is incomplete, and the decoder says so.
            if kind[0].is_ascii_uppercase() && !is_end {
                return Cow::Borrowed(bytes);
            }
            break;
        }
        if is_end {
            return Cow::Borrowed(bytes);
        }
        at = next;
    }
    Cow::Owned([&bytes[..at.min(bytes.len())], END].concat())
}

fn samples(reader: &mut Reader<Cursor<&[u8]>>, limit: u64) -> Result<Vec<u8>, ImageError> {
    let length = reader.output_buffer_size().unwrap_or(usize::MAX);
    let bytes = length as u64;
    if bytes > limit {
        return Err(ImageError::TooDeep { bytes, limit });
    }
    let mut samples = vec![0; length];
    let frame = reader.next_frame(&mut samples).map_err(error)?;
    let info = reader.info();
    if (frame.width, frame.height) != (info.width, info.height) {
        return Err(FORMAT.undecodable("its first frame is smaller than the picture"));
    }
    Ok(samples)
}

/// The pixels as 8-bit RGB, as Pillow converts them: 16-bit samples keep their high byte, alpha is
/// dropped, grey is repeated.
fn into_rgb(samples: &[u8], channels: usize, sample_bytes: usize) -> Vec<u8> {
    let pixels = samples.chunks_exact(channels * sample_bytes);
    // Grey has one or two channels, colours have three or four.
    let places = match channels {
        1 | 2 => [0; 3],
        _ => [0, 1, 2].map(|channel| channel * sample_bytes),
    };
    let mut rgb = Vec::with_capacity(pixels.len() * 3);
    for pixel in pixels {
        rgb.extend_from_slice(&places.map(|place| pixel[place]));
    }
    rgb
}

fn error(error: DecodingError) -> ImageError {
    decoding_error(FORMAT, &error)
}

//! From a JPEG that `clean` wrote to its pixels.

use super::super::error::ImageError;
use super::super::header::ImageFormat;
use super::super::rgb::RgbImage;
use super::frame::{Colours, Frame};
use super::syntax::Layout;
use jpeg_decoder::ColorTransform;
use placeformer_core::types::ImageSize;
use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;

/// Decodes `clean`, which must be what [`super::clean`] wrote of `layout`.
pub(super) fn decode(
    clean: &[u8],
    layout: &Layout<'_>,
    needed: Option<ImageSize>,
) -> Result<RgbImage, ImageError> {
    let frame = &layout.frame;
    let scale = needed.and_then(|needed| reduction(frame.size, needed));
    if has_zero_quantiser(frame) {
        // Such coefficients are zero. `jpeg-decoder` refuses the table instead.
        return match is_common(layout) {
            true => fast(clean, frame.size),
            false => Err(ImageFormat::Jpeg.undecodable("it has a quantiser of zero")),
        };
    }
    match scale {
        None if is_common(layout) => fast(clean, frame.size),
        scale => any_layout(clean, frame, scale.unwrap_or(1)),
    }
}

/// The largest of the reductions 1/8, 1/4 and 1/2 that leaves both sides at least twice as long as
/// needed; `None` if there is none.
///
/// The antialiased resize that follows averages the remaining pixels, so the result differs from
/// that of a full decode by a level or two of 256.
fn reduction(size: ImageSize, needed: ImageSize) -> Option<u32> {
    let leaves_enough = |scale: &u32| {
        size.width / scale >= 2 * needed.width && size.height / scale >= 2 * needed.height
    };
    [8, 4, 2].into_iter().find(leaves_enough)
}

/// Whether the picture has one of the layouts of cameras, which `zune-jpeg` decodes right: grey, or
/// a colour picture whose two planes of colour have a quarter, a half or all of the pixels.
///
/// It decodes other layouts wrongly without saying so, for instance a sequential picture with a
/// scan for each component.
fn is_common(layout: &Layout<'_>) -> bool {
    let Layout { frame, scans, .. } = layout;
    let is_interleaved = frame.progressive || scans.len() == 1;
    let sampling: Vec<_> = frame
        .components
        .iter()
        .map(|component| component.sampling)
        .collect();
    let is_common = match (frame.colours, sampling.as_slice()) {
        (Colours::Grey, [(1, 1)]) => true,
        (Colours::YCbCr, [luma, (1, 1), (1, 1)]) => [(1, 1), (2, 1), (1, 2), (2, 2)].contains(luma),
        _ => false,
    };
    is_interleaved && is_common
}

fn has_zero_quantiser(frame: &Frame) -> bool {
    let mut tables = frame
        .components
        .iter()
        .filter_map(|component| component.quantisers);
    tables.any(|table| table.contains(&0))
}

/// Decodes a common layout at full size.
fn fast(clean: &[u8], size: ImageSize) -> Result<RgbImage, ImageError> {
    // The limits are checked already, on the header, with a better message.
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(usize::from(u16::MAX))
        .set_max_height(usize::from(u16::MAX))
        .jpeg_set_max_scans(super::MAX_SCANS + 1)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(clean), options);
    let pixels = decoder.decode();
    let pixels = pixels.map_err(|error| ImageFormat::Jpeg.undecodable(error.to_string()))?;
    filled(size, pixels)
}

/// Decodes any layout at `1 / scale` of the size, which needs fewer coefficients and makes fewer
/// pixels.
fn any_layout(clean: &[u8], frame: &Frame, scale: u32) -> Result<RgbImage, ImageError> {
    let fail = |error: jpeg_decoder::Error| ImageFormat::Jpeg.undecodable(error.to_string());
    let mut decoder = jpeg_decoder::Decoder::new(clean);
    decoder.set_color_transform(match frame.colours {
        Colours::Grey => ColorTransform::Grayscale,
        Colours::YCbCr => ColorTransform::YCbCr,
        Colours::Rgb => ColorTransform::RGB,
        Colours::Cmyk => ColorTransform::CMYK,
        Colours::Ycck => ColorTransform::YCCK,
    });
    let mut size = frame.size;
    // For the whole size nothing is asked: of a picture of one column the library takes any scale
    // to be large enough.
    if scale > 1 {
        // The sides of a JPEG are 16-bit numbers, so the conversion loses nothing.
        let side = |pixels: u32| pixels.div_ceil(scale) as u16;
        let (width, height) = (side(size.width), side(size.height));
        let (width, height) = decoder.scale(width, height).map_err(fail)?;
        size.width = u32::from(width);
        size.height = u32::from(height);
    }
    let samples = decoder.decode().map_err(fail)?;
    let pixels = match frame.colours {
        Colours::YCbCr | Colours::Rgb => samples,
        Colours::Grey => samples.into_iter().flat_map(|grey| [grey; 3]).collect(),
        Colours::Cmyk | Colours::Ycck => samples.chunks_exact(4).flat_map(without_black).collect(),
    };
    filled(size, pixels)
}

/// Cyan, magenta, yellow and black to red, green and blue: what the inks leave of white light.
fn without_black(inks: &[u8]) -> [u8; 3] {
    let left = |ink: u8| u32::from(255 - ink);
    std::array::from_fn(|ink| ((left(inks[ink]) * left(inks[3]) + 127) / 255) as u8)
}

fn filled(size: ImageSize, pixels: Vec<u8>) -> Result<RgbImage, ImageError> {
    if pixels.len() as u64 != u64::from(size.width) * u64::from(size.height) * 3 {
        return Err(ImageFormat::Jpeg.undecodable("its colours cannot be shown as RGB"));
    }
    Ok(RgbImage { size, pixels })
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
}

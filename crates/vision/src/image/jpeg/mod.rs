//! JPEG: what is accepted, what it may cost, and which library decodes it.
//!
//! Two libraries decode, because neither does it all: `zune-jpeg` is the faster one, `jpeg-decoder`
//! also decodes at a half, a quarter or an eighth of the size, and pictures of every layout. What
//! they tolerate differs, and what they get wrong they do not report. So neither decides what is
//! valid. This room does, by one rule: **what viewers show in full is accepted, what lacks image
//! data is refused, the same at every size.** (Viewers are those built on libjpeg, which is nearly
//! all.) In this order:
//!
//! | module | does |
//! |---|---|
//! | `syntax` | reads the segments, as libjpeg does, into a `frame` and its scans |
//! | `cost` | bounds what decoding will cost, from the header and the scans alone |
//! | `progress` | checks that the scans build on each other, and make a picture |
//! | `entropy` | checks that the data of each block are there, with the tables of `huffman` |
//! | `clean` | writes the same picture anew, without anything to tolerate |
//! | `pixels` | chooses the library, and decodes what `clean` wrote |
//!
//! A progressive picture may lack its finest scans if it has an end marker: its encoder meant it
//! so. It must have the mean of each block of each component.

mod clean;
mod cost;
mod entropy;
mod fault;
mod frame;
mod huffman;
mod layouts;
mod pixels;
mod progress;
mod standard;
mod syntax;

use super::config::ImageConfig;
use super::error::ImageError;
use super::header::{self, ImageFormat};
use super::rgb::RgbImage;
use placeformer_core::types::ImageSize;

/// Coefficients, and samples, of a block.
const COEFFICIENTS: usize = 64;

/// Most scans of a JPEG. Cameras and encoders write one to about ten; each of them, even one that
/// is ignored, is a header to be read and remembered.
const MAX_SCANS: usize = 100;

/// Checks the limits, and decodes without turning the image upright.
///
/// If only the size `needed` (as stored) will be used, a far larger picture may come out smaller
/// than it is, but with sides at least twice those needed.
pub(super) fn decode(
    bytes: &[u8],
    config: &ImageConfig,
    needed: Option<ImageSize>,
) -> Result<RgbImage, ImageError> {
    let check_size = |size| header::check_size(ImageFormat::Jpeg, size, config);
    let mut layout = syntax::read(bytes, check_size)?;
    cost::check(&layout, config)?;
    layouts::simplify(&mut layout)?;
    let clean = clean::write(&layout)?;
    pixels::decode(&clean, &layout, needed)
}

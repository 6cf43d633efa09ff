//! Small pictures in every container, with and without EXIF, for the tests of decoding.

use exif::{Field, In, Tag, Value, experimental::Writer};
use image::{DynamicImage, ImageFormat};
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, ImageError, RgbImage, decode};
use std::io::Cursor;
use std::path::Path;

/// Size of the [`picture`].
pub const SIZE: ImageSize = ImageSize {
    width: 48,
    height: 32,
};
/// Colours of its top left, top right, bottom left and bottom right.
pub const QUADRANTS: [[u8; 3]; 4] = [[200, 40, 40], [40, 180, 60], [50, 60, 210], [128, 128, 128]];

fn quadrant_at(x: u32, y: u32) -> [u8; 3] {
    QUADRANTS[(x / 24 + 2 * (y / 16)) as usize]
}

/// A picture of four quadrants in different colours.
pub fn picture() -> RgbImage {
    let pixels = (0..32)
        .flat_map(|y| (0..48).flat_map(move |x| quadrant_at(x, y)))
        .collect();
    RgbImage { size: SIZE, pixels }
}

/// The same, as the type that the image crate encodes.
pub fn dynamic() -> DynamicImage {
    DynamicImage::ImageRgb8(image::RgbImage::from_raw(48, 32, picture().pixels).unwrap())
}

/// Bytes of `image` in `format`.
pub fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

/// Decodes with the default limits.
pub fn default_decode(bytes: &[u8]) -> Result<RgbImage, ImageError> {
    decode(bytes, &ImageConfig::default())
}

/// The code of the error with which `bytes` are refused.
pub fn code(bytes: &[u8]) -> &'static str {
    default_decode(bytes).unwrap_err().code().as_str()
}

/// Checks that `image` shows the [`picture`].
#[track_caller]
pub fn assert_quadrants(image: &RgbImage, tolerance: u8, name: &str) {
    assert_eq!(image.size, SIZE, "{name}");
    for (x, y) in [(6, 6), (40, 6), (6, 28), (40, 28)] {
        let found = image.pixel(x, y);
        let expected = quadrant_at(x, y);
        let close = found
            .iter()
            .zip(expected)
            .all(|(a, b)| a.abs_diff(b) <= tolerance);
        assert!(
            close,
            "{name} at {x},{y}: {found:?} instead of {expected:?}"
        );
    }
}

/// An EXIF block (TIFF structure) of `fields`.
pub fn exif_block(fields: &[(Tag, Value)]) -> Vec<u8> {
    let fields: Vec<Field> = fields
        .iter()
        .map(|(tag, value)| Field {
            tag: *tag,
            ifd_num: In::PRIMARY,
            value: value.clone(),
        })
        .collect();
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut block = Cursor::new(Vec::new());
    writer.write(&mut block, false).unwrap();
    block.into_inner()
}

/// A JPEG with an EXIF block behind its first marker.
pub fn jpeg_with_exif(jpeg: &[u8], block: &[u8]) -> Vec<u8> {
    let length = (block.len() as u16 + 8).to_be_bytes();
    [
        &jpeg[..2],
        b"\xff\xe1",
        &length,
        b"Exif\0\0",
        block,
        &jpeg[2..],
    ]
    .concat()
}

/// A PNG with an EXIF block behind its header.
pub fn png_with_exif(png: &[u8], block: &[u8]) -> Vec<u8> {
    let body = [b"eXIf".as_slice(), block].concat();
    let crc = crc32fast::hash(&body).to_be_bytes();
    // Signature and IHDR fill the first 33 bytes.
    [
        &png[..33],
        &(block.len() as u32).to_be_bytes(),
        &body,
        &crc,
        &png[33..],
    ]
    .concat()
}

/// A simple WebP, turned into an extended one with an EXIF block.
pub fn webp_with_exif(webp: &[u8], block: &[u8]) -> Vec<u8> {
    let side = |n: u32| (n - 1).to_le_bytes()[..3].to_vec();
    let padding: &[u8] = if block.len() % 2 == 1 { b"\0" } else { b"" };
    let extended = [
        b"VP8X\x0a\0\0\0\x08\0\0\0".as_slice(),
        &side(SIZE.width),
        &side(SIZE.height),
    ]
    .concat();
    let exif = [
        b"EXIF".as_slice(),
        &(block.len() as u32).to_le_bytes(),
        block,
        padding,
    ]
    .concat();
    let body = [b"WEBP".as_slice(), &extended, &webp[12..], &exif].concat();
    [
        b"RIFF".as_slice(),
        &(body.len() as u32).to_le_bytes(),
        &body,
    ]
    .concat()
}

/// A stored picture from `tests/fixtures/images`.
pub fn fixture(name: &str) -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/images");
    std::fs::read(folder.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

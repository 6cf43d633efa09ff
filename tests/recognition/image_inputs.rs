//! Every awkward image that a client may send, through the public functions of the image module.

use crate::common::noise;
use exif::{Field, In, Rational, Tag, Value, experimental::Writer};
use image::{DynamicImage, ImageFormat};
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{
    ImageConfig, ImageError, RgbImage, decode, encode_jpeg, encode_png, load_tensor, read_exif,
};
use proptest::prelude::*;
use std::io::Cursor;
use std::path::Path;

const SIZE: ImageSize = ImageSize {
    width: 48,
    height: 32,
};
/// Top left, top right, bottom left, bottom right.
const QUADRANTS: [[u8; 3]; 4] = [[200, 40, 40], [40, 180, 60], [50, 60, 210], [128, 128, 128]];

fn quadrant_at(x: u32, y: u32) -> [u8; 3] {
    QUADRANTS[(x / 24 + 2 * (y / 16)) as usize]
}

fn picture() -> RgbImage {
    let pixels = (0..32)
        .flat_map(|y| (0..48).flat_map(move |x| quadrant_at(x, y)))
        .collect();
    RgbImage { size: SIZE, pixels }
}

fn dynamic() -> DynamicImage {
    DynamicImage::ImageRgb8(image::RgbImage::from_raw(48, 32, picture().pixels).unwrap())
}

fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn default_decode(bytes: &[u8]) -> Result<RgbImage, ImageError> {
    decode(bytes, &ImageConfig::default())
}

fn code(bytes: &[u8]) -> &'static str {
    default_decode(bytes).unwrap_err().code().as_str()
}

fn assert_quadrants(image: &RgbImage, tolerance: u8, name: &str) {
    assert_eq!(image.size, SIZE, "{name}");
    for (x, y) in [(6, 6), (40, 6), (6, 28), (40, 28)] {
        let (found, expected) = (image.pixel(x, y), quadrant_at(x, y));
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
fn exif_block(fields: &[(Tag, Value)]) -> Vec<u8> {
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

fn jpeg_with_exif(jpeg: &[u8], block: &[u8]) -> Vec<u8> {
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

fn png_with_exif(png: &[u8], block: &[u8]) -> Vec<u8> {
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

fn webp_with_exif(webp: &[u8], block: &[u8]) -> Vec<u8> {
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

#[test]
fn unusual_encodings_decode_to_the_same_picture() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/images");
    for (name, tolerance) in [
        ("cmyk.jpg", 3),
        ("ycck.jpg", 3),
        ("progressive.jpg", 3),
        ("restarts_420.jpg", 3),
        ("extended_q1.jpg", 50),
        ("lossy.webp", 6),
        ("animated.webp", 0),
        ("palette.png", 0),
        ("palette_transparent.png", 0),
        ("interlaced.png", 0),
    ] {
        let bytes = std::fs::read(folder.join(name)).unwrap();
        assert_quadrants(
            &default_decode(&bytes).unwrap_or_else(|error| panic!("{name}: {error}")),
            tolerance,
            name,
        );
    }
    let bilevel = default_decode(&std::fs::read(folder.join("bilevel.png")).unwrap()).unwrap();
    assert!(bilevel.pixels.iter().all(|value| [0, 255].contains(value)));
    assert_eq!(
        (bilevel.pixel(6, 28), bilevel.pixel(1, 1)),
        ([255; 3], [0; 3])
    );
}

#[test]
fn deep_grey_and_transparent_png_decode() {
    let deep = DynamicImage::ImageRgb16(dynamic().to_rgb16());
    assert_quadrants(
        &default_decode(&encoded(&deep, ImageFormat::Png)).unwrap(),
        0,
        "rgb16",
    );
    let mut alpha = dynamic().to_rgba8();
    alpha.pixels_mut().for_each(|pixel| pixel[3] = 10);
    let alpha = DynamicImage::ImageRgba8(alpha);
    assert_quadrants(
        &default_decode(&encoded(&alpha, ImageFormat::Png)).unwrap(),
        0,
        "alpha is dropped",
    );
    assert_quadrants(
        &default_decode(&encoded(&alpha, ImageFormat::WebP)).unwrap(),
        0,
        "alpha is dropped",
    );
    let alpha = DynamicImage::ImageRgba16(alpha.to_rgba16());
    assert_quadrants(
        &default_decode(&encoded(&alpha, ImageFormat::Png)).unwrap(),
        0,
        "rgba16",
    );
    for grey in [
        DynamicImage::ImageLuma8(dynamic().to_luma8()),
        DynamicImage::ImageLuma16(dynamic().to_luma16()),
        DynamicImage::ImageLumaA8(dynamic().to_luma_alpha8()),
        DynamicImage::ImageLumaA16(dynamic().to_luma_alpha16()),
    ] {
        let expected = dynamic().to_luma8();
        let found = default_decode(&encoded(&grey, ImageFormat::Png)).unwrap();
        for (x, y) in [(6, 6), (40, 6), (6, 28), (40, 28)] {
            let [r, g, b] = found.pixel(x, y);
            assert!(
                r == g && g == b && r.abs_diff(expected.get_pixel(x, y)[0]) <= 1,
                "{:?}",
                grey.color()
            );
        }
    }
    let grey_jpeg = encoded(
        &DynamicImage::ImageLuma8(dynamic().to_luma8()),
        ImageFormat::Jpeg,
    );
    let [r, g, b] = default_decode(&grey_jpeg).unwrap().pixel(40, 28);
    assert!(r == g && g == b && r.abs_diff(128) < 4);
}

#[test]
fn extreme_shapes_decode_and_resize() {
    let target = ImageSize {
        width: 28,
        height: 14,
    };
    for (width, height) in [(1, 1), (300, 1), (1, 300), (2000, 3)] {
        let image = RgbImage::filled(ImageSize { width, height }, [90, 120, 150]);
        let webp = encoded(
            &DynamicImage::ImageRgb8(
                image::RgbImage::from_raw(width, height, image.pixels.clone()).unwrap(),
            ),
            ImageFormat::WebP,
        );
        for bytes in [
            encode_png(&image).unwrap(),
            encode_jpeg(&image, 90).unwrap(),
            webp,
        ] {
            assert_eq!(default_decode(&bytes).unwrap().size, image.size);
            let tensor = load_tensor(&bytes, &ImageConfig::default(), target).unwrap();
            assert_eq!((tensor.size, tensor.data.len()), (target, 3 * 28 * 14));
            let red = (90.0 / 255.0 - 0.485) / 0.229;
            assert!(
                tensor.data[..28 * 14]
                    .iter()
                    .all(|value| (value - red).abs() < 0.06),
                "{width}x{height}"
            );
        }
    }
}

#[test]
fn all_eight_orientations_come_out_upright_in_every_container() {
    let upright = dynamic();
    for value in 1u16..=8 {
        // What a camera held that way stores: the inverse of what the tag asks the reader to do.
        let stored = match value {
            2 => upright.fliph(),
            3 => upright.rotate180(),
            4 => upright.flipv(),
            5 => upright.rotate90().fliph(),
            6 => upright.rotate270(),
            7 => upright.rotate90().flipv(),
            8 => upright.rotate90(),
            _ => upright.clone(),
        };
        let block = exif_block(&[(Tag::Orientation, Value::Short(vec![value]))]);
        let stored_rgb = RgbImage {
            size: ImageSize {
                width: stored.width(),
                height: stored.height(),
            },
            pixels: stored.to_rgb8().into_raw(),
        };
        let jpeg = jpeg_with_exif(&encode_jpeg(&stored_rgb, 95).unwrap(), &block);
        let png = png_with_exif(&encode_png(&stored_rgb).unwrap(), &block);
        // A WebP's canvas is stated again in its extended header, so only shapes that keep it can
        // be patched here.
        let webp =
            (value <= 4).then(|| webp_with_exif(&encoded(&stored, ImageFormat::WebP), &block));
        for (name, bytes) in [("jpeg", Some(jpeg)), ("png", Some(png)), ("webp", webp)] {
            let Some(bytes) = bytes else { continue };
            let label = format!("{name}, orientation {value}");
            assert_quadrants(&default_decode(&bytes).unwrap(), 8, &label);
            assert_tensor_upright(&bytes, &label);
        }
    }
}

/// The tensor of `bytes`, whose sides have another ratio than the picture, still shows the
/// quadrants upright.
fn assert_tensor_upright(bytes: &[u8], label: &str) {
    let size = ImageSize {
        width: 40,
        height: 40,
    };
    let tensor = load_tensor(bytes, &ImageConfig::default(), size).unwrap();
    for (x, y, colour) in [(5, 5, 0), (35, 5, 1), (5, 35, 2), (35, 35, 3)] {
        for (channel, (mean, deviation)) in [(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)]
            .into_iter()
            .enumerate()
        {
            let value = (tensor.data[channel * 1600 + y * 40 + x] * deviation + mean) * 255.0;
            let expected = f32::from(QUADRANTS[colour][channel]);
            assert!(
                (value - expected).abs() < 10.0,
                "{label} at {x},{y}: {value} instead of {expected}"
            );
        }
    }
}

#[test]
fn a_large_photo_is_reduced_while_decoding_and_looks_the_same() {
    // Waves of several lengths, so that what a reduction gets wrong would show.
    let (width, height) = (2000u32, 1500u32);
    let wave =
        |x: u32, y: u32, length: f32| 127.5 + 100.0 * ((x as f32 + 0.6 * y as f32) / length).sin();
    let pixels = (0..height).flat_map(|y| {
        (0..width).flat_map(move |x| {
            [
                wave(x, y, 40.0) as u8,
                wave(y, x, 9.0) as u8,
                wave(x, y, 300.0) as u8,
            ]
        })
    });
    let image = RgbImage {
        size: ImageSize { width, height },
        pixels: pixels.collect(),
    };
    let jpeg = encode_jpeg(&image, 90).unwrap();
    let config = ImageConfig::default();
    let model = ImageSize {
        width: 448,
        height: 336,
    };
    let turned = jpeg_with_exif(
        &jpeg,
        &exif_block(&[(Tag::Orientation, Value::Short(vec![6]))]),
    );
    for (bytes, name) in [(&jpeg, "upright"), (&turned, "turned")] {
        let whole = decode(bytes, &config).unwrap().resized(model).unwrap();
        let tensor = load_tensor(bytes, &config, model).unwrap();
        let plane = (model.width * model.height) as usize;
        let difference: f32 = (0..3 * plane)
            .map(|at| {
                let channel = at / plane;
                let level = f32::from(whole.pixels[at % plane * 3 + channel]) / 255.0;
                let (mean, deviation) = (
                    placeformer_vision::image::MEAN[channel],
                    placeformer_vision::image::DEVIATION[channel],
                );
                (tensor.data[at] - (level - mean) / deviation).abs()
            })
            .sum::<f32>()
            / (3 * plane) as f32;
        assert!(difference < 0.02, "{name}: off by {difference} on average");
    }
    for cut in [jpeg.len() / 2, jpeg.len() - 2] {
        let refused = load_tensor(&jpeg[..cut], &config, model)
            .unwrap_err()
            .to_string();
        assert!(refused.contains("truncated"), "{refused}");
    }
}

#[test]
fn the_format_is_read_from_the_bytes() {
    assert_eq!(code(b""), "empty_image");
    assert_eq!(code(b"\xff"), "unsupported_media_type");
    assert_eq!(
        code(b"this is a text file named photo.jpg"),
        "unsupported_media_type"
    );
    assert_eq!(code(b"GIF89a\x01\0\x01\0"), "unsupported_media_type");
    assert_eq!(code(b"\xff\xd8"), "image_undecodable");
    assert_eq!(code(b"\x89PNG"), "image_undecodable");
}

#[test]
fn limits_are_checked_before_decoding() {
    // A header without any pixel data: had decoding begun, the answer would be "truncated".
    let header = |width: u32, height: u32| {
        let body = [
            b"IHDR".as_slice(),
            &width.to_be_bytes(),
            &height.to_be_bytes(),
            b"\x08\x02\0\0\0",
        ]
        .concat();
        let crc = crc32fast::hash(&body).to_be_bytes();
        [b"\x89PNG\r\n\x1a\n\0\0\0\x0d".as_slice(), &body, &crc].concat()
    };
    let error = default_decode(&header(50_000, 50_000)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the image is 50000x50000 pixels; no side may exceed 16384"
    );
    assert_eq!(error.code().as_str(), "image_too_large");
    assert_eq!(code(&header(u32::MAX, u32::MAX)), "image_too_large");
    assert!(matches!(
        default_decode(&header(16_000, 16_000)),
        Err(ImageError::TooManyPixels { .. })
    ));
    assert_eq!(code(&header(0, 5)), "image_undecodable");

    let mut jpeg = encode_jpeg(&picture(), 90).unwrap();
    let frame = jpeg
        .windows(2)
        .position(|pair| pair == [0xff, 0xc0])
        .unwrap();
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0xea, 0x60, 0xea, 0x60]);
    assert_eq!(code(&jpeg), "image_too_large");

    let mut webp = webp_with_exif(&encoded(&dynamic(), ImageFormat::WebP), b"");
    // Width less one, in 24 bits of the extended header.
    webp[24..27].copy_from_slice(&20_000u32.to_le_bytes()[..3]);
    assert_eq!(code(&webp), "image_too_large");

    let png = encode_png(&picture()).unwrap();
    let limited = |config: ImageConfig| decode(&png, &config).unwrap_err().code().as_str();
    assert_eq!(
        limited(ImageConfig {
            max_bytes: png.len() - 1,
            ..Default::default()
        }),
        "body_too_large"
    );
    assert_eq!(
        limited(ImageConfig {
            max_side: 47,
            ..Default::default()
        }),
        "image_too_large"
    );
    assert_eq!(
        limited(ImageConfig {
            max_pixels: 48 * 32 - 1,
            ..Default::default()
        }),
        "image_too_large"
    );
    let deep = encoded(
        &DynamicImage::ImageRgba16(dynamic().to_rgba16()),
        ImageFormat::Png,
    );
    let config = ImageConfig {
        max_pixels: 48 * 32,
        ..Default::default()
    };
    assert!(matches!(
        decode(&deep, &config),
        Err(ImageError::TooDeep { .. })
    ));
}

#[test]
fn a_file_cut_anywhere_is_refused_and_says_so() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/images");
    let progressive = std::fs::read(folder.join("progressive.jpg")).unwrap();
    let noise = RgbImage {
        size: SIZE,
        pixels: noise::bytes(1, 48 * 32 * 3),
    };
    for (name, bytes) in [
        ("jpeg", encode_jpeg(&noise, 90).unwrap()),
        ("progressive jpeg", progressive),
        ("png", encode_png(&noise).unwrap()),
        ("webp", encoded(&dynamic(), ImageFormat::WebP)),
        (
            "lossy webp",
            std::fs::read(folder.join("lossy.webp")).unwrap(),
        ),
    ] {
        // A PNG whose pixels are all there but whose end chunk is not still shows the whole
        // picture.
        let whole = if name == "png" {
            bytes.len() - 16
        } else {
            bytes.len()
        };
        for cut in 2..whole {
            let error = default_decode(&bytes[..cut])
                .err()
                .unwrap_or_else(|| panic!("{name} cut at {cut} was taken"));
            let code = error.code().as_str();
            assert!(
                ["image_undecodable", "unsupported_media_type"].contains(&code),
                "{name} cut at {cut}: {error}"
            );
        }
        let error = default_decode(&bytes[..bytes.len() / 2]).unwrap_err();
        assert!(error.to_string().contains("truncated"), "{name}: {error}");
    }
}

/// Found by the fuzz target `image`: the PNG decoder panics on a palette that is no whole number of
/// colours.
#[test]
fn a_palette_of_half_a_colour_is_refused_although_the_decoder_panics() {
    let chunk = |kind: &[u8; 4], data: &[u8]| {
        let content = [kind, data].concat();
        let crc = crc32fast::hash(&content).to_be_bytes();
        [&(data.len() as u32).to_be_bytes()[..], &content, &crc].concat()
    };
    let header = [0, 0, 0, 2, 0, 0, 0, 1, 8, 3, 0, 0, 0];
    // One row of two pixels behind its filter byte, in a stored block of zlib.
    let pixels = [0x78, 0x01, 0x01, 3, 0, 0xfc, 0xff, 0, 0, 1, 0, 4, 0, 2];
    let png = |palette: &[u8]| {
        let chunks = [
            chunk(b"IHDR", &header),
            chunk(b"PLTE", palette),
            chunk(b"IDAT", &pixels),
            chunk(b"IEND", &[]),
        ];
        [&b"\x89PNG\r\n\x1a\n"[..], &chunks.concat()].concat()
    };
    assert_eq!(
        default_decode(&png(&[1, 2, 3, 4, 5, 6])).unwrap().pixels,
        [1, 2, 3, 4, 5, 6]
    );
    assert_eq!(code(&png(&[1, 2, 3, 4])), "image_undecodable");
}

#[test]
fn a_jpeg_of_thousands_of_scans_is_refused_before_it_is_decoded() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/images");
    for (name, target) in [
        (
            "progressive.jpg",
            ImageSize {
                width: 12,
                height: 8,
            },
        ),
        ("restarts_420.jpg", SIZE),
    ] {
        let jpeg = std::fs::read(folder.join(name)).unwrap();
        let end = jpeg.len() - 2;
        let last = jpeg
            .windows(2)
            .rposition(|marker| marker == b"\xff\xda")
            .unwrap();
        let again =
            |scans: usize| [&jpeg[..end], &jpeg[last..end].repeat(scans), &jpeg[end..]].concat();
        load_tensor(&jpeg, &ImageConfig::default(), target).unwrap();
        let bomb = again(3000);
        for refused in [
            default_decode(&bomb).unwrap_err(),
            load_tensor(&bomb, &ImageConfig::default(), target).unwrap_err(),
        ] {
            assert_eq!(refused.code().as_str(), "image_undecodable", "{name}");
            assert!(
                refused.to_string().contains("more than 100 scans"),
                "{name}: {refused}"
            );
        }
    }
}

#[test]
fn exif_gives_position_direction_and_time() {
    let rational = |parts: &[(u32, u32)]| {
        Value::Rational(
            parts
                .iter()
                .map(|&(num, denom)| Rational { num, denom })
                .collect(),
        )
    };
    let ascii = |text: &str| Value::Ascii(vec![text.as_bytes().to_vec()]);
    let mut fields = vec![
        (Tag::GPSLatitudeRef, ascii("S")),
        (Tag::GPSLatitude, rational(&[(33, 1), (51, 1), (3000, 100)])),
        (Tag::GPSLongitudeRef, ascii("E")),
        (Tag::GPSLongitude, rational(&[(151, 1), (12, 1), (36, 1)])),
        (Tag::GPSImgDirection, rational(&[(2705, 10)])),
        (Tag::DateTimeOriginal, ascii("2026:03:01 14:30:05")),
        (Tag::OffsetTimeOriginal, ascii("+11:00")),
    ];
    let read = |fields: &[(Tag, Value)]| {
        let block = exif_block(fields);
        let jpeg = read_exif(&jpeg_with_exif(
            &encode_jpeg(&picture(), 80).unwrap(),
            &block,
        ));
        let png = read_exif(&png_with_exif(&encode_png(&picture()).unwrap(), &block));
        assert_eq!(jpeg, png);
        jpeg
    };
    let info = read(&fields);
    let place = info.location.unwrap();
    assert!((place.lat() + 33.858_333).abs() < 1e-5 && (place.lon() - 151.21).abs() < 1e-9);
    assert_eq!(info.heading.unwrap().degrees(), 270.5);
    assert_eq!(info.captured_at.unwrap().unix_timestamp(), 1_772_335_805);

    fields.truncate(6);
    assert_eq!(
        read(&fields).captured_at.unwrap().unix_timestamp(),
        1_772_335_805 + 11 * 3600
    );
    fields[1].1 = rational(&[(95, 1), (0, 1), (0, 1)]);
    fields[4].1 = rational(&[(1, 0)]);
    fields[5].1 = ascii("0000:00:00 00:00:00");
    assert_eq!(read(&fields), Default::default());
    assert_eq!(read_exif(b"nothing at all"), Default::default());
    assert_eq!(
        read_exif(&encode_png(&picture()).unwrap()),
        Default::default()
    );
}

#[test]
fn a_broken_exif_block_does_not_cost_the_picture() {
    let jpeg = jpeg_with_exif(
        &encode_jpeg(&picture(), 95).unwrap(),
        b"MM\0*\xff\xff\xff\xffgarbage",
    );
    assert_quadrants(&default_decode(&jpeg).unwrap(), 8, "broken exif");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..Default::default() })]

    #[test]
    fn arbitrary_bytes_are_answered(head in 0usize..4, tail in proptest::collection::vec(any::<u8>(), 0..300)) {
        let head: &[u8] = [b"".as_slice(), b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF\0\0\0\0WEBP"][head];
        let bytes = [head, &tail].concat();
        if let Err(error) = default_decode(&bytes) {
            prop_assert!(!matches!(error, ImageError::DecoderPanicked(_)), "{}", error);
        }
        read_exif(&bytes);
    }

    #[test]
    fn damaged_files_are_answered(
        which in 0usize..4,
        damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
    ) {
        let mut bytes = match which {
            0 => {
                let turned = exif_block(&[(Tag::Orientation, Value::Short(vec![6]))]);
                jpeg_with_exif(&encode_jpeg(&picture(), 90).unwrap(), &turned)
            }
            1 => encode_png(&picture()).unwrap(),
            2 => include_bytes!("../fixtures/images/progressive.jpg").to_vec(),
            _ => include_bytes!("../fixtures/images/lossy.webp").to_vec(),
        };
        for (at, value) in &damage {
            let at = at.index(bytes.len());
            bytes[at] = *value;
        }
        match load_tensor(&bytes, &ImageConfig { max_pixels: 1 << 20, ..Default::default() }, SIZE) {
            Ok(tensor) => prop_assert!(tensor.data.iter().all(|value| value.is_finite())),
            Err(error) => prop_assert!(!error.to_string().is_empty()),
        }
    }
}

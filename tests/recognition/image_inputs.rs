//! Every awkward image that a client may send, through the public functions of the image module.

use crate::common::noise;
use crate::pictures::{
    SIZE, assert_quadrants, code, default_decode, dynamic, encoded, exif_block, fixture,
    jpeg_with_exif, picture,
};
use exif::{Tag, Value};
use image::{DynamicImage, ImageFormat};
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{
    ImageConfig, ImageError, RgbImage, decode, encode_jpeg, encode_png, load_tensor, read_exif,
};
use proptest::prelude::*;

#[test]
fn unusual_encodings_decode_to_the_same_picture() {
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
        let bytes = fixture(name);
        assert_quadrants(
            &default_decode(&bytes).unwrap_or_else(|error| panic!("{name}: {error}")),
            tolerance,
            name,
        );
    }
    let bilevel = default_decode(&fixture("bilevel.png")).unwrap();
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
fn a_large_photo_is_reduced_while_decoding_and_looks_the_same() {
    // Waves of several lengths, so that what a reduction gets wrong would show.
    let width = 2000u32;
    let height = 1500u32;
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
                let mean = placeformer_vision::image::MEAN[channel];
                let deviation = placeformer_vision::image::DEVIATION[channel];
                (tensor.data[at] - (level - mean) / deviation).abs()
            })
            .sum::<f32>()
            / (3 * plane) as f32;
        assert!(difference < 0.02, "{name}: off by {difference} on average");
    }
    for cut in [jpeg.len() / 2, jpeg.len() - 3] {
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
fn a_file_cut_anywhere_is_refused_and_says_so() {
    let progressive = fixture("progressive.jpg");
    let noise = RgbImage {
        size: SIZE,
        pixels: noise::bytes(1, 48 * 32 * 3),
    };
    for (name, bytes) in [
        ("jpeg", encode_jpeg(&noise, 90).unwrap()),
        ("progressive jpeg", progressive),
        ("png", encode_png(&noise).unwrap()),
        ("webp", encoded(&dynamic(), ImageFormat::WebP)),
        ("lossy webp", fixture("lossy.webp")),
    ] {
        // What lacks nothing but the end of the file still shows the whole picture: the end chunk
        // of a PNG, the end marker of a JPEG.
        let whole = match name {
            "png" => bytes.len() - 16,
            "jpeg" | "progressive jpeg" => bytes.len() - 2,
            _ => bytes.len(),
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

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 400,
        failure_persistence: None,
        ..Default::default()
    })]

    #[test]
    fn arbitrary_bytes_are_answered(
        head in 0usize..4,
        tail in proptest::collection::vec(any::<u8>(), 0..300),
    ) {
        let heads: [&[u8]; 4] = [
            b"",
            b"\xff\xd8\xff",
            b"\x89PNG\r\n\x1a\n",
            b"RIFF\0\0\0\0WEBP",
        ];
        let bytes = [heads[head], &tail].concat();
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
            2 => fixture("progressive.jpg"),
            _ => fixture("lossy.webp"),
        };
        for (at, value) in &damage {
            let at = at.index(bytes.len());
            bytes[at] = *value;
        }
        let config = ImageConfig { max_pixels: 1 << 20, ..Default::default() };
        match load_tensor(&bytes, &config, SIZE) {
            Ok(tensor) => prop_assert!(tensor.data.iter().all(|value| value.is_finite())),
            Err(error) => prop_assert!(!error.to_string().is_empty()),
        }
    }
}

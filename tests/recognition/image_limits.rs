//! Images beyond the limits are refused before they are decoded.

use crate::pictures::{
    SIZE, code, default_decode, dynamic, encoded, fixture, picture, webp_with_exif,
};
use image::{DynamicImage, ImageFormat};
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{
    ImageConfig, ImageError, decode, encode_jpeg, encode_png, load_tensor,
};

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
fn a_jpeg_of_thousands_of_scans_is_refused_before_it_is_decoded() {
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
        let jpeg = fixture(name);
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

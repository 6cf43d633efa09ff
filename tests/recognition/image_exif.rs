//! EXIF in images: orientation, position, direction and time.

use crate::pictures::{
    QUADRANTS, assert_quadrants, default_decode, dynamic, encoded, exif_block, jpeg_with_exif,
    picture, png_with_exif, webp_with_exif,
};
use exif::{Rational, Tag, Value};
use image::ImageFormat;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{
    ImageConfig, RgbImage, encode_jpeg, encode_png, load_tensor, read_exif,
};

#[test]
fn all_eight_orientations_come_out_upright_in_every_container() {
    let upright = dynamic();
    for value in 1u16..=8 {
        // A camera in that orientation stores the inverse of what the tag asks the reader to do.
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
        // The extended header of a WebP repeats the size of its canvas, so only orientations that
        // keep the size can be patched in here.
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

/// Checks that a tensor of other proportions than the picture shows the quadrants upright, too.
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
    assert_eq!(
        info.captured_at.unwrap().instant().unix_timestamp(),
        1_772_335_805
    );

    fields.truncate(6);
    assert_eq!(
        read(&fields)
            .captured_at
            .unwrap()
            .instant()
            .unix_timestamp(),
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

//! PNG and WebP files that are odd, damaged or incomplete: what viewers show in full is accepted,
//! what lacks pixels is refused.

use crate::pictures::{code, default_decode, dynamic, encoded, fixture, picture};
use image::ImageFormat;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, RgbImage, decode, encode_png, load_tensor};

/// A chunk of a PNG.
fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let content = [kind.as_slice(), data].concat();
    let crc = crc32fast::hash(&content).to_be_bytes();
    [&(data.len() as u32).to_be_bytes(), &content[..], &crc].concat()
}

/// The chunks of a PNG: kind and data.
fn chunks(png: &[u8]) -> Vec<([u8; 4], Vec<u8>)> {
    let mut rest = &png[8..];
    let mut found = Vec::new();
    while !rest.is_empty() {
        let length = u32::from_be_bytes(rest[..4].try_into().unwrap()) as usize;
        let kind = rest[4..8].try_into().unwrap();
        found.push((kind, rest[8..8 + length].to_vec()));
        rest = &rest[12 + length..];
    }
    found
}

/// A PNG of chunks.
fn png(chunks: &[Vec<u8>]) -> Vec<u8> {
    [b"\x89PNG\r\n\x1a\n".as_slice(), &chunks.concat()[..]].concat()
}

/// The picture's PNG as its header, its pixels (compressed) and its end.
fn parts() -> (Vec<u8>, Vec<u8>, Vec<u8>) {
    let all = chunks(&encode_png(&picture()).unwrap());
    let of = |kind: &[u8; 4]| -> Vec<u8> {
        let data = all.iter().filter(|(found, _)| found == kind);
        data.flat_map(|(_, data)| data.clone()).collect()
    };
    (
        chunk(b"IHDR", &of(b"IHDR")),
        of(b"IDAT"),
        chunk(b"IEND", b""),
    )
}

#[track_caller]
fn assert_is_picture(bytes: &[u8], expected: &RgbImage, name: &str) {
    let image = default_decode(bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
    assert!(image == *expected, "{name}: other pixels");
    let small = ImageSize {
        width: 4,
        height: 4,
    };
    load_tensor(bytes, &ImageConfig::default(), small)
        .unwrap_or_else(|error| panic!("{name}, as a tensor: {error}"));
}

#[test]
fn what_stands_beside_the_pixels_of_a_png_does_not_matter() {
    let (header, pixels, end) = parts();
    let pixels = chunk(b"IDAT", &pixels);
    let mut damaged = chunk(b"tEXt", b"Comment\0hello");
    *damaged.last_mut().unwrap() ^= 1;
    // Said to be compressed, but nothing that can be unpacked.
    let profile = chunk(b"iCCP", b"name\0\0rubbish");
    let text = chunk(b"zTXt", b"name\0\0rubbish");
    let international = chunk(b"iTXt", b"name\0\x01\0\0\0rubbish");
    let many = chunk(b"teSt", b"").repeat(100_000);
    for (name, extra) in [
        ("a chunk with a wrong checksum", damaged),
        ("a profile", profile.clone()),
        ("two profiles", profile.repeat(2)),
        ("packed text", text),
        ("packed international text", international),
        ("many chunks", many),
    ] {
        let file = png(&[header.clone(), extra.clone(), pixels.clone(), end.clone()]);
        assert_is_picture(&file, &picture(), name);
        let file = png(&[header.clone(), pixels.clone(), extra, end.clone()]);
        assert_is_picture(&file, &picture(), name);
    }
    let no_end = png(&[header.clone(), pixels.clone()]);
    assert_is_picture(&no_end, &picture(), "without its end");
    for kept in 1..end.len() {
        let file = png(&[header.clone(), pixels.clone(), end[..kept].to_vec()]);
        assert_is_picture(&file, &picture(), "with a part of its end");
    }
    let text = chunk(b"tEXt", b"Comment\0hello");
    for kept in 1..text.len() {
        let file = png(&[header.clone(), pixels.clone(), text[..kept].to_vec()]);
        assert_is_picture(&file, &picture(), "cut in its metadata");
    }
    let more = png(&[header, pixels, end, b"more bytes".to_vec()]);
    assert_is_picture(&more, &picture(), "with bytes behind its end");
}

#[test]
fn a_png_whose_pixels_are_damaged_or_missing_is_refused() {
    let (header, pixels, end) = parts();
    for kept in [0, 1, pixels.len() / 2, pixels.len() - 12] {
        let part = chunk(b"IDAT", &pixels[..kept]);
        let file = png(&[header.clone(), part, end.clone()]);
        assert_eq!(code(&file), "image_undecodable", "{kept} bytes of pixels");
    }
    assert_eq!(
        code(&png(&[header.clone(), end.clone()])),
        "image_undecodable"
    );
    let flipped = |mut chunk: Vec<u8>| {
        *chunk.last_mut().unwrap() ^= 1;
        chunk
    };
    let pixels = chunk(b"IDAT", &pixels);
    let file = png(&[flipped(header.clone()), pixels.clone(), end.clone()]);
    assert_eq!(code(&file), "image_undecodable", "checksum of the header");
    let file = png(&[header.clone(), flipped(pixels.clone()), end.clone()]);
    assert_eq!(code(&file), "image_undecodable", "checksum of the pixels");
    let unknown = chunk(b"TEST", b"");
    let file = png(&[header, unknown, pixels, end]);
    assert_eq!(
        code(&file),
        "image_undecodable",
        "an unknown chunk that matters"
    );
}

#[test]
fn of_an_animated_png_the_first_picture_alone_counts() {
    let (header, pixels, end) = parts();
    let animation = chunk(b"acTL", &[0, 0, 0, 2, 0, 0, 0, 0]);
    let frame = |number: u8, width: u8| {
        let sides = [[0, 0, 0, width], [0, 0, 0, 32], [0; 4], [0; 4]].concat();
        chunk(
            b"fcTL",
            &[&[0, 0, 0, number], &sides[..], &[0, 1, 0, 10, 0, 0]].concat(),
        )
    };
    let pixels = chunk(b"IDAT", &pixels);
    let damaged = chunk(b"fdAT", b"\0\0\0\x02rubbish");
    let file = png(&[
        header.clone(),
        animation.clone(),
        frame(0, 48),
        pixels.clone(),
        frame(1, 48),
        damaged,
        end.clone(),
    ]);
    assert_is_picture(&file, &picture(), "a damaged second frame");
    let file = png(&[header, animation, frame(0, 24), pixels, end]);
    assert_eq!(
        code(&file),
        "image_undecodable",
        "a first frame of another size"
    );
}

/// A WebP of chunks, each filled up to an even length.
fn webp(chunks: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
    let mut body = b"WEBP".to_vec();
    for (kind, data) in chunks {
        body.extend_from_slice(*kind);
        body.extend((data.len() as u32).to_le_bytes());
        body.extend_from_slice(data);
        body.extend(vec![0; data.len() % 2]);
    }
    [
        b"RIFF".as_slice(),
        &(body.len() as u32).to_le_bytes()[..],
        &body,
    ]
    .concat()
}

fn extended(flags: u8, width: u8, height: u8) -> [u8; 10] {
    [flags, 0, 0, 0, width - 1, 0, 0, height - 1, 0, 0]
}

/// Kind and data of the picture in both codings.
fn pictures() -> [([u8; 4], Vec<u8>); 2] {
    [
        encoded(&dynamic(), ImageFormat::WebP),
        fixture("lossy.webp"),
    ]
    .map(|file| {
        let length = u32::from_le_bytes(file[16..20].try_into().unwrap()) as usize;
        (
            file[12..16].try_into().unwrap(),
            file[20..20 + length].to_vec(),
        )
    })
}

#[test]
fn what_stands_beside_the_picture_of_a_webp_does_not_matter() {
    for (kind, data) in pictures() {
        let picture = (&kind, data.as_slice());
        let expected = default_decode(&webp(&[picture])).unwrap();
        let all = extended(0b0010_1100, 48, 32);
        for (name, chunks) in [
            (
                "metadata",
                vec![
                    (b"ICCP", b"x".as_slice()),
                    picture,
                    (b"EXIF", b"y"),
                    (b"XMP ", b"z"),
                ],
            ),
            ("metadata that are announced but missing", vec![picture]),
            (
                "an unknown chunk",
                vec![(b"TEST", b"odd".as_slice()), picture],
            ),
            ("rubbish", vec![picture, (b"EXIF", &[0xff; 77])]),
        ] {
            let chunks = [vec![(b"VP8X", all.as_slice())], chunks].concat();
            let file = webp(&chunks);
            assert_is_picture(&file, &expected, name);
            assert_is_picture(
                &[&file, b"more".as_slice()].concat(),
                &expected,
                "bytes behind",
            );
        }
        let rubbish = (b"ALPH", [0x01, 0xff, 0xff].as_slice());
        let file = webp(&[(b"VP8X", &extended(0x10, 48, 32)), rubbish, picture]);
        assert_is_picture(&file, &expected, "a damaged alpha channel");

        // Whatever is cut off behind the picture.
        let file = webp(&[(b"VP8X", &all), picture, (b"EXIF", b"four")]);
        for missing in 1..12 {
            let cut = &file[..file.len() - missing];
            assert_is_picture(cut, &expected, "cut behind the picture");
        }
        let mut long = webp(&[picture]);
        long[4] += 1;
        assert_is_picture(&long, &expected, "a length with a byte too many");
    }
}

#[test]
fn an_odd_webp_may_lack_the_byte_that_fills_it_up() {
    let (kind, mut data) = pictures()[0].clone();
    if data.len().is_multiple_of(2) {
        // Bytes behind the compressed data are not read.
        data.push(0);
    }
    let file = webp(&[(&kind, &data)]);
    let expected = default_decode(&file).unwrap();
    assert_is_picture(&file[..file.len() - 1], &expected, "the byte is missing");
    let mut short = file[..file.len() - 1].to_vec();
    short[4] -= 1;
    assert_is_picture(&short, &expected, "the length does not count it");
}

#[test]
fn a_webp_whose_picture_is_incomplete_is_refused() {
    for (kind, data) in pictures() {
        let file = webp(&[(&kind, &data)]);
        let mut short = file.clone();
        short[4] -= 4;
        assert_eq!(
            code(&short),
            "image_undecodable",
            "a length that is too short"
        );
        // Every length agrees with what is left.
        for kept in [0, 5, 10, data.len() / 4, data.len() / 2] {
            let half = webp(&[(&kind, &data[..kept])]);
            assert_eq!(
                code(&half),
                "image_undecodable",
                "{kept} bytes of the picture"
            );
        }
        let other = webp(&[(b"VP8X", &extended(0, 40, 32)), (&kind, &data)]);
        assert_eq!(
            code(&other),
            "image_undecodable",
            "a canvas of another size"
        );
        let huge = [0, 0, 0, 0, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff];
        let huge = webp(&[(b"VP8X", &huge), (&kind, &data)]);
        assert_eq!(code(&huge), "image_too_large");
        assert_eq!(
            code(&webp(&[(b"VP8X", &extended(0, 48, 32))])),
            "image_undecodable"
        );
    }
    let animated = fixture("animated.webp");
    assert_eq!(code(&animated[..animated.len() / 2]), "image_undecodable");
    assert!(decode(&animated, &ImageConfig::default()).is_ok());
}

//! What viewers show in full is accepted, at every size, as the same picture.

use crate::jpeg::encoder::{Layout, jfif, segment};
use crate::jpeg::picture::{Colours, assert_agrees, assert_shows, full};
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{RgbImage, encode_jpeg};

fn layouts() -> Vec<Layout> {
    let layout = Layout::new(70, 50, Colours::YCbCr).sampled(&[(2, 2), (1, 1), (1, 1)]);
    vec![
        layout.clone(),
        layout.clone().restarting(2),
        layout.clone().separate().restarting(3),
        layout.clone().progressive(),
        layout.progressive().restarting(1),
    ]
}

/// The file with `extra` before segment `at` of those in the head and the scans.
fn with_segment(layout: &Layout, at: usize, extra: &[u8]) -> Vec<u8> {
    let mut parts = vec![b"\xff\xd8".to_vec()];
    parts.extend(layout.head());
    parts.extend(layout.scans());
    parts.push(b"\xff\xd9".to_vec());
    parts.insert(at + 1, extra.to_vec());
    parts.concat()
}

fn segments(layout: &Layout) -> usize {
    layout.head().len() + layout.scans().len()
}

#[track_caller]
fn assert_same(file: &[u8], layout: &Layout, name: &str) {
    let expected = full(&layout.encode()).unwrap();
    let image = full(file).unwrap_or_else(|error| panic!("{name}: {error}"));
    assert!(image == expected, "{name}: other pixels");
    assert_agrees(file, &image, name);
}

#[test]
fn anything_harmless_between_segments() {
    let thumbnail = Layout::new(16, 16, Colours::Grey).encode();
    let exif = [b"Exif\0\0".as_slice(), &thumbnail].concat();
    let harmless: [(&str, Vec<u8>); 14] = [
        ("zeros", vec![0, 0]),
        ("stray bytes", b"stray".to_vec()),
        ("an escaped byte", vec![0xff, 0]),
        ("fill bytes", vec![0xff; 5]),
        (
            "a comment with an end marker",
            segment(0xfe, b"\xff\xd9\xff\xd8\xff\xda"),
        ),
        ("an empty comment", segment(0xfe, b"")),
        ("a thumbnail", segment(0xe1, &exif)),
        ("a second JFIF header", jfif()),
        (
            "a colour profile",
            segment(
                0xe2,
                &[b"ICC_PROFILE\0\x01\x02".as_slice(), &[0xff; 90]].concat(),
            ),
        ),
        ("metadata of length zero", vec![0xff, 0xe4, 0, 0]),
        ("a comment of length one", vec![0xff, 0xfe, 0, 1]),
        ("a restart marker", vec![0xff, 0xd3]),
        ("a marker without content", vec![0xff, 0x01]),
        (
            "a Huffman table that nothing uses",
            segment(
                0xc4,
                &[&[0x13][..], &[255; 1], &[0; 15], &[1; 255]].concat(),
            ),
        ),
    ];
    for layout in layouts() {
        for (name, extra) in &harmless {
            // Right behind the start marker a viewer would not recognise the file.
            for at in 1..=segments(&layout) {
                let file = with_segment(&layout, at, extra);
                assert_same(&file, &layout, &format!("{name} before segment {at}"));
            }
        }
    }
}

#[test]
fn exif_before_jfif() {
    for layout in layouts() {
        let exif = segment(0xe1, b"Exif\0\0II*\0\x08\0\0\0\0\0");
        assert_same(&with_segment(&layout, 0, &exif), &layout, "Exif first");
    }
}

#[test]
fn a_missing_end_marker_and_anything_behind_it() {
    for layout in layouts() {
        let file = layout.encode();
        let end = file.len() - 2;
        let second = Layout::new(24, 24, Colours::Grey).encode();
        for (name, tail) in [
            ("no end marker", b"".as_slice()),
            ("half an end marker", b"\xff"),
            ("zeros instead", &[0; 40]),
            ("bytes behind", b"\xff\xd9 and more"),
            ("markers behind", b"\xff\xd9\xff\xc0\xff\xda\xff\x02"),
            ("a second JPEG", &[b"\xff\xd9", second.as_slice()].concat()),
        ] {
            assert_same(&[&file[..end], tail].concat(), &layout, name);
        }
    }
}

/// Where restart markers stand in `file`.
fn restarts(file: &[u8]) -> Vec<usize> {
    let pairs = file.windows(2).enumerate();
    let found = pairs.filter(|(_, pair)| pair[0] == 0xff && (0xd0..=0xd7).contains(&pair[1]));
    found.map(|(at, _)| at).collect()
}

#[test]
fn stray_bytes_before_restart_markers() {
    for layout in layouts() {
        let file = layout.encode();
        for at in restarts(&file).into_iter().take(20) {
            for stray in [
                b"\x11".as_slice(),
                &[0x5a; 9],
                &[0xff, 0x00, 0xff, 0x00],
                &[0xff, 0xff],
            ] {
                let file = [&file[..at], stray, &file[at..]].concat();
                assert_same(&file, &layout, "stray bytes");
            }
        }
    }
}

#[test]
fn restart_markers_of_a_number_far_off() {
    for layout in layouts()
        .into_iter()
        .filter(|layout| layout.restart_interval > 0)
    {
        for off in [3, 4, 5] {
            let mut file = layout.encode();
            let at = restarts(&file)[0];
            file[at + 1] = 0xd0 + (file[at + 1] - 0xd0 + off) % 8;
            assert_same(&file, &layout, "the wrong number");
        }
    }
}

/// Frames of USB cameras and of motion JPEG leave out the standard Huffman tables.
#[test]
fn a_frame_without_huffman_tables() {
    let size = ImageSize {
        width: 61,
        height: 45,
    };
    let pixels = (0..61 * 45 * 3).map(|i| (i * 7 % 251) as u8).collect();
    let file = encode_jpeg(&RgbImage { size, pixels }, 80).unwrap();
    let expected = full(&file).unwrap();
    let mut frame = file.clone();
    while let Some(at) = frame.windows(2).position(|marker| marker == [0xff, 0xc4]) {
        let length = usize::from(u16::from_be_bytes([frame[at + 2], frame[at + 3]]));
        frame.drain(at..at + 2 + length);
    }
    assert!(frame.len() + 400 < file.len());
    assert!(full(&frame).unwrap() == expected);
    assert_agrees(&frame, &expected, "no tables");
    // Cameras that speak AVI say so.
    let avi = segment(0xe0, b"AVI1\0\0\0\0\0\0\0\0\0\0");
    let frame = [&frame[..2], &avi, &frame[2..]].concat();
    assert!(full(&frame).unwrap() == expected);
}

#[test]
fn quantisers_of_sixteen_bits_and_of_zero() {
    let wide = |value: u16| {
        let values = [value; 64]
            .iter()
            .flat_map(|value| value.to_be_bytes())
            .collect::<Vec<_>>();
        segment(0xdb, &[&[0x10][..], &values].concat())
    };
    for layout in layouts() {
        // Tables that come later replace the earlier ones, but not within a component.
        assert_same(&with_segment(&layout, 2, &wide(3)), &layout, "16 bits");
        let all = segments(&layout);
        assert_same(&with_segment(&layout, all, &wide(900)), &layout, "too late");
    }
    // A quantiser of zero makes its coefficients zero, which in this picture the high ones are.
    let mut table = [3; 64];
    table[60..].fill(0);
    let table = segment(0xdb, &[&[0][..], &table].concat());
    for layout in layouts()
        .into_iter()
        .filter(|layout| layout.progressive || layout.scans.len() == 1)
    {
        let file = with_segment(&layout, 2, &table);
        assert_shows(&file, &layout, "quantisers of zero");
    }
}

#[test]
fn tables_between_scans_apply_to_the_scans_behind_them() {
    let layout = Layout::new(70, 50, Colours::YCbCr).separate();
    let [dc, ac] = crate::jpeg::encoder::huffman_tables();
    // Tables that fit nothing stand first, and the right ones before each scan.
    let mut wrong = dc.clone();
    wrong[5] = 12;
    wrong[8] = 0;
    let mut parts = vec![b"\xff\xd8".to_vec()];
    parts.extend(layout.head());
    parts.push(wrong);
    for scan in layout.scans() {
        parts.extend([dc.clone(), ac.clone(), scan]);
    }
    parts.push(b"\xff\xd9".to_vec());
    assert_same(&parts.concat(), &layout, "tables between scans");
}

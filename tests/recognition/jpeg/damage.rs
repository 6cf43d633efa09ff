//! What lacks image data, or is coded in a way that is not supported, is refused with its cause.

use crate::jpeg::encoder::{Layout, Scan, huffman_tables, segment};
use crate::jpeg::picture::{Colours, assert_refused, full, is_taken};

fn layouts() -> Vec<Layout> {
    let layout = Layout::new(70, 50, Colours::YCbCr).sampled(&[(2, 1), (1, 1), (1, 1)]);
    vec![
        layout.clone(),
        layout.clone().restarting(1),
        layout.clone().separate(),
        layout.clone().progressive(),
        layout.progressive().restarting(2),
        Layout::new(70, 50, Colours::Cmyk),
    ]
}

#[test]
fn every_cut_with_and_without_an_end_marker() {
    for layout in layouts() {
        let file = layout.encode();
        let whole = file.len() - 2;
        for cut in 2..whole {
            let name = format!("{layout:?} cut at {cut} of {whole}");
            assert!(!is_taken(&file[..cut], &name), "{name}");
            // A progressive picture may end behind any scan, if it says so.
            if !layout.progressive {
                let ended = [&file[..cut], b"\xff\xd9"].concat();
                assert!(!is_taken(&ended, &name), "{name}, with an end marker");
            }
        }
        let half = &file[..file.len() * 3 / 4];
        assert_refused(half, "truncated", "half");
        assert_refused(
            &[half, b"\xff\xd9"].concat(),
            "truncated",
            "half with an end",
        );
    }
}

#[test]
fn a_cut_inside_a_scan_of_a_progressive_picture() {
    let layout = Layout::new(70, 50, Colours::YCbCr).progressive();
    let [head, scans] = [layout.head(), layout.scans()];
    for (number, scan) in scans.iter().enumerate() {
        let before = [
            b"\xff\xd8".as_slice(),
            &head.concat()[..],
            &scans[..number].concat(),
        ]
        .concat();
        for kept in scan.len() - scan.len() / 4..scan.len() {
            let file = [&before, &scan[..kept], b"\xff\xd9"].concat();
            assert_refused(&file, "truncated", &format!("scan {number} cut at {kept}"));
        }
    }
}

#[test]
fn missing_restart_intervals() {
    let layout = Layout::new(70, 50, Colours::YCbCr).restarting(2);
    let file = layout.encode();
    let marks: Vec<usize> = (0..file.len() - 1)
        .filter(|&at| file[at] == 0xff && (0xd0..=0xd7).contains(&file[at + 1]))
        .collect();
    for pair in marks.windows(2) {
        // The marker stays, its data go; then the data with their marker.
        let emptied = [&file[..pair[0] + 2], &file[pair[1]..]].concat();
        assert_refused(&emptied, "truncated", "an empty interval");
        let without = [&file[..pair[0]], &file[pair[1]..]].concat();
        assert_refused(&without, "truncated", "a missing interval");
        let short = [&file[..pair[1] - 3], &file[pair[1]..]].concat();
        assert_refused(&short, "truncated", "an interval that is too short");
    }
    let unmarked = [&file[..marks[3]], &file[marks[3] + 2..]].concat();
    assert!(!is_taken(&unmarked, "a missing marker"));
}

#[test]
fn missing_scans() {
    let layout = Layout::new(70, 50, Colours::YCbCr).separate();
    for missing in 0..3 {
        let mut layout = layout.clone();
        layout.scans.remove(missing);
        assert_refused(&layout.encode(), "no image data", "a missing component");
    }
    let progressive = |scans: Vec<Scan>| Layout {
        scans,
        progressive: true,
        ..Layout::new(70, 50, Colours::YCbCr)
    };
    let means = Scan::new(&[0, 1], (0, 0), (0, 0));
    assert_refused(
        &progressive(vec![means.clone()]).encode(),
        "component 3",
        "no red",
    );
    let all = Scan::new(&[0, 1, 2], (0, 0), (0, 0));
    for (name, scan) in [
        ("means again", all.clone()),
        (
            "a refinement of what is final",
            Scan::new(&[0], (0, 0), (1, 0)),
        ),
        ("a refinement of nothing", Scan::new(&[0], (1, 63), (2, 1))),
    ] {
        let file = progressive(vec![all.clone(), scan]).encode();
        assert_refused(&file, "does not continue", name);
    }
    for (name, scan) in [
        ("means and others", Scan::new(&[0], (0, 5), (0, 0))),
        (
            "a band of two components",
            Scan::new(&[0, 1], (1, 5), (0, 0)),
        ),
        ("two bits at once", Scan::new(&[0], (1, 5), (3, 1))),
        ("all bits left", Scan::new(&[0], (1, 5), (0, 8))),
    ] {
        let file = progressive(vec![all.clone(), scan]).encode();
        assert_refused(&file, "wrong parameters", name);
    }
    let early = progressive(vec![Scan::new(&[0], (1, 63), (0, 0)), all]);
    assert_refused(&early.encode(), "does not continue", "others before means");
}

#[test]
fn a_header_without_image_data() {
    let huge = Layout::new(8, 8, Colours::YCbCr);
    let mut file = [b"\xff\xd8".as_slice(), &huge.head().concat()].concat();
    let frame = file
        .windows(2)
        .position(|marker| marker == [0xff, 0xc0])
        .unwrap();
    file[frame + 5..frame + 9].copy_from_slice(&[0x1f, 0x40, 0x1f, 0x40]);
    assert_refused(&file, "truncated", "64 megapixels without a scan");
    assert_refused(
        &[&file[..], b"\xff\xd9"].concat(),
        "truncated",
        "with an end marker",
    );
    let scan = segment(0xda, &[3, 1, 0, 2, 0, 3, 0, 0, 63, 0]);
    let file = [file, scan, b"\xff\xd9".to_vec()].concat();
    assert_refused(&file, "has 0 of 1000000 units", "with an empty scan");
}

/// The file with the frame header changed.
fn with_frame(change: impl Fn(&mut Vec<u8>)) -> Vec<u8> {
    let layout = Layout::new(70, 50, Colours::YCbCr);
    let mut segments = layout.head();
    change(&mut segments[2]);
    [
        b"\xff\xd8".to_vec(),
        segments.concat(),
        layout.scans().concat(),
        b"\xff\xd9".to_vec(),
    ]
    .concat()
}

#[test]
fn codings_that_are_not_supported() {
    let coded = |marker: u8| with_frame(|frame| frame[1] = marker);
    for (marker, cause) in [
        (0xc3, "lossless"),
        (0xc5, "hierarchical"),
        (0xc6, "hierarchical"),
        (0xc7, "hierarchical"),
        (0xc9, "arithmetic"),
        (0xca, "arithmetic"),
        (0xcb, "lossless"),
        (0xcd, "hierarchical"),
        (0xcf, "hierarchical"),
    ] {
        assert_refused(&coded(marker), cause, "coding");
    }
    assert!(full(&coded(0xc1)).is_ok(), "extended sequential");
    assert_refused(&with_frame(|frame| frame[4] = 12), "12 bits", "depth");
    assert_refused(
        &with_frame(|frame| frame[5..7].fill(0)),
        "DNL",
        "height zero",
    );
    assert_refused(
        &with_frame(|frame| frame[7..9].fill(0)),
        "0x50",
        "width zero",
    );
    assert_refused(
        &with_frame(|frame| frame[11] = 0x01),
        "sampling",
        "factor zero",
    );
    assert_refused(
        &with_frame(|frame| frame[11] = 0x15),
        "sampling",
        "factor five",
    );
    assert_refused(
        &with_frame(|frame| frame[12] = 4),
        "slot",
        "slot of quantisers",
    );
    assert_refused(
        &with_frame(|frame| frame[12] = 3),
        "quantisers",
        "empty slot",
    );
    for count in [0, 2, 5] {
        let frame = with_frame(|frame| {
            let components = frame.split_off(10);
            frame[9] = count;
            frame[3] = 8 + 3 * count;
            frame.extend(components.into_iter().cycle().take(3 * usize::from(count)));
        });
        assert_refused(&frame, &format!("{count} components"), "components");
    }
}

#[test]
fn segments_that_are_wrong() {
    let layout = Layout::new(70, 50, Colours::YCbCr);
    let head = layout.head();
    let scans = layout.scans().concat();
    let [dc, _] = huffman_tables();
    let mut full_code = dc.clone();
    // Sixteen codes of four bits, the last of which has ones only.
    full_code[8] = 16;
    full_code.extend([0; 4]);
    full_code[3] += 4;
    for (name, extra, cause) in [
        (
            "tables of length zero",
            vec![0xff, 0xc4, 0, 0],
            "wrong length",
        ),
        (
            "quantisers of length one",
            vec![0xff, 0xdb, 0, 1],
            "wrong length",
        ),
        ("a second frame", head[2].clone(), "second frame header"),
        ("a second start", vec![0xff, 0xd8], "second start of image"),
        ("an unknown marker", vec![0xff, 0x02], "FF 02"),
        (
            "a table of a wrong class",
            segment(0xc4, &[[0x20].as_slice(), &[0; 16]].concat()),
            "kind or slot",
        ),
        (
            "a table in a wrong slot",
            segment(0xc4, &[[0x04].as_slice(), &[0; 16]].concat()),
            "slot",
        ),
        ("half a table", segment(0xc4, &dc[4..20]), "wrong length"),
        (
            "a table with a code of ones",
            full_code,
            "Huffman table is corrupt",
        ),
        ("half quantisers", segment(0xdb, &[0; 40]), "wrong length"),
        (
            "quantisers in a wrong slot",
            segment(0xdb, &[4; 65]),
            "slot",
        ),
        (
            "half a restart interval",
            segment(0xdd, &[1]),
            "wrong length",
        ),
        (
            "a scan of no component",
            segment(0xda, &[0, 0, 63, 0]),
            "wrong parameters",
        ),
        (
            "a scan of an unknown one",
            segment(0xda, &[1, 9, 0, 0, 63, 0]),
            "wrong parameters",
        ),
        (
            "a scan with a wrong table",
            segment(0xda, &[1, 1, 0x40, 0, 63, 0]),
            "wrong parameters",
        ),
    ] {
        let file = [
            b"\xff\xd8".as_slice(),
            &head.concat()[..],
            &extra,
            &scans,
            b"\xff\xd9",
        ]
        .concat();
        assert_refused(&file, cause, name);
    }
    let early = [
        b"\xff\xd8".as_slice(),
        &scans[..],
        &head.concat(),
        b"\xff\xd9",
    ]
    .concat();
    assert_refused(&early, "before the frame header", "a scan first");
    let unquantised: Vec<u8> = head
        .iter()
        .filter(|part| part[1] != 0xdb)
        .flatten()
        .copied()
        .collect();
    let file = [
        b"\xff\xd8".as_slice(),
        &unquantised[..],
        &scans,
        b"\xff\xd9",
    ]
    .concat();
    assert_refused(&file, "quantisers", "no quantisers");
}

/// `zune-jpeg` and viewers refuse a DC table with a symbol that is no number of bits, even if no code
/// of the picture has it; `jpeg-decoder` does not.
#[test]
fn a_dc_table_with_a_symbol_that_is_no_number_of_bits() {
    for layout in [
        Layout::new(70, 50, Colours::Grey),
        Layout::new(70, 50, Colours::YCbCr).progressive(),
    ] {
        let mut head = layout.head();
        let table = head.iter_mut().find(|part| part[1] == 0xc4 && part[4] == 0);
        let table = table.expect("a DC table");
        // Eleven is the last of its symbols, and no difference of this picture has so many bits.
        *table.last_mut().unwrap() = 16;
        let parts = [
            b"\xff\xd8",
            &head.concat()[..],
            &layout.scans().concat(),
            b"\xff\xd9",
        ];
        assert_refused(&parts.concat(), "Huffman table", &format!("{layout:?}"));
    }
}

#[test]
fn a_huffman_table_that_is_missing() {
    let layout = Layout::new(70, 50, Colours::Grey);
    let mut scan = layout.scans().concat();
    // Only the first two slots have standard tables.
    for slots in [0x20, 0x03] {
        scan[6] = slots;
        let file = [
            b"\xff\xd8".as_slice(),
            &layout.head().concat()[..],
            &scan,
            b"\xff\xd9",
        ]
        .concat();
        assert_refused(
            &file,
            "Huffman table that is missing",
            "a slot without a table",
        );
    }
    // Motion JPEG is sequential, so progressive pictures have no standard tables.
    let layout = Layout::new(70, 50, Colours::YCbCr).progressive();
    let head: Vec<u8> = layout
        .head()
        .into_iter()
        .filter(|part| part[1] != 0xc4)
        .flatten()
        .collect();
    let file = [
        b"\xff\xd8",
        &head[..],
        &layout.scans().concat(),
        b"\xff\xd9",
    ]
    .concat();
    assert_refused(
        &file,
        "Huffman table that is missing",
        "a progressive picture without tables",
    );
}

#[test]
fn codes_without_meaning() {
    // A DC difference of more than eleven bits, a run out of the block, an end of several blocks.
    let head = |layout: &Layout| [b"\xff\xd8".to_vec(), layout.head().concat()].concat();
    let layout = Layout::new(8, 8, Colours::Grey);
    let scan = |data: &[u8]| {
        [
            &head(&layout),
            &segment(0xda, &[1, 1, 0, 0, 63, 0]),
            data,
            b"\xff\xd9",
        ]
        .concat()
    };
    assert!(full(&scan(&[0x00, 0x0f])).is_ok(), "a grey block");
    for (name, data, cause) in [
        (
            "no such code",
            &[0xdf, 0xff, 0x00, 0x00][..],
            "no table has",
        ),
        (
            "out of the block",
            &[0x0f, 0x0f, 0x0f, 0x0f, 0x0f, 0x1f],
            "outside its block",
        ),
        ("an end of blocks", &[0x01, 0x0f, 0x00], "without meaning"),
    ] {
        assert_refused(&scan(data), cause, name);
    }
}

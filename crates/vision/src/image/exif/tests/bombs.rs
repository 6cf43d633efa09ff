//! Blocks that are made to keep a reader busy, or to lead it out of the block. Each must be read in
//! the time of a walk over its file; a reader that follows them never ends.

use super::writer::{Container, Order};
use crate::image::exif::{
    DATE_TIME_ORIGINAL, EXIF_DIRECTORY, ExifInfo, GPS_DIRECTORY, ORIENTATION, orientation,
};
use crate::image::read_exif;
use image::metadata::Orientation;
use proptest::prelude::*;

fn entry(order: Order, tag: u16, kind: u16, count: u32, value: u32) -> Vec<u8> {
    let parts = [order.u16(tag).to_vec(), order.u16(kind).to_vec()];
    let numbers = [order.u32(count), order.u32(value)].concat();
    [parts.concat(), numbers].concat()
}

/// A block whose first directory has these entries, and `tail` behind them.
fn block(order: Order, entries: &[Vec<u8>], tail: &[u8]) -> Vec<u8> {
    let count = order.u16(entries.len() as u16).to_vec();
    [
        order.header(),
        count,
        entries.concat(),
        vec![0; 4],
        tail.to_vec(),
    ]
    .concat()
}

/// Checks that nothing is read from `block` in any container; says so of each.
fn assert_silent(block: &[u8], what: &str) {
    for container in Container::ALL {
        let bytes = container.with_exif(block);
        assert_eq!(
            read_exif(&bytes),
            ExifInfo::default(),
            "{what}, {container:?}"
        );
        let upright = Orientation::NoTransforms;
        assert_eq!(orientation(&bytes), upright, "{what}, {container:?}");
    }
}

const ORDERS: [Order; 2] = [Order::Little, Order::Big];

#[test]
fn sixty_thousand_directories_that_overlap() {
    for order in ORDERS {
        let count = u32::from(u16::MAX);
        let start = 8 + 2 + 12 * count + 4;
        for (pointer, tail) in [
            (EXIF_DIRECTORY, 0xff),
            (GPS_DIRECTORY, 0xff),
            (0x014a, 0x87),
        ] {
            let entries: Vec<Vec<u8>> = (0..count)
                .map(|index| entry(order, pointer, 4, 1, start + index))
                .collect();
            assert_silent(&block(order, &entries, &vec![tail; 865_535]), "overlapping");
        }
    }
}

#[test]
fn directories_that_contain_themselves() {
    for order in ORDERS {
        let pointers = [EXIF_DIRECTORY, GPS_DIRECTORY, 0x014a, 0xa005, 0x0201];
        let entries = pointers.map(|tag| entry(order, tag, 4, 1, 8));
        let mut circle = block(order, &entries, b"");
        // The directory that follows is the first one again.
        let next = circle.len() - 4;
        circle[next..].copy_from_slice(&order.u32(8));
        assert_silent(&circle, "circle");
    }
}

#[test]
fn entries_behind_the_limit_do_not_count() {
    for order in ORDERS {
        let mut entries = vec![entry(order, 0x0100, 3, 1, 0); 511];
        let upright = order.u16(6);
        let mut last = entry(order, ORIENTATION, 3, 1, 0);
        last[8..10].copy_from_slice(&upright);
        entries.push(last.clone());
        let bytes = Container::Png.with_exif(&block(order, &entries, b""));
        assert_eq!(orientation(&bytes), Orientation::Rotate90);
        entries.insert(0, entry(order, 0x0100, 3, 1, 0));
        assert_silent(&block(order, &entries, b""), "the 513th entry");
    }
}

#[test]
fn offsets_and_counts_beyond_the_block() {
    for order in ORDERS {
        for (kind, count) in [
            (2, u32::MAX),
            (5, u32::MAX),
            (12, 0x2000_0001),
            (3, 0x8000_0000),
        ] {
            for value in [0, 8, 0xffff, u32::MAX - 3, u32::MAX] {
                let entries = [
                    entry(order, ORIENTATION, kind, count, value),
                    entry(order, EXIF_DIRECTORY, 4, count, value),
                    entry(order, GPS_DIRECTORY, kind, 1, value),
                ];
                assert_silent(&block(order, &entries, b""), "out of range");
            }
        }
        let mut header = order.header();
        header[4..].copy_from_slice(&order.u32(u32::MAX));
        assert_silent(&header, "a directory nowhere");
        assert_silent(&order.header(), "a directory behind the end");
    }
}

#[test]
fn values_behind_the_first_64_kibibytes_are_not_read() {
    for order in ORDERS {
        let at = 70_000;
        let entries = [entry(order, EXIF_DIRECTORY, 4, 1, at)];
        let mut far = block(order, &entries, b"");
        far.resize(at as usize, 0);
        far.extend(order.u16(1));
        far.extend(entry(order, DATE_TIME_ORIGINAL, 2, 20, at + 14));
        far.extend(b"2026:03:01 14:30:05\0");
        assert_silent(&far, "far away");
    }
}

#[test]
fn a_file_of_nothing_but_blocks_is_walked_once() {
    let block = block(Order::Big, &[], b"");
    let segment = [b"\xff\xe1\x00\x1cExif\0\0".as_slice(), &block, b"......"].concat();
    let jpeg = [b"\xff\xd8".as_slice(), &segment.repeat(200_000)].concat();
    let chunk = [b"\0\0\0\x0eeXIf".as_slice(), &block, b"crc!"].concat();
    let png = [b"\x89PNG\r\n\x1a\n".as_slice(), &chunk.repeat(200_000)].concat();
    let chunk = [b"EXIF\x0e\0\0\0".as_slice(), &block].concat();
    let webp = [b"RIFF\0\0\0\0WEBP".as_slice(), &chunk.repeat(200_000)].concat();
    for bytes in [jpeg, png, webp] {
        assert_eq!(read_exif(&bytes), ExifInfo::default());
    }
}

proptest! {
    #[test]
    fn any_block_is_read_or_passed_over(
        order in prop::sample::select(ORDERS.to_vec()),
        entries in prop::collection::vec(
            (
                prop::sample::select(vec![
                    ORIENTATION, EXIF_DIRECTORY, GPS_DIRECTORY, DATE_TIME_ORIGINAL, 2, 4, 7, 17,
                ]),
                0u16..15,
                prop_oneof![0u32..8, any::<u32>()],
                prop_oneof![0u32..200, any::<u32>()],
            ),
            0..12,
        ),
        tail in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let entries: Vec<Vec<u8>> = entries
            .into_iter()
            .map(|(tag, kind, count, value)| entry(order, tag, kind, count, value))
            .collect();
        for container in Container::ALL {
            let bytes = container.with_exif(&block(order, &entries, &tail));
            let info = read_exif(&bytes);
            prop_assert_eq!(info.location.is_some(), info.sources.location.is_some());
            let _ = orientation(&bytes);
        }
    }
}

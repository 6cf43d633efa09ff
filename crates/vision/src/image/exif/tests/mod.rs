//! Blocks written byte by byte, in every container and both byte orders.

mod bombs;
mod gps;
mod times;
mod writer;
mod xmp;

use super::*;
use writer::{Container, Exif, Order, Value, jpeg_of};

#[test]
fn every_container_and_both_orders_say_the_same() {
    for order in [Order::Little, Order::Big] {
        let block = Exif::paris()
            .heading(270.5)
            .time("2026:03:01 14:30:05")
            .write(order);
        for container in Container::ALL {
            let info = read_exif(&container.with_exif(&block));
            let place = info.location.expect("no position");
            assert!((place.lat() - 48.8584).abs() < 1e-6, "{container:?}");
            assert!((place.lon() - 2.2945).abs() < 1e-6, "{container:?}");
            assert_eq!(info.heading.unwrap().degrees(), 270.5);
            assert_eq!(
                info.captured_at.unwrap().instant().unix_timestamp(),
                1_772_375_405
            );
            let exif = Some(MetadataBlock::Exif);
            let expected = ExifSources {
                location: exif,
                alt: None,
                heading: exif,
                captured_at: exif,
            };
            assert_eq!(info.sources, expected);
        }
    }
}

#[test]
fn the_identifier_before_the_header_is_no_obstacle() {
    let block = Exif::paris().orientation(6).write(Order::Big);
    let prefixed = [b"Exif\0\0".as_slice(), &block].concat();
    for container in Container::ALL {
        for block in [&block, &prefixed] {
            let bytes = container.with_exif(block);
            assert_eq!(orientation(&bytes), Orientation::Rotate90, "{container:?}");
            assert!(read_exif(&bytes).location.is_some(), "{container:?}");
        }
    }
}

#[test]
fn orientations_of_any_whole_type_are_read_and_others_are_not() {
    let stated = |value: Value| {
        let mut exif = Exif::default();
        exif.first.push((ORIENTATION, value));
        orientation(&Container::Jpeg.with_exif(&exif.write(Order::Little)))
    };
    assert_eq!(stated(Value::Short(vec![3])), Orientation::Rotate180);
    assert_eq!(stated(Value::Long(vec![8])), Orientation::Rotate270);
    assert_eq!(stated(Value::Byte(vec![5])), Orientation::Rotate90FlipH);
    for wrong in [
        Value::Short(vec![0]),
        Value::Short(vec![9]),
        Value::Long(vec![257]),
        Value::Short(vec![]),
        Value::Text("6"),
    ] {
        assert_eq!(stated(wrong), Orientation::NoTransforms);
    }
}

#[test]
fn a_second_block_says_what_the_first_does_not() {
    let first = Exif::default()
        .orientation(6)
        .time("2026:03:01 14:30:05")
        .write(Order::Little);
    let second = Exif::paris().orientation(3).time("1999:01:01 00:00:00");
    let second = second.write(Order::Big);
    let bytes = jpeg_of(&[(b"Exif\0\0", &first), (b"Exif\0\0", &second)]);
    let info = read_exif(&bytes);
    assert!(info.location.is_some());
    assert_eq!(info.captured_at.unwrap().instant().year(), 2026);
    assert_eq!(orientation(&bytes), Orientation::Rotate90);
    // What is no EXIF block does not count as one, and blocks behind the first scan are data.
    let junk = (b"Exif\0\0".as_slice(), b"junk".as_slice());
    let after_junk = jpeg_of(&[junk, junk, junk, junk, junk, (b"Exif\0\0", &second)]);
    assert!(read_exif(&after_junk).location.is_some());
    let scan = b"\xff\xda\x00\x02".as_slice();
    let behind = [b"\xff\xd8".as_slice(), scan, &after_junk[2..]].concat();
    assert_eq!(read_exif(&behind), ExifInfo::default());
}

#[test]
fn what_is_no_image_is_not_read() {
    let block = Exif::paris().orientation(6).write(Order::Little);
    let riff = [b"RIFF\x00\x00\x00\x00AVI EXIF".as_slice(), &block].concat();
    for bytes in [
        block.as_slice(),
        &riff,
        b"",
        b"\xff\xd8",
        b"\x89PNG\r\n\x1a\n",
    ] {
        assert_eq!(read_exif(bytes), ExifInfo::default());
        assert_eq!(orientation(bytes), Orientation::NoTransforms);
    }
}

#[test]
fn of_a_file_that_is_cut_off_anywhere_nothing_is_made_up() {
    let block = Exif::paris().heading(90.0).orientation(6).write(Order::Big);
    for container in Container::ALL {
        let whole = container.with_exif(&block);
        let complete = read_exif(&whole);
        for length in 0..whole.len() {
            let info = read_exif(&whole[..length]);
            assert!(
                info.location
                    .is_none_or(|place| Some(place) == complete.location)
            );
            let _ = orientation(&whole[..length]);
        }
    }
}

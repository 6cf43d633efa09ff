//! The work that a JPEG may cause is bounded before it is begun.

use crate::jpeg::bits::Bits;
use crate::jpeg::encoder::{Layout, Scan, end_run, segment};
use crate::jpeg::picture::Colours;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, ImageError, decode, load_tensor};

/// A progressive picture whose blocks are all grey, in as few bytes as possible: the means have
/// a code of one bit, and one symbol ends 32,767 blocks.
fn bomb(side: u16, scans: &[Scan]) -> Vec<u8> {
    let mut file = b"\xff\xd8".to_vec();
    file.extend(segment(0xdb, &[&[0][..], &[1; 64]].concat()));
    let mut frame = vec![8];
    frame.extend([side.to_be_bytes(), side.to_be_bytes()].concat());
    frame.extend([3, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0]);
    file.extend(segment(0xc2, &frame));
    let [mut dc, ac] = crate::jpeg::encoder::huffman_tables();
    // One symbol, of one bit.
    dc.truncate(21);
    dc[5..21].fill(0);
    dc[5] = 1;
    dc.push(0);
    dc[3] = dc.len() as u8 - 2;
    file.extend([dc, ac].concat());
    let blocks = u32::from(side).div_ceil(8).pow(2);
    for scan in scans {
        let mut header = vec![scan.components.len() as u8];
        header.extend(
            scan.components
                .iter()
                .flat_map(|&component| [component as u8 + 1, 0]),
        );
        let (high, low) = scan.bits;
        header.extend([
            scan.band.0 as u8,
            scan.band.1 as u8,
            (high << 4 | low) as u8,
        ]);
        file.extend(segment(0xda, &header));
        let mut bits = Bits::default();
        if scan.band.0 == 0 {
            (0..blocks * scan.components.len() as u32).for_each(|_| bits.put(0, 1));
        } else {
            let mut left = blocks;
            while left > 0 {
                let mut run = left.min(0x7fff);
                left -= run;
                end_run(&mut bits, &mut run);
            }
        }
        file.extend(bits.finish());
    }
    file.extend(b"\xff\xd9");
    file
}

/// Scans that build on each other as the standard wants: each coefficient by itself, bit by bit.
fn lawful(count: usize) -> Vec<Scan> {
    let mut scans = vec![Scan::new(&[0, 1, 2], (0, 0), (0, 0))];
    for k in 1..64 {
        for component in 0..3 {
            scans.push(Scan::new(&[component], (k, k), (0, 1)));
            scans.push(Scan::new(&[component], (k, k), (1, 0)));
        }
    }
    scans.truncate(count);
    scans
}

#[test]
fn the_product_of_pixels_and_scans_is_bounded() {
    let config = ImageConfig::default();
    let target = ImageSize {
        width: 448,
        height: 336,
    };
    let file = bomb(8000, &lawful(100));
    assert!(file.len() < 1 << 20, "{} bytes", file.len());
    for refused in [
        decode(&file, &config).map(drop),
        load_tensor(&file, &config, target).map(drop),
    ] {
        let error = refused.unwrap_err();
        assert_eq!(error.code().as_str(), "image_too_large");
        assert_eq!(
            error.to_string(),
            "the image is 8000x8000 in 100 scans, which visit 6528000000 samples; at most \
             1280000000 are accepted"
        );
    }
    // Neither many scans nor many pixels are refused by themselves.
    decode(&bomb(400, &lawful(100)), &config).unwrap();
    decode(&bomb(2000, &lawful(10)), &config).unwrap();
}

#[test]
fn the_limit_is_a_setting_and_counts_samples() {
    let layout = Layout::new(64, 64, Colours::YCbCr).sampled(&[(2, 2), (1, 1), (1, 1)]);
    let samples = 64 * 64 * 3 / 2;
    for (layout, samples) in [
        (layout.clone(), samples),
        (layout.clone().separate(), samples),
        // Both scans of means, and three of each component: its bands and their two bits.
        (layout.progressive(), 6 * samples),
    ] {
        let file = layout.encode();
        let limited = |max_jpeg_samples| ImageConfig {
            max_jpeg_samples,
            ..Default::default()
        };
        decode(&file, &limited(samples)).unwrap();
        let refused = decode(&file, &limited(samples - 1)).unwrap_err();
        assert!(
            matches!(refused, ImageError::TooManyScans { .. }),
            "{refused}"
        );
    }
}

#[test]
fn more_than_a_hundred_scans_are_refused_however_small() {
    let refused = decode(&bomb(8, &lawful(101)), &ImageConfig::default()).unwrap_err();
    assert!(
        refused.to_string().contains("more than 100 scans"),
        "{refused}"
    );
    // Scans that a complete picture does not need count, too.
    let layout = Layout::new(64, 64, Colours::YCbCr);
    let scan = layout.scans().concat();
    let file = |scans: usize| {
        let head = [b"\xff\xd8".as_slice(), &layout.head().concat()].concat();
        [&head[..], &scan.repeat(scans), b"\xff\xd9"].concat()
    };
    decode(&file(100), &ImageConfig::default()).unwrap();
    let refused = decode(&file(101), &ImageConfig::default()).unwrap_err();
    assert!(
        refused.to_string().contains("more than 100 scans"),
        "{refused}"
    );
}

/// Megabytes of tables and metadata that no scan uses are passed over.
#[test]
fn tables_and_metadata_that_nothing_uses_cost_nothing() {
    let layout = Layout::new(64, 64, Colours::YCbCr);
    let [dc, ac] = crate::jpeg::encoder::huffman_tables();
    let profile = segment(
        0xe2,
        &[b"ICC_PROFILE\0\x01\x01".as_slice(), &[7; 60_000]].concat(),
    );
    let quantisers = segment(0xdb, &[&[0][..], &[3; 64]].concat());
    let expected = decode(&layout.encode(), &ImageConfig::default()).unwrap();
    for extra in [
        ac.repeat(20_000),
        dc.repeat(200_000),
        profile.repeat(200),
        quantisers.repeat(80_000),
    ] {
        let file = layout.encode();
        let file = [&file[..2], &extra, &file[2..]].concat();
        assert!(
            file.len() > 4 << 20 && file.len() < 20 << 20,
            "{} bytes",
            file.len()
        );
        assert!(decode(&file, &ImageConfig::default()).unwrap() == expected);
    }
}

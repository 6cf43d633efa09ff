//! Every layout shows its picture, whichever library decodes it.

use crate::jpeg::encoder::{Layout, Scan, progressive, separate};
use crate::jpeg::picture::{Colours, assert_agrees, assert_refused, assert_shows, full};
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{DEVIATION, ImageConfig, MEAN, RgbImage, encode_jpeg, load_tensor};

/// Sizes that are whole units, and sizes that are not.
const SIZES: [(u32, u32); 5] = [(64, 64), (70, 50), (97, 33), (31, 129), (17, 17)];

/// Sampling factors of luma and of both planes of colour.
const SAMPLINGS: [[(u32, u32); 3]; 14] = [
    [(1, 1), (1, 1), (1, 1)],
    [(2, 1), (1, 1), (1, 1)],
    [(1, 2), (1, 1), (1, 1)],
    [(2, 2), (1, 1), (1, 1)],
    [(4, 1), (1, 1), (1, 1)],
    [(1, 4), (1, 1), (1, 1)],
    [(4, 2), (1, 1), (1, 1)],
    [(3, 1), (1, 1), (1, 1)],
    [(2, 2), (2, 1), (2, 1)],
    [(2, 2), (1, 2), (2, 1)],
    [(2, 1), (2, 1), (2, 1)],
    // Luma smaller than the colours.
    [(1, 1), (2, 2), (2, 2)],
    [(1, 1), (2, 1), (1, 1)],
    [(1, 2), (2, 1), (1, 1)],
];

fn every_coding(layout: &Layout) -> Vec<(&'static str, Layout)> {
    let layout = || layout.clone();
    let mut codings = vec![
        ("one scan", layout()),
        ("a scan each", layout().separate()),
        ("progressive", layout().progressive()),
    ];
    if layout().sampling.len() == 3 {
        let scans = vec![
            Scan::new(&[0], (0, 63), (0, 0)),
            Scan::new(&[1, 2], (0, 63), (0, 0)),
        ];
        codings.push(("luma, then colours", Layout { scans, ..layout() }));
    }
    codings
}

fn assert_all_codings_show(layout: &Layout) {
    for (coding, layout) in every_coding(layout) {
        for interval in [0, 1, 3] {
            let layout = layout.clone().restarting(interval);
            let name = format!(
                "{} {:?} {:?}, {coding}, restart {interval}",
                layout.size, layout.colours, layout.sampling
            );
            assert_shows(&layout.encode(), &layout, &name);
        }
    }
}

#[test]
fn colour_pictures_of_every_sampling() {
    for (width, height) in SIZES {
        for sampling in SAMPLINGS {
            let layout = Layout::new(width, height, Colours::YCbCr).sampled(&sampling);
            assert_all_codings_show(&layout);
        }
    }
}

/// In a larger picture a reduction is seen to be exact.
#[test]
fn large_pictures_are_reduced_to_the_same_picture() {
    let target = ImageSize {
        width: 13,
        height: 9,
    };
    for sampling in SAMPLINGS {
        let layout = Layout::new(250, 170, Colours::YCbCr).sampled(&sampling);
        for (coding, layout) in every_coding(&layout) {
            let file = layout.restarting(5).encode();
            let whole = full(&file).unwrap().resized(target).unwrap();
            let tensor = load_tensor(&file, &ImageConfig::default(), target).unwrap();
            let pixels = (target.width * target.height) as usize;
            for (at, value) in tensor.data.iter().enumerate() {
                let (channel, pixel) = (at / pixels, at % pixels);
                let level = (value * DEVIATION[channel] + MEAN[channel]) * 255.0;
                let off = (level - f32::from(whole.pixels[3 * pixel + channel])).abs();
                assert!(
                    off < 24.0,
                    "{sampling:?}, {coding}: pixel {pixel} is off by {off}"
                );
            }
        }
    }
}

#[test]
fn grey_pictures_whatever_their_sampling() {
    for (width, height) in SIZES {
        for sampling in [(1, 1), (2, 1), (2, 2), (1, 4), (3, 3)] {
            let layout = Layout::new(width, height, Colours::Grey).sampled(&[sampling]);
            assert_all_codings_show(&layout);
        }
    }
}

#[test]
fn pictures_of_red_green_and_blue_and_of_inks() {
    for (width, height) in SIZES {
        for colours in [Colours::Rgb, Colours::Cmyk, Colours::Ycck] {
            assert_all_codings_show(&Layout::new(width, height, colours));
        }
        let halved = [(2, 2), (1, 1), (1, 1), (2, 2)];
        assert_all_codings_show(&Layout::new(width, height, Colours::Ycck).sampled(&halved));
    }
}

#[test]
fn pictures_of_one_row_or_column() {
    for (width, height) in [(1, 1), (1, 90), (90, 1), (8, 8), (3, 9)] {
        for sampling in [
            [(1, 1); 3],
            [(2, 2), (1, 1), (1, 1)],
            [(2, 1), (1, 1), (1, 1)],
        ] {
            let layout = Layout::new(width, height, Colours::YCbCr).sampled(&sampling);
            for (coding, layout) in every_coding(&layout) {
                let image = full(&layout.encode()).unwrap_or_else(|error| {
                    panic!("{width}x{height} {sampling:?} {coding}: {error}")
                });
                assert_eq!(image.size, layout.size, "{coding}");
            }
        }
    }
}

#[test]
fn factors_that_divide_all_of_a_picture_of_separate_scans() {
    let layout = Layout::new(70, 50, Colours::YCbCr)
        .sampled(&[(4, 4), (2, 2), (2, 2)])
        .separate();
    assert_shows(&layout.encode(), &layout, "4x4 beside 2x2");
}

#[test]
fn what_cannot_be_enlarged_is_refused_at_every_size() {
    let layout = |sampling: [(u32, u32); 3]| Layout::new(70, 50, Colours::YCbCr).sampled(&sampling);
    let thirds = layout([(3, 1), (2, 1), (1, 1)]);
    for (coding, layout) in every_coding(&thirds) {
        assert_refused(&layout.encode(), "sampling factors", coding);
    }
    let between = layout([(4, 1), (2, 1), (1, 1)]).separate();
    assert_refused(&between.encode(), "4x1, 2x1, 1x1", "between");
    let together = layout([(4, 1), (2, 1), (1, 1)]);
    assert_shows(&together.encode(), &together, "the same in one scan");
    let blocks = layout([(4, 2), (2, 1), (1, 1)]);
    assert_refused(&blocks.encode(), "11 blocks", "too many blocks in a unit");
}

#[test]
fn every_split_of_bands_and_bits() {
    let means = |bits| Scan::new(&[0, 1, 2], (0, 0), bits);
    let each = |band, bits| (0..3).map(move |component| Scan::new(&[component], band, bits));
    let deep: Vec<Scan> = [means((0, 3)), means((3, 2)), means((2, 1)), means((1, 0))]
        .into_iter()
        .chain((1..64).flat_map(|k| each((k, k), (0, 0))).take(60))
        .collect();
    let refined: Vec<Scan> = [means((0, 0))]
        .into_iter()
        .chain(each((1, 63), (0, 3)))
        .chain(each((1, 63), (3, 2)))
        .chain(each((1, 63), (2, 1)))
        .chain(each((1, 63), (1, 0)))
        .collect();
    let means_alone: Vec<Scan> = each((0, 0), (0, 0)).chain(each((1, 63), (0, 0))).collect();
    for (name, scans) in [
        ("deep", deep),
        ("refined", refined),
        ("means alone", means_alone),
    ] {
        for sampling in [[(1, 1); 3], [(2, 2), (1, 1), (1, 1)]] {
            for interval in [0, 2] {
                let layout = Layout {
                    scans: scans.clone(),
                    progressive: true,
                    ..Layout::new(70, 50, Colours::YCbCr).sampled(&sampling)
                };
                let layout = layout.restarting(interval);
                assert_shows(&layout.encode(), &layout, name);
            }
        }
    }
}

#[test]
fn a_progressive_picture_without_its_finest_scans_is_coarser() {
    let layout = Layout::new(70, 50, Colours::YCbCr).progressive();
    for kept in 1..progressive(3).len() {
        let mut layout = layout.clone();
        layout.scans.truncate(kept);
        let file = layout.encode();
        let image = full(&file).unwrap();
        assert_agrees(&file, &image, "coarse");
        // Without the end marker nothing says that the encoder meant it so.
        assert_refused(&file[..file.len() - 2], "end-of-image marker", "coarse");
    }
}

#[test]
fn noise_through_the_longest_codes() {
    // Noise uses codes of all lengths of the standard tables, and every coefficient.
    let mut state = 1u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    let size = ImageSize {
        width: 123,
        height: 77,
    };
    let pixels = (0..123 * 77 * 3).map(|_| random()).collect();
    let noise = RgbImage { size, pixels };
    for quality in [1, 30, 75, 100] {
        let file = encode_jpeg(&noise, quality).unwrap();
        let image = full(&file).unwrap();
        assert_eq!(image.size, size);
        assert_agrees(&file, &image, "noise");
    }
    // At the best quality the encoder loses little besides the detail of the colours.
    let best = full(&encode_jpeg(&noise, 100).unwrap()).unwrap();
    let luma = |rgb: &[u8]| {
        let [r, g, b] = [0, 1, 2].map(|i| f32::from(rgb[i]));
        0.299 * r + 0.587 * g + 0.114 * b
    };
    let pairs = best
        .pixels
        .chunks_exact(3)
        .zip(noise.pixels.chunks_exact(3));
    let off: f32 = pairs.map(|(a, b)| (luma(a) - luma(b)).abs()).sum();
    assert!(
        off / (123.0 * 77.0) < 12.0,
        "off by {} on average",
        off / (123.0 * 77.0)
    );
}

#[test]
fn separate_scans_may_stand_for_one_component_each_only_once() {
    let twice = Layout {
        scans: [separate(3), separate(3)].concat()[..4].to_vec(),
        ..Layout::new(70, 50, Colours::YCbCr)
    };
    // The picture is complete after three scans; viewers ignore the fourth.
    assert_shows(&twice.encode(), &twice, "a scan too many");
    let instead = Layout {
        scans: vec![
            separate(3)[0].clone(),
            separate(3)[0].clone(),
            separate(3)[1].clone(),
        ],
        ..Layout::new(70, 50, Colours::YCbCr)
    };
    assert_refused(
        &instead.encode(),
        "does not continue",
        "luma twice instead of a colour",
    );
}

//! The picture that the tests encode, and how near to it a decoded one comes.

use crate::jpeg::encoder::Layout;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{ImageConfig, ImageError, RgbImage, decode, load_tensor};
use std::f32::consts::TAU;

/// What the components of a picture mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colours {
    Grey,
    YCbCr,
    Rgb,
    /// Four inks, stored inverted as Adobe does.
    Cmyk,
    /// The same, the first three as Y, Cb and Cr.
    Ycck,
}

impl Colours {
    pub fn components(self) -> usize {
        match self {
            Self::Grey => 1,
            Self::YCbCr | Self::Rgb => 3,
            Self::Cmyk | Self::Ycck => 4,
        }
    }
}

/// The value of component `place` at `u`, `v`, which go from 0 to 1 across the picture.
///
/// Each component runs in a direction of its own and so slowly that it does not matter how a
/// decoder enlarges small components. Blocks in the wrong place matter very much.
pub fn value(place: usize, u: f32, v: f32) -> f32 {
    let (across, down) = [(0.55, 0.3), (-0.3, 0.5), (0.4, -0.4), (0.2, 0.5)][place];
    128.0 + 60.0 * (TAU * (across * u + down * v) * 0.8 + place as f32).sin()
}

/// The colour of the picture at `u`, `v`.
fn colour(colours: Colours, u: f32, v: f32) -> [f32; 3] {
    let at = |place| value(place, u, v);
    let from_luma = || {
        let (y, cb, cr) = (at(0), at(1) - 128.0, at(2) - 128.0);
        [
            y + 1.402 * cr,
            y - 0.344_14 * cb - 0.714_14 * cr,
            y + 1.772 * cb,
        ]
        .map(|level| level.clamp(0.0, 255.0))
    };
    match colours {
        Colours::Grey => [at(0); 3],
        Colours::YCbCr => from_luma(),
        Colours::Rgb => [at(0), at(1), at(2)],
        Colours::Cmyk => [0, 1, 2].map(|ink| at(ink) * at(3) / 255.0),
        Colours::Ycck => from_luma().map(|level| (255.0 - level) * at(3) / 255.0),
    }
}

/// Decodes at full size with the default limits.
pub fn full(bytes: &[u8]) -> Result<RgbImage, ImageError> {
    decode(bytes, &ImageConfig::default())
}

/// Decodes for a tensor so small that the decoder may reduce the picture.
pub fn reduced(bytes: &[u8]) -> Result<Vec<f32>, ImageError> {
    let tensor = load_tensor(bytes, &ImageConfig::default(), TINY)?;
    Ok(tensor.data)
}

const TINY: ImageSize = ImageSize {
    width: 2,
    height: 2,
};

/// Checks that `bytes` show the picture, at full size and reduced.
#[track_caller]
pub fn assert_shows(bytes: &[u8], layout: &Layout, name: &str) {
    let image = full(bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
    let ImageSize { width, height } = layout.size;
    assert_eq!(image.size, layout.size, "{name}");
    let mut sum = 0.0;
    for y in 0..height {
        for x in 0..width {
            let u = (x as f32 + 0.5) / width as f32;
            let v = (y as f32 + 0.5) / height as f32;
            let expected = colour(layout.colours, u, v);
            let found = image.pixel(x, y);
            for (expected, found) in expected.iter().zip(found) {
                let off = (expected - f32::from(found)).abs();
                // The last samples of a small component lie beyond the picture.
                assert!(off < 32.0, "{name}: {found} at {x},{y} is off by {off}");
                sum += off;
            }
        }
    }
    let mean = sum / (3 * width * height) as f32;
    // A plane of a quarter of the rows has hardly five in the smallest pictures.
    let most = if width.min(height) < 20 { 8.0 } else { 5.0 };
    assert!(mean < most, "{name}: off by {mean} on average");
    assert_agrees(bytes, &image, name);
}

/// Checks that the reduced picture looks like the whole one.
///
/// A reduced picture is a whole number of pixels, so it goes a little beyond one whose sides are no
/// multiples of the reduction. In small pictures that shows, and in tiny ones nothing else does.
#[track_caller]
pub fn assert_agrees(bytes: &[u8], image: &RgbImage, name: &str) {
    let tensor = reduced(bytes).unwrap_or_else(|error| panic!("{name}, reduced: {error}"));
    let small = image.resized(TINY).unwrap();
    let ImageSize { width, height } = image.size;
    let is_whole = width.is_multiple_of(8) && height.is_multiple_of(8);
    if !is_whole && width.min(height) < 48 {
        return;
    }
    let most = if is_whole { 8.0 } else { 40.0 };
    for (at, value) in tensor.iter().enumerate() {
        let (channel, pixel) = (at / 4, at % 4);
        let mean = placeformer_vision::image::MEAN[channel];
        let deviation = placeformer_vision::image::DEVIATION[channel];
        let level = (value * deviation + mean) * 255.0;
        let off = (level - f32::from(small.pixels[3 * pixel + channel])).abs();
        assert!(
            off < most,
            "{name}: reduced, channel {channel} is off by {off}"
        );
    }
}

/// Checks that `bytes` are refused at every size with an error that contains `cause`.
#[track_caller]
pub fn assert_refused(bytes: &[u8], cause: &str, name: &str) {
    for refused in [full(bytes).map(drop), reduced(bytes).map(drop)] {
        let error = refused.err().unwrap_or_else(|| panic!("{name} was taken"));
        assert_eq!(
            error.code().as_str(),
            "image_undecodable",
            "{name}: {error}"
        );
        assert!(error.to_string().contains(cause), "{name}: {error}");
    }
}

/// Whether `bytes` are taken; the same at every size.
#[track_caller]
pub fn is_taken(bytes: &[u8], name: &str) -> bool {
    let (whole, small) = (full(bytes), reduced(bytes));
    assert_eq!(
        whole.is_ok(),
        small.is_ok(),
        "{name}: {:?} {:?}",
        whole.err(),
        small.err()
    );
    whole.is_ok()
}

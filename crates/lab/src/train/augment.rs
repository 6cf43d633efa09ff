//! Variation of training images: light, colour, and the small shifts of viewpoint that a vehicle's
//! next pass brings.
//!
//! Works on normalised tensors, so that decoding and resizing are those of inference. Never
//! mirrors: a mirrored street is another place.

use super::error::TrainError;
use placeformer_core::types::ImageTensor;
use placeformer_vision::image::{DEVIATION, MEAN};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Luma weights of ITU-R BT.601.
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];

/// Strength of each variation; zero switches it off.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Augmentation {
    /// Brightness factor within 1 +- this.
    pub brightness: f32,
    /// Contrast factor within 1 +- this.
    pub contrast: f32,
    /// Saturation factor within 1 +- this.
    pub saturation: f32,
    /// Corners of the view move by up to this share of the sides (perspective, zoom, shift and turn
    /// at once).
    pub viewpoint: f32,
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            brightness: 0.3,
            contrast: 0.3,
            saturation: 0.3,
            viewpoint: 0.08,
        }
    }
}

impl Augmentation {
    /// No variation at all.
    pub const NONE: Self = Self {
        brightness: 0.0,
        contrast: 0.0,
        saturation: 0.0,
        viewpoint: 0.0,
    };

    /// Whether any variation is on.
    pub fn enabled(&self) -> bool {
        *self != Self::NONE
    }

    pub(super) fn check(&self) -> Result<(), TrainError> {
        let shares = [
            self.brightness,
            self.contrast,
            self.saturation,
            self.viewpoint,
        ];
        // Corners that move by a quarter of a side or more could cross.
        if shares.iter().all(|share| (0.0..1.0).contains(share)) && self.viewpoint < 0.25 {
            Ok(())
        } else {
            Err(TrainError::Setting(format!(
                "augmentation strengths must lie in [0, 1), viewpoint in [0, 0.25): {self:?}"
            )))
        }
    }
}

/// A variation of `image` decided by `seed` alone.
pub fn augment(image: &ImageTensor, strength: &Augmentation, seed: u64) -> ImageTensor {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut around_one = |share: f32| {
        if share > 0.0 {
            rng.random_range(1.0 - share..=1.0 + share)
        } else {
            1.0
        }
    };
    let brightness = around_one(strength.brightness);
    let contrast = around_one(strength.contrast);
    let saturation = around_one(strength.saturation);
    let mut varied = match strength.viewpoint {
        share if share > 0.0 => {
            let mut shift = || rng.random_range(-share..=share);
            let shifts = std::array::from_fn(|_| [shift(), shift()]);
            warp(image, &shifts)
        }
        _ => image.clone(),
    };
    recolour(&mut varied, brightness, contrast, saturation);
    varied
}

/// Brightness, contrast and saturation in the [0, 1] colours behind the normalised values.
fn recolour(image: &mut ImageTensor, brightness: f32, contrast: f32, saturation: f32) {
    let pixels = image.size.width as usize * image.size.height as usize;
    let colour = |data: &[f32], channel: usize, pixel: usize| {
        data[channel * pixels + pixel] * DEVIATION[channel] + MEAN[channel]
    };
    let luma = |data: &[f32], pixel: usize| {
        (0..3)
            .map(|c| LUMA[c] * colour(data, c, pixel))
            .sum::<f32>()
    };
    let mean_luma = brightness
        * (0..pixels)
            .map(|pixel| luma(&image.data, pixel))
            .sum::<f32>()
        / pixels as f32;
    for pixel in 0..pixels {
        let grey = brightness * luma(&image.data, pixel);
        for channel in 0..3 {
            let bright = brightness * colour(&image.data, channel, pixel);
            let saturated = grey + saturation * (bright - grey);
            let value = (mean_luma + contrast * (saturated - mean_luma)).clamp(0.0, 1.0);
            image.data[channel * pixels + pixel] = (value - MEAN[channel]) / DEVIATION[channel];
        }
    }
}

/// Looks at `image` through a window whose corners are shifted by shares of the sides (top left,
/// top right, bottom right, bottom left); beyond the border the edge is repeated.
fn warp(image: &ImageTensor, shifts: &[[f32; 2]; 4]) -> ImageTensor {
    let width = image.size.width as usize;
    let height = image.size.height as usize;
    let w = width as f32 - 1.0;
    let h = height as f32 - 1.0;
    let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let corners: [[f32; 2]; 4] = std::array::from_fn(|i| {
        [
            (square[i][0] + shifts[i][0]) * w,
            (square[i][1] + shifts[i][1]) * h,
        ]
    });
    let map = square_to_quad(&corners);
    let mut data = vec![0.0; image.data.len()];
    for y in 0..height {
        for x in 0..width {
            let u = x as f32 / w.max(1.0);
            let v = y as f32 / h.max(1.0);
            let scale = map[6] * u + map[7] * v + 1.0;
            let source_x = ((map[0] * u + map[1] * v + map[2]) / scale).clamp(0.0, w);
            let source_y = ((map[3] * u + map[4] * v + map[5]) / scale).clamp(0.0, h);
            let left = source_x as usize;
            let top = source_y as usize;
            let right = (left + 1).min(width - 1);
            let bottom = (top + 1).min(height - 1);
            let fx = source_x - left as f32;
            let fy = source_y - top as f32;
            for plane in 0..3 {
                let at =
                    |row: usize, column: usize| image.data[(plane * height + row) * width + column];
                let upper = at(top, left) * (1.0 - fx) + at(top, right) * fx;
                let lower = at(bottom, left) * (1.0 - fx) + at(bottom, right) * fx;
                data[(plane * height + y) * width + x] = upper * (1.0 - fy) + lower * fy;
            }
        }
    }
    ImageTensor {
        size: image.size,
        data,
    }
}

/// The homography (h33 = 1) that takes the unit square's corners to a convex quadrilateral
/// (Heckbert, 1989).
fn square_to_quad(quad: &[[f32; 2]; 4]) -> [f32; 8] {
    let [[x0, y0], [x1, y1], [x2, y2], [x3, y3]] = *quad;
    let dx1 = x1 - x2;
    let dx2 = x3 - x2;
    let dx3 = x0 - x1 + x2 - x3;
    let dy1 = y1 - y2;
    let dy2 = y3 - y2;
    let dy3 = y0 - y1 + y2 - y3;
    let determinant = dx1 * dy2 - dx2 * dy1;
    let g = (dx3 * dy2 - dx2 * dy3) / determinant;
    let h = (dx1 * dy3 - dx3 * dy1) / determinant;
    [
        x1 - x0 + g * x1,
        x3 - x0 + h * x3,
        x0,
        y1 - y0 + g * y1,
        y3 - y0 + h * y3,
        y0,
        g,
        h,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::ImageSize;

    /// A tensor whose planes hold the column, the row and a constant, in colours from 0 to 1.
    fn ramp() -> ImageTensor {
        let width = 16usize;
        let height = 12usize;
        let mut data = Vec::new();
        for plane in 0..3 {
            for y in 0..height {
                for x in 0..width {
                    let value = [x as f32 / 15.0, y as f32 / 11.0, 0.5][plane];
                    data.push((value - MEAN[plane]) / DEVIATION[plane]);
                }
            }
        }
        ImageTensor {
            size: ImageSize {
                width: 16,
                height: 12,
            },
            data,
        }
    }

    #[test]
    fn no_strength_changes_nothing_and_a_seed_repeats() {
        let image = ramp();
        let same = augment(&image, &Augmentation::NONE, 7);
        assert!(
            same.data
                .iter()
                .zip(&image.data)
                .all(|(a, b)| (a - b).abs() < 1e-5)
        );
        let strength = Augmentation::default();
        assert_eq!(augment(&image, &strength, 7), augment(&image, &strength, 7));
        assert_ne!(augment(&image, &strength, 7), augment(&image, &strength, 8));
    }

    #[test]
    fn unmoved_corners_leave_the_picture_and_moved_ones_shift_it() {
        let image = ramp();
        let still = warp(&image, &[[0.0; 2]; 4]);
        assert!(
            still
                .data
                .iter()
                .zip(&image.data)
                .all(|(a, b)| (a - b).abs() < 1e-4)
        );
        // All corners one column to the right: every pixel shows its right neighbour.
        let moved = warp(&image, &[[1.0 / 15.0, 0.0]; 4]);
        assert!((moved.data[16 * 3 + 4] - image.data[16 * 3 + 5]).abs() < 1e-4);
    }

    #[test]
    fn colours_stay_colours() {
        let strength = Augmentation {
            brightness: 0.9,
            contrast: 0.9,
            saturation: 0.9,
            viewpoint: 0.2,
        };
        for seed in 0..20 {
            let varied = augment(&ramp(), &strength, seed);
            for (plane, values) in varied.data.chunks(16 * 12).enumerate() {
                let colours = values.iter().map(|v| v * DEVIATION[plane] + MEAN[plane]);
                assert!(
                    colours
                        .into_iter()
                        .all(|colour| (-1e-4..=1.0001).contains(&colour))
                );
            }
        }
    }
}

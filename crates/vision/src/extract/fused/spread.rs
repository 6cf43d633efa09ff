//! How far the inputs of each linear layer stray, channel by channel: what int8 needs to know to be
//! exact.
//!
//! A row's codes share one factor, which its largest number decides. A few channels of a
//! transformer lie far from zero, nearly the same in every token, and leave the others few codes.
//! What a channel is on average is therefore taken off before rounding, and what it strays by is
//! evened out between the input and the weights (as SmoothQuant does, Xiao et al. 2023); both are
//! made good in weights and biases when they are packed.
//!
//! Which channels those are is the model's affair and hardly the picture's: a rough drawing of a
//! street, seen once while the model is loaded, tells as much as photographs do.

use crate::extract::encoder::EncoderSpec;
use crate::extract::error::ExtractError;
use crate::extract::vit::{BlockLayer, CandleEncoder};
use crate::extract::weights::{Norm, VitWeights};
use half::bf16;
use placeformer_core::types::{ImageSize, ImageTensor};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Columns and rows of patches of the picture: enough for averages over tokens.
const PATCHES: (usize, usize) = (16, 12);

/// Channels that hardly stray are taken to stray by this share of the median at least.
const LEAST_SPREAD: f32 = 0.1;

/// Where the channels of a layer's input lie, `[in]` each. The layer multiplies `(input - centre) /
/// scale`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Spread {
    pub centre: Vec<f32>,
    pub scale: Vec<f32>,
}

/// The inputs of a block's layers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct BlockSpread {
    pub qkv: Spread,
    pub proj: Spread,
    pub fc1: Spread,
    pub fc2: Spread,
}

/// The spreads of the first `blocks` blocks, if any.
///
/// # Errors
/// Those of the plain encoder, which looks at the picture.
pub(super) fn measure(
    weights: &VitWeights,
    blocks: usize,
) -> Result<Vec<BlockSpread>, ExtractError> {
    if blocks == 0 {
        return Ok(Vec::new());
    }
    let side = weights.geometry.patch;
    let size = ImageSize {
        width: (PATCHES.0 * side) as u32,
        height: (PATCHES.1 * side) as u32,
    };
    let last = blocks - 1;
    let spec = EncoderSpec {
        input_size: size,
        exit_block: last,
        token_norm: false,
        attention_block: last,
    };
    let mut found: [Vec<Spread>; 4] = Default::default();
    CandleEncoder::new(weights, &spec)?.record_inputs(&street(size), &mut |layer, inputs| {
        let width = if layer == BlockLayer::Fc2 {
            weights.geometry.mlp_dim
        } else {
            weights.geometry.dim
        };
        found[layer as usize].push(Spread::of(inputs, width, evened_out(layer)));
    })?;
    let [qkv, proj, fc1, fc2] = found;
    let layers = qkv.into_iter().zip(proj).zip(fc1).zip(fc2);
    Ok(layers
        .map(|(((qkv, proj), fc1), fc2)| BlockSpread {
            qkv,
            proj,
            fc1,
            fc2,
        })
        .collect())
}

/// The power of a channel's spread that goes into the weights. Where tokens were least exact on
/// photographs: the inputs of fc1 have channels that stray far, and large weights nowhere near as
/// far.
fn evened_out(layer: BlockLayer) -> f32 {
    if layer == BlockLayer::Fc1 { 0.5 } else { 0.25 }
}

impl Spread {
    /// What brings the input back: times the scale, plus the centre.
    pub fn undone(&self) -> Norm {
        Norm {
            weight: self.scale.clone(),
            bias: self.centre.clone(),
        }
    }

    /// Of rows of `width` numbers.
    fn of(rows: &[f32], width: usize, power: f32) -> Self {
        let count = (rows.len() / width) as f64;
        let (mut sums, mut squares) = (vec![0f64; width], vec![0f64; width]);
        for row in rows.chunks_exact(width) {
            for ((sum, square), &value) in sums.iter_mut().zip(&mut squares).zip(row) {
                *sum += f64::from(value);
                *square += f64::from(value).powi(2);
            }
        }
        let centre = sums
            .iter()
            .map(|sum| coarse((sum / count) as f32))
            .collect();
        let deviation = |(square, sum): (&f64, &f64)| {
            (square / count - (sum / count).powi(2)).max(0.0).sqrt() as f32
        };
        let deviations: Vec<f32> = squares.iter().zip(&sums).map(deviation).collect();
        let mut sorted = deviations.clone();
        sorted.sort_by(f32::total_cmp);
        let least = (LEAST_SPREAD * sorted[width / 2]).max(f32::MIN_POSITIVE);
        Self {
            centre,
            scale: deviations
                .iter()
                .map(|spread| coarse(spread.max(least).powf(power)))
                .collect(),
        }
    }
}

/// Rounded so far that the last bits, in which machines differ, seldom show.
fn coarse(value: f32) -> f32 {
    bf16::from_f32(value).to_f32()
}

/// A rough street: sky, road, houses with windows, a few things in front. Normalised as photographs
/// are.
fn street(size: ImageSize) -> ImageTensor {
    let (width, height) = (size.width as usize, size.height as usize);
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut picture = ImageTensor {
        size,
        data: vec![0.0; 3 * width * height],
    };
    let horizon = height * 3 / 5;
    for (top, bottom, colour) in [
        (0, horizon, [0.3, 1.0, 1.9]),
        (horizon, height, [-0.6, -0.5, -0.3]),
    ] {
        fill(&mut picture, (0, width), (top, bottom), colour);
    }
    let mut left = 0;
    while left < width {
        let right = (left + random.random_range(width / 7..width / 3)).min(width);
        let top = random.random_range(height / 10..height / 3);
        let colour: [f32; 3] = std::array::from_fn(|_| random.random_range(-1.0..1.2));
        fill(
            &mut picture,
            (left, right),
            (top, horizon + random.random_range(0..height / 12)),
            colour,
        );
        let (across, down) = (random.random_range(12..26), random.random_range(14..30));
        for y in (top + 6..horizon.saturating_sub(down)).step_by(down) {
            for x in (left + 4..right.saturating_sub(across)).step_by(across) {
                let dark = random.random_range(-1.6..-0.6);
                fill(
                    &mut picture,
                    (x, x + across * 3 / 5),
                    (y, y + down * 3 / 5),
                    [dark; 3],
                );
            }
        }
        left = right;
    }
    for _ in 0..6 {
        let left = random.random_range(0..width);
        let right = (left + random.random_range(3..40)).min(width);
        let rows = (
            horizon - random.random_range(5..height / 3),
            horizon + random.random_range(5..height / 4),
        );
        fill(
            &mut picture,
            (left, right),
            rows,
            std::array::from_fn(|_| random.random_range(-2.0..2.2)),
        );
    }
    picture
        .data
        .iter_mut()
        .for_each(|value| *value += random.random_range(-0.2..0.2));
    picture
}

/// Paints columns `left..right` of rows `top..bottom`.
fn fill(
    picture: &mut ImageTensor,
    (left, right): (usize, usize),
    (top, bottom): (usize, usize),
    colour: [f32; 3],
) {
    let (width, height) = (picture.size.width as usize, picture.size.height as usize);
    for (plane, value) in picture.data.chunks_exact_mut(width * height).zip(colour) {
        for row in plane.chunks_exact_mut(width).take(bottom).skip(top) {
            row[left..right].fill(value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_is_the_mean_and_a_power_of_the_deviation() {
        // Deviations 4, 1 and 0: the last counts as a tenth of the median.
        let rows = [[104.0, 1.0, 7.0], [96.0, 3.0, 7.0]];
        let Spread { centre, scale } = Spread::of(rows.as_flattened(), 3, 0.5);
        assert_eq!(centre, [100.0, 2.0, 7.0]);
        assert_eq!(scale, [2.0, 1.0, coarse(0.1f32.sqrt())]);
    }

    #[test]
    fn channels_that_never_move_are_scaled_by_something() {
        let Spread { centre, scale } = Spread::of(&[3.0, 0.0, 3.0, 0.0], 2, 0.25);
        assert_eq!(centre, [3.0, 0.0]);
        assert!(
            scale
                .iter()
                .all(|&scale| scale > 0.0 && (3.0 / scale).is_finite()),
            "{scale:?}"
        );
    }

    #[test]
    fn the_street_fills_pictures_of_every_patch_size() {
        for side in [14, 16, 32] {
            let size = ImageSize {
                width: PATCHES.0 as u32 * side,
                height: PATCHES.1 as u32 * side,
            };
            let picture = street(size);
            assert_eq!(picture.data.len(), 3 * (size.width * size.height) as usize);
            assert!(picture.data.iter().all(|value| value.abs() < 2.5));
            let patches: std::collections::HashSet<u32> = picture
                .data
                .chunks_exact(side as usize)
                .map(|row| row[0].to_bits())
                .collect();
            assert!(patches.len() > 1000, "only {} different", patches.len());
        }
    }
}

//! Per-channel centres and scales that keep int8 products exact.
//!
//! The int8 codes of a row share one scale factor, which follows from the largest value of the row.
//! In a transformer a few channels lie far from zero, with nearly the same value in every token,
//! and leave only a few of the 255 codes to all others. Two things help. The mean of a channel is
//! subtracted before rounding. And where the values of a channel vary much more than those of
//! others, a part of that spread is moved from the input into the weights, as in SmoothQuant (Xiao
//! et al. 2023). Weights and biases undo both when they are packed.
//!
//! Which channels need this depends on the model and hardly on the image. So the statistics come
//! from one synthetic picture ([`super::street`]), encoded once while the model is loaded. That
//! serves as well as photographs do.

use super::street;
use crate::extract::encoder::EncoderSpec;
use crate::extract::error::ExtractError;
use crate::extract::vit::{BlockLayer, CandleEncoder};
use crate::extract::weights::{Norm, VitWeights};
use half::bf16;
use placeformer_core::types::ImageSize;

/// Width of the picture in patches. With the height it gives enough tokens for stable averages.
const PATCH_COLUMNS: usize = 16;

/// Height of the picture in patches.
const PATCH_ROWS: usize = 12;

/// A channel's deviation counts as at least this share of the median deviation, so that a nearly
/// constant channel is not scaled up without bound.
const LEAST_DEVIATION: f32 = 0.1;

/// Centre and scale of each input channel of a layer, `[in]` each. The packed layer is multiplied
/// by `(input - centre) / scale`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Smoothing {
    pub centre: Vec<f32>,
    pub scale: Vec<f32>,
}

/// The smoothing of the inputs of a block's four layers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct BlockSmoothing {
    pub qkv: Smoothing,
    pub proj: Smoothing,
    pub fc1: Smoothing,
    pub fc2: Smoothing,
}

/// Measures the smoothing of the first `blocks` blocks.
///
/// # Errors
/// Those of [`CandleEncoder`], which encodes the picture.
pub(super) fn measure(
    weights: &VitWeights,
    blocks: usize,
) -> Result<Vec<BlockSmoothing>, ExtractError> {
    if blocks == 0 {
        return Ok(Vec::new());
    }
    let geometry = weights.geometry;
    let size = ImageSize {
        width: (PATCH_COLUMNS * geometry.patch) as u32,
        height: (PATCH_ROWS * geometry.patch) as u32,
    };
    let last = blocks - 1;
    let spec = EncoderSpec {
        input_size: size,
        exit_block: last,
        token_norm: false,
        attention_block: last,
    };

    let [mut qkv, mut proj, mut fc1, mut fc2] = [const { Vec::new() }; 4];
    let encoder = CandleEncoder::new(weights, &spec)?;
    encoder.record_inputs(&street::draw(size), &mut |layer, inputs| {
        let (found, width) = match layer {
            BlockLayer::Qkv => (&mut qkv, geometry.dim),
            BlockLayer::Proj => (&mut proj, geometry.dim),
            BlockLayer::Fc1 => (&mut fc1, geometry.dim),
            BlockLayer::Fc2 => (&mut fc2, geometry.mlp_dim),
        };
        found.push(Smoothing::of(inputs, width, smoothing_power(layer)));
    })?;

    let layers = qkv.into_iter().zip(proj).zip(fc1).zip(fc2);
    let blocks = layers.map(|(((qkv, proj), fc1), fc2)| BlockSmoothing {
        qkv,
        proj,
        fc1,
        fc2,
    });
    Ok(blocks.collect())
}

/// The power of a channel's deviation that is moved into the weights.
///
/// Chosen on photographs for the most exact tokens. It is higher for fc1, because the channels of
/// its inputs differ far more than its weights do.
fn smoothing_power(layer: BlockLayer) -> f32 {
    match layer {
        BlockLayer::Fc1 => 0.5,
        BlockLayer::Qkv | BlockLayer::Proj | BlockLayer::Fc2 => 0.25,
    }
}

impl Smoothing {
    /// Measures `rows`, `[n, width]`.
    fn of(rows: &[f32], width: usize, power: f32) -> Self {
        let count = (rows.len() / width) as f64;
        let mut sums = vec![0f64; width];
        let mut squares = vec![0f64; width];
        for row in rows.chunks_exact(width) {
            for (channel, &value) in row.iter().enumerate() {
                sums[channel] += f64::from(value);
                squares[channel] += f64::from(value).powi(2);
            }
        }

        let mut centre = Vec::with_capacity(width);
        let mut deviations = Vec::with_capacity(width);
        for (sum, square) in sums.iter().zip(&squares) {
            let variance = square / count - (sum / count).powi(2);
            centre.push(coarse((sum / count) as f32));
            deviations.push(variance.max(0.0).sqrt() as f32);
        }
        let least = (LEAST_DEVIATION * median(&deviations)).max(f32::MIN_POSITIVE);
        let scale = deviations
            .iter()
            .map(|deviation| coarse(deviation.max(least).powf(power)))
            .collect();
        Self { centre, scale }
    }

    /// Centre and scale of each channel.
    pub fn channels(&self) -> impl Iterator<Item = (f32, f32)> {
        self.centre.iter().copied().zip(self.scale.iter().copied())
    }

    /// What restores an input from its smoothed form: times the scale, plus the centre.
    pub fn inverse(&self) -> Norm {
        Norm {
            weight: self.scale.clone(),
            bias: self.centre.clone(),
        }
    }
}

fn median(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    sorted[sorted.len() / 2]
}

/// Rounds to the 8 significant bits of bf16. The last bits of the statistics differ between
/// machines; after rounding they seldom matter.
fn coarse(value: f32) -> f32 {
    bf16::from_f32(value).to_f32()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_is_the_mean_and_a_power_of_the_deviation() {
        // Deviations 4, 1 and 0: the last counts as a tenth of the median.
        let rows = [[104.0, 1.0, 7.0], [96.0, 3.0, 7.0]];
        let Smoothing { centre, scale } = Smoothing::of(rows.as_flattened(), 3, 0.5);
        assert_eq!(centre, [100.0, 2.0, 7.0]);
        assert_eq!(scale, [2.0, 1.0, coarse(0.1f32.sqrt())]);
    }

    #[test]
    fn constant_channels_get_a_usable_scale() {
        let Smoothing { centre, scale } = Smoothing::of(&[3.0, 0.0, 3.0, 0.0], 2, 0.25);
        assert_eq!(centre, [3.0, 0.0]);
        let is_usable = |scale: f32| scale > 0.0 && (3.0 / scale).is_finite();
        assert!(scale.iter().all(|&scale| is_usable(scale)), "{scale:?}");
    }
}

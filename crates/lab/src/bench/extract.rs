//! The rows of the transformer, in each precision.

use super::context::{Bench, agree};
use super::error::BenchError;
use super::limits::Limits;
use super::measure::{median, paired};
use super::row::BenchRow;
use super::scenes::street;
use super::streets::REFERENCE_SIZE;
use placeformer_vision::extract::{
    CandleEncoder, Encoder, EncoderSpec, Geometry, Precision, build_encoder,
};

impl Bench<'_> {
    /// Milliseconds to encode one image of a batch; the baseline is candle in f32.
    pub(super) fn extract(
        &self,
        name: &str,
        precision: Precision,
        batch: usize,
    ) -> Result<BenchRow, BenchError> {
        let ours = build_encoder(&self.weights, &self.spec, precision)?;
        let plain = CandleEncoder::new(&self.weights, &self.spec)?;
        let mut images = Vec::new();
        for place in 0..batch as u64 {
            images.push(self.tensor(&street(place, 0, REFERENCE_SIZE)?)?);
        }
        let our_tokens = ours.encode(&images[..1])?;
        let plain_tokens = plain.encode(&images[..1])?;
        let dim = self.weights.geometry.dim;
        let cosine = median_cosine(&our_tokens[0].tokens, &plain_tokens[0].tokens, dim);
        agree("extract", cosine > 0.995, || {
            format!("the tokens' cosine is {cosine}")
        })?;

        let (ours_ms, plain_ms) = paired(
            self.rounds,
            || ours.encode(&images),
            || plain.encode(&images),
        );
        let times = (ours_ms / batch as f64, plain_ms / batch as f64);
        let limit = self.encode_limit_ms(&ours.name());
        let baseline = format!("candle f32 (ours: {})", ours.name());
        BenchRow::new(name, &baseline, times, limit)
    }

    /// Milliseconds that an encoder of this name takes for one image at least.
    pub(super) fn encode_limit_ms(&self, encoder: &str) -> f64 {
        let blocks = self.spec.blocks();
        let operations = encoder_operations(&self.weights.geometry, &self.spec);
        let (of_layers, of_attention) = self.limits.encoder_giga_operations(encoder, blocks);
        Limits::milliseconds(operations.linear, of_layers)
            + Limits::milliseconds(operations.attention, of_attention)
    }
}

/// Median cosine of corresponding rows, each `dim` values long.
fn median_cosine(a: &[f32], b: &[f32], dim: usize) -> f64 {
    let dot = |a: &[f32], b: &[f32]| {
        a.iter()
            .zip(b)
            .map(|(a, b)| f64::from(*a) * f64::from(*b))
            .sum::<f64>()
    };
    let rows = a.chunks_exact(dim).zip(b.chunks_exact(dim));
    let cosines = rows.map(|(a, b)| dot(a, b) / (dot(a, a) * dot(b, b)).sqrt());
    median(cosines.collect())
}

/// Multiply-adds of one image, each counted as two operations.
struct EncoderOperations {
    linear: f64,
    attention: f64,
}

/// What the transformer computes up to its last block.
fn encoder_operations(geometry: &Geometry, spec: &EncoderSpec) -> EncoderOperations {
    let (columns, rows) = geometry.grid(spec.input_size);
    let dim = geometry.dim as f64;
    let patches = (columns * rows) as f64;
    let tokens = patches + 1.0;
    let embedding = patches * (3 * geometry.patch * geometry.patch) as f64 * dim;
    let linear = tokens * dim * (4.0 * dim + 2.0 * geometry.mlp_dim as f64);
    let attention = 2.0 * tokens * tokens * dim;
    let blocks = 2.0 * spec.blocks() as f64;
    EncoderOperations {
        linear: 2.0 * embedding + blocks * linear,
        attention: blocks * attention,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::ImageSize;
    use placeformer_vision::extract::Preset;

    #[test]
    fn operations_are_those_of_the_published_model() {
        let preset = Preset::Dinov2Vits14;
        let whole = EncoderSpec {
            input_size: ImageSize {
                width: 224,
                height: 224,
            },
            exit_block: 11,
            token_norm: true,
            attention_block: 11,
        };
        // 257 tokens, 12 blocks: 11.0 GFLOP of linear layers, 1.2 of attention, 0.1 of the
        // embedding.
        let EncoderOperations {
            linear: layers,
            attention,
        } = encoder_operations(&preset.geometry(), &whole);
        assert!(
            (10.9e9..11.3e9).contains(&layers) && (1.1e9..1.3e9).contains(&attention),
            "{layers} {attention}"
        );
    }
}

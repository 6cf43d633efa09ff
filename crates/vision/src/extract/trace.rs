//! Every intermediate of one image, named as in the golden files where they hold the same thing.

use super::encoder::{EncodedImage, EncoderSpec};
use placeformer_core::types::{ImageTensor, KeyPatches, PatchGrid};

/// Every intermediate of one image.
#[derive(Debug, Clone, PartialEq)]
pub struct ExtractionTrace {
    /// What the transformer was asked to compute.
    pub spec: EncoderSpec,
    /// Blocks of the whole backbone.
    pub depth: usize,
    /// The input.
    pub image: ImageTensor,
    /// Interpolated positions, CLS first, `[1 + n, d]`.
    pub positions: Vec<f32>,
    /// Tokens and CLS attention per head.
    pub encoded: EncodedImage,
    /// CLS attention summed over heads, in multiples of the uniform level, `[n]`.
    pub attention: Vec<f32>,
    /// How the tokens were pooled: `mean`, `gem` or `vlad`.
    pub pooling: &'static str,
    /// Pooled tokens, L2-normalised: `[d]`, or `[words * d]` of a VLAD.
    pub pooled: Vec<f32>,
    /// Global descriptor: `[256]`, or `pooled` where there is no head.
    pub global: Vec<f32>,
    /// Key patches at three scales, in full precision.
    pub key_patches: KeyPatches,
}

/// One named array of a trace.
#[derive(Debug, Clone, PartialEq)]
pub struct TraceArray {
    /// Its name.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its values.
    pub values: TraceValues,
}

/// Values of a trace array.
#[derive(Debug, Clone, PartialEq)]
pub enum TraceValues {
    /// Floats.
    F32(Vec<f32>),
    /// Indices.
    I64(Vec<i64>),
}

impl ExtractionTrace {
    /// The grid the key patches index.
    pub fn grid(&self) -> PatchGrid {
        self.key_patches.grid
    }

    /// All intermediates as named arrays, in the order in which they are computed.
    pub fn arrays(&self) -> Vec<TraceArray> {
        let (n, dim, heads) = (
            self.encoded.grid.len(),
            self.encoded.dim,
            self.encoded.heads,
        );
        let size = self.image.size;
        let last = |block: usize| block + 1 == self.depth;
        let norm = if self.spec.token_norm {
            "normed"
        } else {
            "prenorm"
        };
        let (exit, tag) = match self.spec.exit_block {
            block if last(block) => (format!("last_tokens_{norm}"), "last".to_owned()),
            block if self.spec.token_norm => (
                format!("block{block}_tokens_normed"),
                format!("exit{block}_normed"),
            ),
            block => (format!("block{block}_tokens"), format!("exit{block}")),
        };
        let attention = match self.spec.attention_block {
            block if last(block) => "last".to_owned(),
            block => format!("block{block}"),
        };
        let floats = |name: String, shape: &[usize], values: &[f32]| TraceArray {
            name,
            shape: shape.to_vec(),
            values: TraceValues::F32(values.to_vec()),
        };
        let integers = |name: String, values: Vec<i64>| TraceArray {
            name,
            shape: vec![values.len()],
            values: TraceValues::I64(values),
        };
        let tokens = [&self.encoded.cls_token[..], &self.encoded.tokens[..]].concat();
        let mut all = vec![
            floats(
                "pixels".into(),
                &[3, size.height as usize, size.width as usize],
                &self.image.data,
            ),
            integers("rows".into(), (0..=n as i64).collect()),
            floats("positions_rows".into(), &[1 + n, dim], &self.positions),
            floats(format!("{exit}_rows"), &[1 + n, dim], &tokens),
            floats(
                format!("cls_attention_{attention}_heads"),
                &[heads, n],
                &self.encoded.cls_attention,
            ),
            floats(
                "attention_map".into(),
                &[self.encoded.grid.rows, self.encoded.grid.columns],
                &self.attention,
            ),
            floats(
                format!("global_{}_{}_l2", self.pooling, exit.replace("_tokens", "")),
                &[self.pooled.len()],
                &self.pooled,
            ),
            floats("global".into(), &[self.global.len()], &self.global),
        ];
        for (scale, keys) in (1..).zip(&self.key_patches.scales) {
            let m = keys.index.len();
            let centres: Vec<f32> = keys
                .index
                .iter()
                .flat_map(|&i| self.grid().centre(scale, i as usize))
                .collect();
            all.push(integers(
                format!("{tag}_key{scale}_index"),
                keys.index.iter().map(|&i| i as i64).collect(),
            ));
            all.push(floats(
                format!("{tag}_key{scale}_attention"),
                &[m],
                &keys.attention,
            ));
            all.push(floats(
                format!("{tag}_key{scale}_centre_xy"),
                &[m, 2],
                &centres,
            ));
            all.push(floats(
                format!("{tag}_key{scale}_descriptor"),
                &[m, dim],
                &keys.descriptors,
            ));
        }
        all
    }
}

//! Every intermediate result of one image, for comparing with the reference implementation.
//!
//! Arrays have the names that the golden files of the reference implementation give them.

use super::encoder::{EncodedImage, EncoderSpec};
use placeformer_core::types::{ImageTensor, KeyPatches, PatchGrid, ScaleKeyPatches};

/// Every intermediate result of one image, from the input to the key patches.
#[derive(Debug, Clone, PartialEq)]
pub struct ExtractionTrace {
    /// What the transformer was asked to compute.
    pub spec: EncoderSpec,
    /// Number of blocks of the whole backbone.
    pub depth: usize,
    /// The input.
    pub image: ImageTensor,
    /// Interpolated positions, CLS first, `[1 + n, d]`.
    pub positions: Vec<f32>,
    /// Tokens, and CLS attention of each head.
    pub encoded: EncodedImage,
    /// CLS attention summed over heads, in multiples of the uniform level, `[n]`.
    pub attention: Vec<f32>,
    /// How the tokens were pooled: `mean`, `gem` or `vlad`.
    pub pooling: &'static str,
    /// Pooled tokens, L2-normalised: `[d]`, or `[words * d]` for a VLAD.
    pub pooled: Vec<f32>,
    /// Global descriptor: `[256]`, or the same as `pooled` if there is no head.
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
    /// The grid that the indices of the key patches refer to.
    pub fn grid(&self) -> PatchGrid {
        self.key_patches.grid
    }

    /// All intermediates as named arrays, in the order in which they are computed.
    pub fn arrays(&self) -> Vec<TraceArray> {
        let names = Names::of(self);
        let n = self.encoded.grid.len();
        let dim = self.encoded.dim;
        let heads = self.encoded.heads;
        let size = self.image.size;
        let image_shape = [3, size.height as usize, size.width as usize];
        let map_shape = [self.encoded.grid.rows, self.encoded.grid.columns];
        let tokens = [&self.encoded.cls_token[..], &self.encoded.tokens[..]].concat();
        let exit = &names.exit;
        let attention = &names.attention;
        let pooled = format!("global_{}_{}_l2", self.pooling, exit.replace("_tokens", ""));

        let mut all = vec![
            floats("pixels", &image_shape, &self.image.data),
            integers("rows", (0..=n as i64).collect()),
            floats("positions_rows", &[1 + n, dim], &self.positions),
            floats(format!("{exit}_rows"), &[1 + n, dim], &tokens),
            floats(
                format!("cls_attention_{attention}_heads"),
                &[heads, n],
                &self.encoded.cls_attention,
            ),
            floats("attention_map", &map_shape, &self.attention),
            floats(pooled, &[self.pooled.len()], &self.pooled),
            floats("global", &[self.global.len()], &self.global),
        ];
        for (scale, patches) in (1..).zip(&self.key_patches.scales) {
            let prefix = format!("{}_key{scale}", names.key_patches);
            self.push_key_patches(&prefix, scale, patches, &mut all);
        }
        all
    }

    /// Appends the arrays of the key patches of one scale.
    fn push_key_patches(
        &self,
        prefix: &str,
        scale: usize,
        patches: &ScaleKeyPatches,
        all: &mut Vec<TraceArray>,
    ) {
        let count = patches.index.len();
        let mut centres = Vec::with_capacity(2 * count);
        for &index in &patches.index {
            centres.extend(self.grid().centre(scale, index as usize));
        }
        let index = patches.index.iter().map(|&index| i64::from(index));
        all.push(integers(format!("{prefix}_index"), index.collect()));
        all.push(floats(
            format!("{prefix}_attention"),
            &[count],
            &patches.attention,
        ));
        all.push(floats(format!("{prefix}_centre_xy"), &[count, 2], &centres));
        all.push(floats(
            format!("{prefix}_descriptor"),
            &[count, self.encoded.dim],
            &patches.descriptors,
        ));
    }
}

/// The parts of array names that depend on which blocks were computed.
struct Names {
    /// Of the tokens: `block8_tokens`, `last_tokens_normed`, ...
    exit: String,
    /// Of the key patches: `exit8`, `last`, ...
    key_patches: String,
    /// Of the attention: `block8` or `last`.
    attention: String,
}

impl Names {
    fn of(trace: &ExtractionTrace) -> Self {
        let spec = &trace.spec;
        let is_last = |block: usize| block + 1 == trace.depth;
        let block = spec.exit_block;
        let (exit, key_patches) = match (is_last(block), spec.token_norm) {
            (true, true) => ("last_tokens_normed".to_owned(), "last".to_owned()),
            (true, false) => ("last_tokens_prenorm".to_owned(), "last".to_owned()),
            (false, true) => (
                format!("block{block}_tokens_normed"),
                format!("exit{block}_normed"),
            ),
            (false, false) => (format!("block{block}_tokens"), format!("exit{block}")),
        };
        let attention = if is_last(spec.attention_block) {
            "last".to_owned()
        } else {
            format!("block{}", spec.attention_block)
        };
        Self {
            exit,
            key_patches,
            attention,
        }
    }
}

fn floats(name: impl Into<String>, shape: &[usize], values: &[f32]) -> TraceArray {
    TraceArray {
        name: name.into(),
        shape: shape.to_vec(),
        values: TraceValues::F32(values.to_vec()),
    }
}

fn integers(name: impl Into<String>, values: Vec<i64>) -> TraceArray {
    TraceArray {
        name: name.into(),
        shape: vec![values.len()],
        values: TraceValues::I64(values),
    }
}

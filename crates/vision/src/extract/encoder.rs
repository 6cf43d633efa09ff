//! The door between the transformer and everything after it, so that how it is computed can be
//! chosen at start.

use super::error::ExtractError;
use super::preset::Geometry;
use placeformer_core::types::{ImageSize, ImageTensor, InvalidValue};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Which part of the transformer an encoder computes. Blocks beyond the last one named here are
/// never run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct EncoderSpec {
    /// Size of every image.
    pub input_size: ImageSize,
    /// 0-based block whose output tokens are the patch tokens.
    pub exit_block: usize,
    /// Whether those tokens pass the final LayerNorm.
    pub token_norm: bool,
    /// 0-based block whose CLS attention ranks the patches.
    pub attention_block: usize,
}

impl EncoderSpec {
    /// How many blocks must be run.
    pub fn blocks(&self) -> usize {
        self.exit_block.max(self.attention_block) + 1
    }
}

/// Columns and rows of patch tokens, row-major.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct TokenGrid {
    /// Patches per row.
    pub columns: usize,
    /// Rows.
    pub rows: usize,
}

impl TokenGrid {
    /// Number of patches, n.
    pub fn len(self) -> usize {
        self.columns * self.rows
    }

    /// Whether there is no patch.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }
}

/// What the transformer makes of one image.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedImage {
    /// How the patch tokens lie in the image.
    pub grid: TokenGrid,
    /// Width of a token.
    pub dim: usize,
    /// Attention heads.
    pub heads: usize,
    /// Patch tokens of the exit block, normed or not as the spec says, `[n, dim]`.
    pub tokens: Vec<f32>,
    /// The CLS token at the same point, `[dim]`.
    pub cls_token: Vec<f32>,
    /// Softmax attention of the CLS query over the patch keys of the attention block, the CLS key
    /// dropped and the rest not renormalised, `[heads, n]`.
    pub cls_attention: Vec<f32>,
}

/// Runs the transformer. A batch gives bit for bit what single images give.
pub trait Encoder: Send + Sync {
    /// What it computes.
    fn spec(&self) -> &EncoderSpec;

    /// A short name of the implementation and its precision, for reports (`candle-f32`).
    fn name(&self) -> String;

    /// Bytes of weights it holds.
    fn weight_bytes(&self) -> usize;

    /// Encodes images of the spec's size.
    fn encode(&self, images: &[ImageTensor]) -> Result<Vec<EncodedImage>, ExtractError>;
}

/// Arithmetic of the linear layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// The fastest whose answers, re-ranked, are as good as those of f32: mixed where the CPU
    /// multiplies int8 vectors, else f32.
    #[default]
    Auto,
    /// 32-bit floats.
    F32,
    /// bfloat16 products, 32-bit sums.
    Bf16,
    /// int8 in the blocks where it shows least, bf16 (f32 where the CPU lacks it) in the others.
    Mixed,
    /// 8-bit integer products, 32-bit sums.
    Int8,
}

impl Precision {
    /// Every precision.
    pub const ALL: [Self; 5] = [Self::Auto, Self::F32, Self::Bf16, Self::Mixed, Self::Int8];

    /// Its name in settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::Mixed => "mixed",
            Self::Int8 => "int8",
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Precision {
    type Err = InvalidValue;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|precision| precision.name().eq_ignore_ascii_case(text))
            .ok_or_else(|| {
                InvalidValue::new(
                    "precision",
                    format!(
                        "{text:?} is not one of {}",
                        Self::ALL.map(Self::name).join(", ")
                    ),
                )
            })
    }
}

/// Refuses an image whose size or length is not what the spec and `geometry` need.
pub fn check_image(image: &ImageTensor, spec: &EncoderSpec) -> Result<(), ExtractError> {
    if image.size != spec.input_size {
        return Err(ExtractError::WrongSize {
            expected: spec.input_size,
            actual: image.size,
        });
    }
    let expected = 3 * image.size.width as usize * image.size.height as usize;
    if image.data.len() != expected {
        return Err(ExtractError::WrongLength {
            size: image.size,
            expected,
            actual: image.data.len(),
        });
    }
    Ok(())
}

/// The grid of an image of the spec's size.
pub fn token_grid(geometry: &Geometry, spec: &EncoderSpec) -> TokenGrid {
    let (columns, rows) = geometry.grid(spec.input_size);
    TokenGrid { columns, rows }
}

//! The interface between the transformer and everything after it.
//!
//! How the transformer is computed (in which precision, by which implementation) is chosen at
//! start; what comes after it only sees [`Encoder`] and [`EncodedImage`].

use super::error::ExtractError;
use super::preset::Geometry;
use placeformer_core::types::{ImageSize, ImageTensor, InvalidValue};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Which part of the transformer an encoder computes. Blocks after the last one named here are not
/// run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct EncoderSpec {
    /// Size of every image in pixels.
    pub input_size: ImageSize,
    /// 0-based block whose output tokens are the patch tokens.
    pub exit_block: usize,
    /// Whether those tokens pass the final LayerNorm.
    pub token_norm: bool,
    /// 0-based block whose CLS attention ranks the patches.
    pub attention_block: usize,
}

impl EncoderSpec {
    /// Number of blocks that must be run.
    pub fn blocks(&self) -> usize {
        self.exit_block.max(self.attention_block) + 1
    }
}

/// How many patch tokens an image has. They are ordered row by row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct TokenGrid {
    /// Patches in a row.
    pub columns: usize,
    /// Rows of patches.
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

/// The transformer's output for one image (paper III-A).
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedImage {
    /// How the patch tokens lie in the image.
    pub grid: TokenGrid,
    /// Width of a token.
    pub dim: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Patch tokens after the exit block, and after the final LayerNorm if the spec asks for it,
    /// `[n, dim]`.
    pub tokens: Vec<f32>,
    /// The CLS token at the same point, `[dim]`.
    pub cls_token: Vec<f32>,
    /// Softmax attention of the CLS query in the attention block, `[heads, n]`. The weight of the
    /// CLS key itself is left out, and the others are not renormalised.
    pub cls_attention: Vec<f32>,
}

/// An implementation of the transformer. A batch gives bit for bit what single images give.
pub trait Encoder: Send + Sync {
    /// What it computes.
    fn spec(&self) -> &EncoderSpec;

    /// A short name of the implementation and its precision, for reports (`candle-f32`).
    fn name(&self) -> String;

    /// Bytes of weights in memory.
    fn weight_bytes(&self) -> usize;

    /// Encodes images of the spec's size.
    ///
    /// # Errors
    /// An image of another size or with too few values, or an output that is not finite.
    fn encode(&self, images: &[ImageTensor]) -> Result<Vec<EncodedImage>, ExtractError>;

    /// As [`Encoder::encode`], and calls `pause` between the blocks, on the calling thread. No
    /// other thread computes anything for this call meanwhile, so that the caller may let something
    /// more urgent compute, also with this encoder.
    ///
    /// An encoder that cannot stop between blocks never pauses.
    ///
    /// # Errors
    /// As [`Encoder::encode`].
    fn encode_with_pauses(
        &self,
        images: &[ImageTensor],
        _pause: &dyn Fn(),
    ) -> Result<Vec<EncodedImage>, ExtractError> {
        self.encode(images)
    }
}

/// Arithmetic of the linear layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// The fastest one with which recall after re-ranking is as good as with f32: mixed on CPUs
    /// that multiply int8 vectors, f32 on others.
    #[default]
    Auto,
    /// 32-bit floats.
    F32,
    /// bfloat16 factors, 32-bit sums.
    Bf16,
    /// int8 in the blocks where it costs least accuracy, bf16 in the others (f32 on CPUs without
    /// bf16).
    Mixed,
    /// 8-bit integer factors, 32-bit sums.
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
        let named = |precision: &Self| precision.name().eq_ignore_ascii_case(text);
        Self::ALL.into_iter().find(named).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            InvalidValue::new("precision", format!("{text:?} is not one of {known}"))
        })
    }
}

/// Checks that an image has the size that the spec asks for.
///
/// # Errors
/// [`ExtractError::WrongSize`] for another size; [`ExtractError::WrongLength`] if the tensor does
/// not hold three planes of its stated size.
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

/// The grid of patch tokens of an image of the spec's size.
pub fn token_grid(geometry: &Geometry, spec: &EncoderSpec) -> TokenGrid {
    let (columns, rows) = geometry.grid(spec.input_size);
    TokenGrid { columns, rows }
}

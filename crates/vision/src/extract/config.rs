//! Settings of extraction: every point that the paper leaves open, by name.

use super::encoder::{EncoderSpec, Precision};
use super::error::ExtractError;
use super::preset::{Geometry, Preset};
use super::weights::{Difference, VitWeights};
use placeformer_core::types::{ImageSize, InvalidValue, PoolingStride, SCALES};
use serde::{Deserialize, Serialize};
use std::convert::Infallible;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use utoipa::ToSchema;

/// Settings of extraction. What is `None` is the preset's own; see [`ExtractConfig::effective`].
/// The comments of the fields are printed as the manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ExtractConfig {
    /// The backbone: dinov2-vits14, dinov2-vitb14, dinov2-vitl14 or placeformer-vits16.
    #[schema(value_type = String)]
    pub preset: Preset,
    /// Weights file of your own for that backbone: safetensors with the tensor names of timm, DINO
    /// or Hugging Face, or what `train` wrote. Unless set, the published weights are pulled on
    /// first use.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub weights: Option<PathBuf>,
    /// Difference file: what training changed of the weights, as `train` wrote it. It is merged
    /// when the model is loaded, and refused if it belongs to other weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub difference: Option<PathBuf>,
    /// Size in pixels that images are squashed to, such as { width = 448, height = 336 }. Each side
    /// is a multiple of the patch size. Unless set, it is the preset's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Object>)]
    pub input_size: Option<ImageSize>,
    /// 0-based block of the transformer whose tokens are used; later blocks are not computed.
    /// Unless set, it is the preset's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exit_block: Option<usize>,
    /// Whether the tokens pass the final LayerNorm. Unless set, it is the preset's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub token_norm: Option<bool>,
    /// 0-based block whose CLS attention ranks the patches. Unless set, it is the exit block.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attention_block: Option<usize>,
    /// Number of attention heads, for weights trained with another count than the preset's, which
    /// no tensor's shape reveals.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heads: Option<usize>,
    /// The attention of a key patch must exceed this multiple of uniform attention, which is the
    /// number of heads by the number of patches; 1 is the paper's tau of 0.01.
    pub tau: f32,
    /// Most key patches at scales 1, 2 and 3 (paper III-C).
    pub caps: [usize; SCALES],
    /// Distance between fused windows: "kernel" (no overlap) or "one" (a window at every patch).
    #[schema(value_type = String)]
    pub stride: PoolingStride,
    /// Projection to the global descriptor: "default" (the one built in for the backbone and its
    /// published weights) or a file, as `head fit`, `head train` or `train` wrote it. "none" is for
    /// evaluation only, because maps are searched by the projection's output.
    #[schema(value_type = String)]
    pub head: HeadChoice,
    /// Arithmetic of the transformer: f32, bf16, int8, mixed (int8 in the blocks where it shows
    /// least, bf16 in the others), or auto (mixed where the CPU has AVX-512 VNNI, else f32).
    #[schema(value_type = String)]
    pub precision: Precision,
}

impl Default for ExtractConfig {
    fn default() -> Self {
        Self {
            preset: Preset::default(),
            weights: None,
            difference: None,
            input_size: None,
            exit_block: None,
            token_norm: None,
            attention_block: None,
            heads: None,
            tau: 1.0,
            caps: [400, 200, 50],
            stride: PoolingStride::default(),
            head: HeadChoice::default(),
            precision: Precision::default(),
        }
    }
}

/// Which projection makes the global descriptor.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum HeadChoice {
    /// The one built in for this backbone; it is an error if there is none.
    #[default]
    Default,
    /// None: the global descriptor is the pooled vector itself, as long as the backbone makes it.
    /// For evaluation and for fitting heads; such descriptors cannot be searched.
    None,
    /// A head file.
    File(PathBuf),
}

impl From<String> for HeadChoice {
    fn from(text: String) -> Self {
        match text.as_str() {
            "default" => Self::Default,
            "none" => Self::None,
            _ => Self::File(text.into()),
        }
    }
}

impl From<HeadChoice> for String {
    fn from(choice: HeadChoice) -> Self {
        choice.to_string()
    }
}

impl FromStr for HeadChoice {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(text.to_owned().into())
    }
}

impl fmt::Display for HeadChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("default"),
            Self::None => f.write_str("none"),
            Self::File(path) => write!(f, "{}", path.display()),
        }
    }
}

impl ExtractConfig {
    /// The size in pixels to which images are resized.
    pub fn input_size(&self) -> ImageSize {
        self.input_size.unwrap_or(self.preset.input_size())
    }

    /// What an encoder must compute with these settings.
    ///
    /// # Errors
    /// A setting that does not fit the preset's geometry; the error names it.
    pub fn encoder_spec(&self) -> Result<EncoderSpec, InvalidValue> {
        let exit_block = self.exit_block.unwrap_or(self.preset.exit_block());
        let spec = EncoderSpec {
            input_size: self.input_size(),
            exit_block,
            token_norm: self.token_norm.unwrap_or(self.preset.token_norm()),
            attention_block: self.attention_block.unwrap_or(exit_block),
        };
        self.validate(&spec)?;
        Ok(spec)
    }

    /// The same settings with the preset's values filled in.
    ///
    /// # Errors
    /// As [`ExtractConfig::encoder_spec`].
    pub fn effective(&self) -> Result<Self, InvalidValue> {
        let spec = self.encoder_spec()?;
        Ok(Self {
            input_size: Some(spec.input_size),
            exit_block: Some(spec.exit_block),
            token_norm: Some(spec.token_norm),
            attention_block: Some(spec.attention_block),
            ..self.clone()
        })
    }

    /// Loads the weights at `path`, and merges the difference that the settings name.
    ///
    /// # Errors
    /// Those of [`VitWeights::load`], [`Difference::load`] and [`Difference::merge`].
    pub fn load_weights(&self, path: &Path) -> Result<VitWeights, ExtractError> {
        let weights = VitWeights::load(path, self.preset, self.heads)?;
        match &self.difference {
            None => Ok(weights),
            Some(file) => Difference::load(file)?
                .merge(&weights)
                .map_err(|error| error.in_file(file)),
        }
    }

    fn validate(&self, spec: &EncoderSpec) -> Result<(), InvalidValue> {
        let geometry = self.preset.geometry();
        check_input_size(spec.input_size, &geometry)?;
        check_block("exit_block", spec.exit_block, &geometry)?;
        check_block("attention_block", spec.attention_block, &geometry)?;
        if let Some(heads) = self.heads {
            check_heads(heads, &geometry)?;
        }
        if !self.tau.is_finite() || self.tau < 0.0 {
            let reason = format!("{} is not a non-negative number", self.tau);
            return Err(InvalidValue::new("tau", reason));
        }
        check_caps(&self.caps)
    }
}

/// Most patches of an image. A stored patch index has 16 bits.
const MOST_PATCHES: usize = u16::MAX as usize + 1;

fn check_input_size(size: ImageSize, geometry: &Geometry) -> Result<(), InvalidValue> {
    let patch = geometry.patch as u32;
    let is_whole = |side: u32| side > 0 && side.is_multiple_of(patch);
    if !is_whole(size.width) || !is_whole(size.height) {
        let nearest = |side: u32| ((side + patch / 2) / patch).max(1) * patch;
        let suggestion = ImageSize {
            width: nearest(size.width),
            height: nearest(size.height),
        };
        let reason = format!("{size} is not whole patches of {patch} pixels; try {suggestion}");
        return Err(InvalidValue::new("input_size", reason));
    }
    let (columns, rows) = geometry.grid(size);
    if columns.saturating_mul(rows) > MOST_PATCHES {
        let reason = format!("{size} makes more than {MOST_PATCHES} patches");
        return Err(InvalidValue::new("input_size", reason));
    }
    Ok(())
}

fn check_block(field: &'static str, block: usize, geometry: &Geometry) -> Result<(), InvalidValue> {
    let last = geometry.depth - 1;
    if block > last {
        let reason = format!("{block} is beyond the last block, {last}");
        return Err(InvalidValue::new(field, reason));
    }
    Ok(())
}

fn check_heads(heads: usize, geometry: &Geometry) -> Result<(), InvalidValue> {
    let dim = geometry.dim;
    if heads == 0 || !dim.is_multiple_of(heads) {
        let reason = format!("{heads} does not divide the token width {dim}");
        return Err(InvalidValue::new("heads", reason));
    }
    Ok(())
}

fn check_caps(caps: &[usize; SCALES]) -> Result<(), InvalidValue> {
    let is_too_large = caps.iter().any(|&cap| cap > MOST_PATCHES);
    let has_none = caps.iter().all(|&cap| cap == 0);
    if is_too_large || has_none {
        let reason = format!("{caps:?} must hold a positive number and none above {MOST_PATCHES}");
        return Err(InvalidValue::new("caps", reason));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_unset_is_the_presets() {
        let spec = ExtractConfig::default().encoder_spec().unwrap();
        assert_eq!(spec.exit_block, 8);
        assert_eq!(spec.attention_block, 8);
        assert!(!spec.token_norm);
        assert_eq!(spec.blocks(), 9);
        let paper = ExtractConfig {
            preset: Preset::PlaceformerVits16,
            ..Default::default()
        }
        .encoder_spec()
        .unwrap();
        assert_eq!((paper.exit_block, paper.token_norm), (11, true));
        assert_eq!(
            paper.input_size,
            ImageSize {
                width: 640,
                height: 480
            }
        );
    }

    #[test]
    fn settings_survive_toml() {
        let config = ExtractConfig {
            head: HeadChoice::File("h.safetensors".into()),
            ..Default::default()
        };
        let config = config.effective().unwrap();
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<ExtractConfig>(&text).unwrap(), config);
        let misspelt = toml::from_str::<ExtractConfig>("tua = 1.0").unwrap_err();
        assert!(misspelt.to_string().contains("tua"), "{misspelt}");
    }

    #[test]
    fn each_broken_rule_is_named() {
        let broken = |change: fn(&mut ExtractConfig)| {
            let mut config = ExtractConfig::default();
            change(&mut config);
            config.encoder_spec().unwrap_err()
        };
        let wrong_size = broken(|c| {
            c.input_size = Some(ImageSize {
                width: 640,
                height: 480,
            })
        });
        assert!(
            wrong_size.field == "input_size" && wrong_size.reason.contains("644x476"),
            "{wrong_size}"
        );
        assert_eq!(broken(|c| c.exit_block = Some(12)).field, "exit_block");
        assert_eq!(
            broken(|c| c.attention_block = Some(12)).field,
            "attention_block"
        );
        assert_eq!(broken(|c| c.heads = Some(7)).field, "heads");
        assert_eq!(broken(|c| c.tau = f32::NAN).field, "tau");
        assert_eq!(broken(|c| c.caps = [0, 0, 0]).field, "caps");
    }
}

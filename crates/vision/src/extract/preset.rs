//! Named backbones: everything about one that its weights file does not say.
//!
//! A preset fixes the shapes that a weights file must have, and the defaults that go with it: input
//! size, exit block, and whether tokens pass the final LayerNorm (paper IV-A). The exit block of
//! stock DINOv2 weights was found by our own measurements.

use placeformer_core::types::{ImageSize, InvalidValue};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Epsilon of all LayerNorms.
pub const LAYER_NORM_EPS: f32 = 1e-6;

/// A backbone by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
pub enum Preset {
    /// DINOv2 ViT-S/14: the model that ships.
    #[default]
    #[serde(rename = "dinov2-vits14")]
    Dinov2Vits14,
    /// DINOv2 ViT-B/14.
    #[serde(rename = "dinov2-vitb14")]
    Dinov2Vitb14,
    /// DINOv2 ViT-L/14.
    #[serde(rename = "dinov2-vitl14")]
    Dinov2Vitl14,
    /// The paper's own backbone, ViT-S/16 with 12 heads, for weights that a user trains or has.
    #[serde(rename = "placeformer-vits16")]
    PlaceformerVits16,
}

/// The shape of a vision transformer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Geometry {
    /// Number of transformer blocks.
    pub depth: usize,
    /// Width of a token, d.
    pub dim: usize,
    /// Number of attention heads; divides `dim`.
    pub heads: usize,
    /// Side of a patch in pixels, p.
    pub patch: usize,
    /// Width of the hidden layer of the MLP.
    pub mlp_dim: usize,
    /// Whether each residual branch is scaled per channel (LayerScale).
    pub layer_scale: bool,
}

impl Geometry {
    /// Width of one attention head.
    pub fn head_dim(&self) -> usize {
        self.dim / self.heads
    }

    /// Columns and rows of patches in an image of `size`.
    pub fn grid(&self, size: ImageSize) -> (usize, usize) {
        (
            size.width as usize / self.patch,
            size.height as usize / self.patch,
        )
    }
}

impl Preset {
    /// Every preset.
    pub const ALL: [Self; 4] = [
        Self::Dinov2Vits14,
        Self::Dinov2Vitb14,
        Self::Dinov2Vitl14,
        Self::PlaceformerVits16,
    ];

    /// Its name in settings and identities.
    pub fn name(self) -> &'static str {
        match self {
            Self::Dinov2Vits14 => "dinov2-vits14",
            Self::Dinov2Vitb14 => "dinov2-vitb14",
            Self::Dinov2Vitl14 => "dinov2-vitl14",
            Self::PlaceformerVits16 => "placeformer-vits16",
        }
    }

    /// A description in one line.
    pub fn summary(self) -> &'static str {
        match self {
            Self::Dinov2Vits14 => "DINOv2 ViT-S/14, the default",
            Self::Dinov2Vitb14 => "DINOv2 ViT-B/14",
            Self::Dinov2Vitl14 => "DINOv2 ViT-L/14",
            Self::PlaceformerVits16 => {
                "the paper's ViT-S/16; no published weights: bring or train them"
            }
        }
    }

    /// Its geometry.
    pub fn geometry(self) -> Geometry {
        let dinov2 = |depth, dim, heads| Geometry {
            depth,
            dim,
            heads,
            patch: 14,
            mlp_dim: 4 * dim,
            layer_scale: true,
        };
        match self {
            Self::Dinov2Vits14 => dinov2(12, 384, 6),
            Self::Dinov2Vitb14 => dinov2(12, 768, 12),
            Self::Dinov2Vitl14 => dinov2(24, 1024, 16),
            Self::PlaceformerVits16 => Geometry {
                depth: 12,
                dim: 384,
                heads: 12,
                patch: 16,
                mlp_dim: 1536,
                layer_scale: false,
            },
        }
    }

    /// The input size in pixels, unless another is set: 640x480 as in the paper, and 448x336 for
    /// stock weights, which gain nothing from larger images.
    pub fn input_size(self) -> ImageSize {
        match self {
            Self::PlaceformerVits16 => ImageSize {
                width: 640,
                height: 480,
            },
            _ => ImageSize {
                width: 448,
                height: 336,
            },
        }
    }

    /// Number, from 0, of the block after which tokens are taken: three quarters of the way for
    /// stock weights, the last block for weights that were trained for place recognition.
    pub fn exit_block(self) -> usize {
        match self {
            Self::PlaceformerVits16 => self.geometry().depth - 1,
            _ => self.geometry().depth * 3 / 4 - 1,
        }
    }

    /// Whether tokens pass the final LayerNorm.
    pub fn token_norm(self) -> bool {
        self == Self::PlaceformerVits16
    }

    /// The Hugging Face repository that publishes its weights.
    pub fn hub_repository(self) -> Option<&'static str> {
        match self {
            Self::Dinov2Vits14 => Some("facebook/dinov2-small"),
            Self::Dinov2Vitb14 => Some("facebook/dinov2-base"),
            Self::Dinov2Vitl14 => Some("facebook/dinov2-large"),
            Self::PlaceformerVits16 => None,
        }
    }

    /// The [content hash](crate::extract::VitWeights::content_hash) that its published weights must
    /// have. Only the default preset has one: its built-in head and calibration were fitted to
    /// exactly these weights.
    pub fn content_sha256(self) -> Option<&'static str> {
        match self {
            Self::Dinov2Vits14 => {
                Some("747267a07f39bc8916583ac2ee193ab2eaa34801a834e73fc97a5587c9e657f7")
            }
            Self::Dinov2Vitb14 | Self::Dinov2Vitl14 | Self::PlaceformerVits16 => None,
        }
    }

    /// Rows and columns of a learned position table with this many entries (CLS not counted), if
    /// the preset can have such a table.
    ///
    /// DINOv2 has 37x37. The paper's backbone may have any square, as pre-trained on ImageNet, or
    /// the grid of its own input size, after training.
    pub fn position_grid(self, entries: usize) -> Option<(usize, usize)> {
        let side = entries.isqrt();
        let (columns, rows) = self.geometry().grid(self.input_size());
        match self {
            Self::PlaceformerVits16 if entries == rows * columns => Some((rows, columns)),
            Self::PlaceformerVits16 => (side > 1 && side * side == entries).then_some((side, side)),
            _ => (entries == 37 * 37).then_some((37, 37)),
        }
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Preset {
    type Err = InvalidValue;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let named = |preset: &Self| preset.name() == text;
        Self::ALL.into_iter().find(named).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            InvalidValue::new("preset", format!("{text:?} is not one of {known}"))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_survive_text_and_serde() {
        for preset in Preset::ALL {
            assert_eq!(preset.name().parse::<Preset>().unwrap(), preset);
            assert_eq!(serde_json::to_value(preset).unwrap(), preset.name());
        }
        let unknown = "dinov2".parse::<Preset>().unwrap_err();
        assert!(unknown.to_string().contains("dinov2-vits14"), "{unknown}");
    }

    #[test]
    fn default_sizes_are_whole_patches_and_exits_exist() {
        for preset in Preset::ALL {
            let geometry = preset.geometry();
            let size = preset.input_size();
            assert_eq!(size.width as usize % geometry.patch, 0);
            assert_eq!(size.height as usize % geometry.patch, 0);
            assert!(preset.exit_block() < geometry.depth);
            assert_eq!(geometry.dim % geometry.heads, 0);
        }
        assert_eq!(Preset::Dinov2Vits14.exit_block(), 8);
    }

    #[test]
    fn position_tables_fit_only_known_grids() {
        assert_eq!(Preset::Dinov2Vits14.position_grid(1369), Some((37, 37)));
        assert_eq!(Preset::Dinov2Vits14.position_grid(196), None);
        assert_eq!(Preset::PlaceformerVits16.position_grid(196), Some((14, 14)));
        assert_eq!(
            Preset::PlaceformerVits16.position_grid(1200),
            Some((30, 40))
        );
        assert_eq!(Preset::PlaceformerVits16.position_grid(197), None);
    }
}

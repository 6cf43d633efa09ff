//! The weights of a backbone, their names in the fused naming, and their hash.

use super::difference::Merged;
use crate::extract::error::ExtractError;
use crate::extract::preset::{Geometry, Preset};
use placeformer_core::files::write_atomically;
use safetensors::tensor::{Dtype, SafeTensorError, TensorView};
use sha2::{Digest, Sha256};
use std::path::Path;

/// A linear layer y = W x + b.
#[derive(Debug, Clone, PartialEq)]
pub struct Linear {
    /// W, `[out, in]` row-major.
    pub weight: Vec<f32>,
    /// b, `[out]`.
    pub bias: Vec<f32>,
}

/// A LayerNorm's scale and shift, `[d]` each.
#[derive(Debug, Clone, PartialEq)]
pub struct Norm {
    /// Scale.
    pub weight: Vec<f32>,
    /// Shift.
    pub bias: Vec<f32>,
}

/// One transformer block.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockWeights {
    /// LayerNorm before attention.
    pub norm1: Norm,
    /// Query, key and value: out = 3d, rows in that order, the rows of a head adjacent.
    pub qkv: Linear,
    /// Attention output, d -> d.
    pub proj: Linear,
    /// LayerScale of the attention branch, `[d]`.
    pub layer_scale1: Option<Vec<f32>>,
    /// LayerNorm before the MLP.
    pub norm2: Norm,
    /// First layer of the MLP, d -> mlp_dim.
    pub fc1: Linear,
    /// Second layer of the MLP, mlp_dim -> d.
    pub fc2: Linear,
    /// LayerScale of the MLP branch, `[d]`.
    pub layer_scale2: Option<Vec<f32>>,
}

/// All weights of a backbone.
#[derive(Debug, Clone, PartialEq)]
pub struct VitWeights {
    /// The preset that the shapes follow.
    pub preset: Preset,
    /// The geometry; its head count is that of the file or of the settings.
    pub geometry: Geometry,
    /// Rows and columns of the learned position table.
    pub position_grid: (usize, usize),
    /// Patch embedding; in = 3 * p * p, in the order channel, row, column.
    pub patch_embed: Linear,
    /// CLS token, `[d]`.
    pub cls_token: Vec<f32>,
    /// Learned positions, CLS first, `[1 + rows * columns, d]`.
    pub positions: Vec<f32>,
    /// The blocks, in order.
    pub blocks: Vec<BlockWeights>,
    /// The final LayerNorm.
    pub norm: Norm,
    /// Number of learned values in the file that the method does not use, such as DINOv2's mask
    /// token.
    pub unused_parameters: usize,
    /// What they were merged of, if a difference was. It is part of their identity in memory, and
    /// is not written with them.
    pub merged: Option<Merged>,
}

/// A tensor by its fused name and shape.
type NamedTensor<'a> = (String, Vec<usize>, &'a [f32]);

impl VitWeights {
    /// Number of learned values in use.
    pub fn parameters(&self) -> usize {
        let tensors = self.tensors();
        tensors.iter().map(|(_, _, values)| values.len()).sum()
    }

    /// SHA-256 over names, shapes and values in the fused naming, hexadecimal: the identity of the
    /// weights.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        for (name, shape, values) in self.tensors() {
            hasher.update(format!("{name}{shape:?}"));
            hasher.update(bytemuck::cast_slice::<f32, u8>(values));
        }
        hex::encode(hasher.finalize())
    }

    /// Writes the weights to `path` in the fused naming. The file appears complete or not at all.
    ///
    /// # Errors
    /// [`ExtractError::Io`] if the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), ExtractError> {
        let bad = |error: SafeTensorError| ExtractError::BadFile {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let mut views = Vec::new();
        for (name, shape, values) in self.tensors() {
            let bytes = bytemuck::cast_slice(values);
            let view = TensorView::new(Dtype::F32, shape, bytes).map_err(bad)?;
            views.push((name, view));
        }
        let metadata = [
            ("num_heads".to_owned(), self.geometry.heads.to_string()),
            ("preset".to_owned(), self.preset.to_string()),
        ];
        let bytes = safetensors::serialize(views, Some(metadata.into())).map_err(bad)?;
        write_atomically(path, &bytes).map_err(ExtractError::io(path))
    }

    /// Every tensor with its fused name and its shape, in a fixed order.
    pub fn tensors(&self) -> Vec<(String, Vec<usize>, &[f32])> {
        let dim = self.geometry.dim;
        let patch = self.geometry.patch;
        let embed = &self.patch_embed;
        let entries = self.positions.len() / dim;
        let mut all: Vec<NamedTensor<'_>> = vec![
            ("cls_token".into(), vec![1, 1, dim], &self.cls_token),
            ("pos_embed".into(), vec![1, entries, dim], &self.positions),
            (
                "patch_embed.proj.weight".into(),
                vec![dim, 3, patch, patch],
                &embed.weight,
            ),
            ("patch_embed.proj.bias".into(), vec![dim], &embed.bias),
        ];
        for (index, block) in self.blocks.iter().enumerate() {
            block.push_tensors(&format!("blocks.{index}"), &self.geometry, &mut all);
        }
        all.push(("norm.weight".into(), vec![dim], &self.norm.weight));
        all.push(("norm.bias".into(), vec![dim], &self.norm.bias));
        all
    }

    /// Overwrites the tensor with this fused name; false if there is none of this name and length.
    pub fn replace(&mut self, name: &str, values: &[f32]) -> bool {
        match self.tensor_mut(name) {
            Some(tensor) if tensor.len() == values.len() => {
                tensor.copy_from_slice(values);
                true
            }
            _ => false,
        }
    }

    fn tensor_mut(&mut self, name: &str) -> Option<&mut Vec<f32>> {
        if let Some(of_block) = name.strip_prefix("blocks.") {
            let (index, part) = of_block.split_once('.')?;
            let index: usize = index.parse().ok()?;
            return self.blocks.get_mut(index)?.tensor_mut(part);
        }
        match name {
            "cls_token" => Some(&mut self.cls_token),
            "pos_embed" => Some(&mut self.positions),
            "patch_embed.proj.weight" => Some(&mut self.patch_embed.weight),
            "patch_embed.proj.bias" => Some(&mut self.patch_embed.bias),
            "norm.weight" => Some(&mut self.norm.weight),
            "norm.bias" => Some(&mut self.norm.bias),
            _ => None,
        }
    }
}

impl BlockWeights {
    /// Appends the tensors of this block, named under `prefix`.
    fn push_tensors<'a>(
        &'a self,
        prefix: &str,
        geometry: &Geometry,
        all: &mut Vec<NamedTensor<'a>>,
    ) {
        let dim = geometry.dim;
        let mlp_dim = geometry.mlp_dim;
        for (name, norm) in [("norm1", &self.norm1), ("norm2", &self.norm2)] {
            all.push((format!("{prefix}.{name}.weight"), vec![dim], &norm.weight));
            all.push((format!("{prefix}.{name}.bias"), vec![dim], &norm.bias));
        }
        for (name, layer, out, input) in [
            ("attn.qkv", &self.qkv, 3 * dim, dim),
            ("attn.proj", &self.proj, dim, dim),
            ("mlp.fc1", &self.fc1, mlp_dim, dim),
            ("mlp.fc2", &self.fc2, dim, mlp_dim),
        ] {
            let weight_name = format!("{prefix}.{name}.weight");
            all.push((weight_name, vec![out, input], &layer.weight));
            all.push((format!("{prefix}.{name}.bias"), vec![out], &layer.bias));
        }
        for (name, scale) in [("ls1", &self.layer_scale1), ("ls2", &self.layer_scale2)] {
            if let Some(scale) = scale {
                all.push((format!("{prefix}.{name}.gamma"), vec![dim], scale));
            }
        }
    }

    fn tensor_mut(&mut self, part: &str) -> Option<&mut Vec<f32>> {
        match part {
            "norm1.weight" => Some(&mut self.norm1.weight),
            "norm1.bias" => Some(&mut self.norm1.bias),
            "norm2.weight" => Some(&mut self.norm2.weight),
            "norm2.bias" => Some(&mut self.norm2.bias),
            "attn.qkv.weight" => Some(&mut self.qkv.weight),
            "attn.qkv.bias" => Some(&mut self.qkv.bias),
            "attn.proj.weight" => Some(&mut self.proj.weight),
            "attn.proj.bias" => Some(&mut self.proj.bias),
            "mlp.fc1.weight" => Some(&mut self.fc1.weight),
            "mlp.fc1.bias" => Some(&mut self.fc1.bias),
            "mlp.fc2.weight" => Some(&mut self.fc2.weight),
            "mlp.fc2.bias" => Some(&mut self.fc2.bias),
            "ls1.gamma" => self.layer_scale1.as_mut(),
            "ls2.gamma" => self.layer_scale2.as_mut(),
            _ => None,
        }
    }
}

//! Weights of a vision transformer as plain slices, from safetensors: every tensor by name and
//! shape, or none at all.
//!
//! Two families of names are understood, each with or without a common prefix such as `backbone.`:
//! Hugging Face (`encoder.layer.0.attention.attention.query.weight`) and the one timm, DINO and
//! DINOv2 share, with query, key and value fused (`blocks.0.attn.qkv.weight`). Both end up in the
//! fused form. The content hash covers that form, so equal weights have one identity however they
//! were named and stored.

use super::error::ExtractError;
use super::preset::{Geometry, Preset};
use half::{bf16, f16};
use placeformer_core::files::write_atomically;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
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
    /// Before attention.
    pub norm1: Norm,
    /// Query, key, value: out = 3d, rows in that order, heads contiguous within each.
    pub qkv: Linear,
    /// Attention output, d -> d.
    pub proj: Linear,
    /// LayerScale of the attention branch, `[d]`.
    pub layer_scale1: Option<Vec<f32>>,
    /// Before the MLP.
    pub norm2: Norm,
    /// d -> mlp_dim.
    pub fc1: Linear,
    /// mlp_dim -> d.
    pub fc2: Linear,
    /// LayerScale of the MLP branch, `[d]`.
    pub layer_scale2: Option<Vec<f32>>,
}

/// All weights of a backbone.
#[derive(Debug, Clone, PartialEq)]
pub struct VitWeights {
    /// Which preset's shapes they have.
    pub preset: Preset,
    /// The shape, heads as the file or the settings say.
    pub geometry: Geometry,
    /// Rows and columns of the learned position table.
    pub position_grid: (usize, usize),
    /// Patch embedding, in = 3 * p * p in the order channel, row, column.
    pub patch_embed: Linear,
    /// CLS token, `[d]`.
    pub cls_token: Vec<f32>,
    /// Learned positions, CLS first, `[1 + rows * columns, d]`.
    pub positions: Vec<f32>,
    /// The blocks, in order.
    pub blocks: Vec<BlockWeights>,
    /// The final LayerNorm.
    pub norm: Norm,
    /// Learned values in the file that the method has no use for, such as DINOv2's mask token.
    pub unused_parameters: usize,
}

/// Tensors a published file may hold that this method has no use for.
const UNUSED: [&str; 7] = [
    "mask_token",
    "embeddings.mask_token",
    "head.",
    "classifier.",
    "pooler.",
    "fc_norm.",
    "decoder.",
];

impl VitWeights {
    /// Loads `path` as weights of `preset`. `heads` overrides the head count, which no tensor's
    /// shape reveals; without it the file's `num_heads` metadata counts, then the preset.
    ///
    /// Fails, naming every offending tensor, when one is missing, unexpected or of another shape or
    /// type.
    pub fn load(path: &Path, preset: Preset, heads: Option<usize>) -> Result<Self, ExtractError> {
        let bytes = std::fs::read(path).map_err(ExtractError::io(path))?;
        Self::from_bytes(&bytes, path, preset, heads)
    }

    /// As [`VitWeights::load`], from the bytes of the file that `path` names in errors.
    pub fn from_bytes(
        bytes: &[u8],
        path: &Path,
        preset: Preset,
        heads: Option<usize>,
    ) -> Result<Self, ExtractError> {
        let bad = |reason: String| ExtractError::BadFile {
            path: path.to_owned(),
            reason,
        };
        let broken = |e| bad(format!("truncated or not a safetensors file: {e}"));
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(broken)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(broken)?;
        let recorded = metadata
            .metadata()
            .as_ref()
            .and_then(|m| m.get("num_heads"))
            .map(|text| {
                text.parse::<usize>()
                    .map_err(|_| bad(format!("metadata num_heads is {text:?}, not a number")))
            });
        let mut geometry = preset.geometry();
        geometry.heads = heads.or(recorded.transpose()?).unwrap_or(geometry.heads);
        if geometry.heads == 0 || !geometry.dim.is_multiple_of(geometry.heads) {
            return Err(bad(format!(
                "{} heads do not divide tokens of width {}",
                geometry.heads, geometry.dim
            )));
        }
        let mut reader = Reader::new(&tensors).ok_or_else(|| {
            bad(
                "holds no vision transformer under a known naming (Hugging Face, timm, DINO)"
                    .into(),
            )
        })?;
        let weights = reader.read(preset, geometry);
        let (problems, unused_parameters) = reader.finish();
        match weights {
            Some(weights) if problems.is_empty() => Ok(Self {
                unused_parameters,
                ..weights
            }),
            _ => Err(ExtractError::WrongTensors {
                path: path.to_owned(),
                preset: preset.to_string(),
                problems,
            }),
        }
    }

    /// Number of learned values in use.
    pub fn parameters(&self) -> usize {
        self.tensors()
            .iter()
            .map(|(_, _, values)| values.len())
            .sum()
    }

    /// SHA-256 over names, shapes and values in the fused naming: the identity of the weights,
    /// hexadecimal.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        for (name, shape, values) in self.tensors() {
            hasher.update(format!("{name}{shape:?}"));
            hasher.update(bytemuck::cast_slice::<f32, u8>(values));
        }
        hex::encode(hasher.finalize())
    }

    /// Writes the weights in the fused naming, atomically.
    pub fn save(&self, path: &Path) -> Result<(), ExtractError> {
        let views: Result<Vec<_>, _> = self
            .tensors()
            .into_iter()
            .map(|(name, shape, values)| {
                TensorView::new(Dtype::F32, shape, bytemuck::cast_slice(values))
                    .map(|view| (name, view))
            })
            .collect();
        let bad = |e: safetensors::SafeTensorError| ExtractError::BadFile {
            path: path.to_owned(),
            reason: e.to_string(),
        };
        let metadata = [
            ("num_heads", self.geometry.heads.to_string()),
            ("preset", self.preset.to_string()),
        ];
        let metadata = metadata.map(|(key, value)| (key.to_owned(), value)).into();
        let bytes = safetensors::serialize(views.map_err(bad)?, Some(metadata)).map_err(bad)?;
        write_atomically(path, &bytes).map_err(ExtractError::io(path))
    }

    /// Every tensor with its fused name and shape, in a fixed order.
    pub fn tensors(&self) -> Vec<(String, Vec<usize>, &[f32])> {
        let Geometry {
            dim,
            patch,
            mlp_dim,
            ..
        } = self.geometry;
        let mut all: Vec<(String, Vec<usize>, &[f32])> = vec![
            ("cls_token".into(), vec![1, 1, dim], &self.cls_token),
            (
                "pos_embed".into(),
                vec![1, self.positions.len() / dim, dim],
                &self.positions,
            ),
            (
                "patch_embed.proj.weight".into(),
                vec![dim, 3, patch, patch],
                &self.patch_embed.weight,
            ),
            (
                "patch_embed.proj.bias".into(),
                vec![dim],
                &self.patch_embed.bias,
            ),
        ];
        for (i, block) in self.blocks.iter().enumerate() {
            for (name, norm) in [("norm1", &block.norm1), ("norm2", &block.norm2)] {
                all.push((format!("blocks.{i}.{name}.weight"), vec![dim], &norm.weight));
                all.push((format!("blocks.{i}.{name}.bias"), vec![dim], &norm.bias));
            }
            for (name, layer, out, input) in [
                ("attn.qkv", &block.qkv, 3 * dim, dim),
                ("attn.proj", &block.proj, dim, dim),
                ("mlp.fc1", &block.fc1, mlp_dim, dim),
                ("mlp.fc2", &block.fc2, dim, mlp_dim),
            ] {
                all.push((
                    format!("blocks.{i}.{name}.weight"),
                    vec![out, input],
                    &layer.weight,
                ));
                all.push((format!("blocks.{i}.{name}.bias"), vec![out], &layer.bias));
            }
            for (name, scale) in [("ls1", &block.layer_scale1), ("ls2", &block.layer_scale2)] {
                all.extend(
                    scale
                        .iter()
                        .map(|s| (format!("blocks.{i}.{name}.gamma"), vec![dim], s.as_slice())),
                );
            }
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
        let Some(rest) = name.strip_prefix("blocks.") else {
            return match name {
                "cls_token" => Some(&mut self.cls_token),
                "pos_embed" => Some(&mut self.positions),
                "patch_embed.proj.weight" => Some(&mut self.patch_embed.weight),
                "patch_embed.proj.bias" => Some(&mut self.patch_embed.bias),
                "norm.weight" => Some(&mut self.norm.weight),
                "norm.bias" => Some(&mut self.norm.bias),
                _ => None,
            };
        };
        let (index, part) = rest.split_once('.')?;
        let block = self.blocks.get_mut(index.parse::<usize>().ok()?)?;
        match part {
            "norm1.weight" => Some(&mut block.norm1.weight),
            "norm1.bias" => Some(&mut block.norm1.bias),
            "norm2.weight" => Some(&mut block.norm2.weight),
            "norm2.bias" => Some(&mut block.norm2.bias),
            "attn.qkv.weight" => Some(&mut block.qkv.weight),
            "attn.qkv.bias" => Some(&mut block.qkv.bias),
            "attn.proj.weight" => Some(&mut block.proj.weight),
            "attn.proj.bias" => Some(&mut block.proj.bias),
            "mlp.fc1.weight" => Some(&mut block.fc1.weight),
            "mlp.fc1.bias" => Some(&mut block.fc1.bias),
            "mlp.fc2.weight" => Some(&mut block.fc2.weight),
            "mlp.fc2.bias" => Some(&mut block.fc2.bias),
            "ls1.gamma" => block.layer_scale1.as_mut(),
            "ls2.gamma" => block.layer_scale2.as_mut(),
            _ => None,
        }
    }
}

/// How a file names its tensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Naming {
    /// `encoder.layer.0.attention.attention.query.weight`
    HuggingFace,
    /// `blocks.0.attn.qkv.weight`
    Fused,
}

/// Takes tensors out of a file one by one, collecting everything that is wrong instead of stopping
/// at the first fault.
struct Reader<'a> {
    naming: Naming,
    prefix: String,
    tensors: BTreeMap<String, TensorView<'a>>,
    taken: BTreeSet<String>,
    problems: Vec<String>,
}

impl<'a> Reader<'a> {
    /// Recognises the naming by the position table, whose name ends the same under every prefix.
    fn new(file: &SafeTensors<'a>) -> Option<Self> {
        let tensors: BTreeMap<_, _> = file.tensors().into_iter().collect();
        let (naming, prefix) = tensors.keys().find_map(|name| {
            let known = [
                (Naming::HuggingFace, "embeddings.position_embeddings"),
                (Naming::Fused, "pos_embed"),
            ];
            known
                .into_iter()
                .find_map(|(naming, tail)| name.strip_suffix(tail).map(|p| (naming, p.to_owned())))
        })?;
        Some(Self {
            naming,
            prefix,
            tensors,
            taken: BTreeSet::new(),
            problems: Vec::new(),
        })
    }

    /// Everything that was wrong, including what was not asked for.
    fn finish(mut self) -> (Vec<String>, usize) {
        let mut unused_parameters = 0;
        for (name, view) in &self.tensors {
            let bare = name.strip_prefix(self.prefix.as_str()).unwrap_or(name);
            let unused = UNUSED
                .iter()
                .any(|known| bare.starts_with(known) || name.starts_with(known));
            if unused {
                unused_parameters += view.shape().iter().product::<usize>();
            } else if !self.taken.contains(name) {
                self.problems
                    .push(format!("{name} {:?} is unexpected", view.shape()));
            }
        }
        (self.problems, unused_parameters)
    }

    fn read(&mut self, preset: Preset, geometry: Geometry) -> Option<VitWeights> {
        let Geometry { dim, patch, .. } = geometry;
        let names = match self.naming {
            Naming::HuggingFace => [
                "embeddings.cls_token",
                "embeddings.position_embeddings",
                "embeddings.patch_embeddings.projection",
            ],
            Naming::Fused => ["cls_token", "pos_embed", "patch_embed.proj"],
        };
        let norm = if self.naming == Naming::HuggingFace {
            "layernorm"
        } else {
            "norm"
        };
        let cls_token = self.take(names[0], &[1, 1, dim]);
        let positions = self.take_positions(names[1], preset, dim);
        let patch_weight = self.take(&format!("{}.weight", names[2]), &[dim, 3, patch, patch]);
        let patch_bias = self.take(&format!("{}.bias", names[2]), &[dim]);
        // Not short-circuited: every block is looked at, so that every fault is named.
        let blocks: Vec<_> = (0..geometry.depth)
            .map(|i| self.block(i, &geometry))
            .collect();
        let norm = self.norm(norm, dim);
        let (positions, position_grid) = positions?;
        Some(VitWeights {
            preset,
            geometry,
            position_grid,
            patch_embed: Linear {
                weight: patch_weight?,
                bias: patch_bias?,
            },
            cls_token: cls_token?,
            positions,
            blocks: blocks.into_iter().collect::<Option<_>>()?,
            norm: norm?,
            unused_parameters: 0,
        })
    }

    fn block(&mut self, i: usize, geometry: &Geometry) -> Option<BlockWeights> {
        let Geometry {
            dim,
            mlp_dim,
            layer_scale,
            ..
        } = *geometry;
        let hugging_face = self.naming == Naming::HuggingFace;
        let base = if hugging_face {
            format!("encoder.layer.{i}")
        } else {
            format!("blocks.{i}")
        };
        let scales = if hugging_face {
            ["layer_scale1.lambda1", "layer_scale2.lambda1"]
        } else {
            ["ls1.gamma", "ls2.gamma"]
        };
        let proj = if hugging_face {
            "attention.output.dense"
        } else {
            "attn.proj"
        };
        let norm1 = self.norm(&format!("{base}.norm1"), dim);
        let qkv = if hugging_face {
            let parts = ["query", "key", "value"]
                .map(|part| self.linear(&format!("{base}.attention.attention.{part}"), dim, dim));
            parts
                .into_iter()
                .collect::<Option<Vec<_>>>()
                .map(|parts| Linear {
                    weight: parts
                        .iter()
                        .flat_map(|part| part.weight.iter().copied())
                        .collect(),
                    bias: parts
                        .iter()
                        .flat_map(|part| part.bias.iter().copied())
                        .collect(),
                })
        } else {
            self.linear(&format!("{base}.attn.qkv"), 3 * dim, dim)
        };
        let proj = self.linear(&format!("{base}.{proj}"), dim, dim);
        let norm2 = self.norm(&format!("{base}.norm2"), dim);
        let fc1 = self.linear(&format!("{base}.mlp.fc1"), mlp_dim, dim);
        let fc2 = self.linear(&format!("{base}.mlp.fc2"), dim, mlp_dim);
        let [layer_scale1, layer_scale2] =
            scales.map(|name| layer_scale.then(|| self.take(&format!("{base}.{name}"), &[dim])));
        // A wanted but absent LayerScale is `Some(None)`: the whole block is then refused.
        let (layer_scale1, layer_scale2) = (flip(layer_scale1)?, flip(layer_scale2)?);
        Some(BlockWeights {
            norm1: norm1?,
            qkv: qkv?,
            proj: proj?,
            layer_scale1,
            norm2: norm2?,
            fc1: fc1?,
            fc2: fc2?,
            layer_scale2,
        })
    }

    fn linear(&mut self, name: &str, out: usize, input: usize) -> Option<Linear> {
        let weight = self.take(&format!("{name}.weight"), &[out, input]);
        let bias = self.take(&format!("{name}.bias"), &[out]);
        Some(Linear {
            weight: weight?,
            bias: bias?,
        })
    }

    fn norm(&mut self, name: &str, dim: usize) -> Option<Norm> {
        let weight = self.take(&format!("{name}.weight"), &[dim]);
        let bias = self.take(&format!("{name}.bias"), &[dim]);
        Some(Norm {
            weight: weight?,
            bias: bias?,
        })
    }

    fn take_positions(
        &mut self,
        name: &str,
        preset: Preset,
        dim: usize,
    ) -> Option<(Vec<f32>, (usize, usize))> {
        let full = format!("{}{name}", self.prefix);
        let entries = match self.tensors.get(&full)?.shape() {
            [1, entries, _] => *entries,
            _ => 0,
        };
        let Some(grid) = entries
            .checked_sub(1)
            .and_then(|patches| preset.position_grid(patches))
        else {
            let shape = self.tensors[&full].shape();
            self.problems.push(format!(
                "{full} is {shape:?}, no position table of {preset}"
            ));
            self.taken.insert(full);
            return None;
        };
        self.take(name, &[1, entries, dim])
            .map(|positions| (positions, grid))
    }

    fn take(&mut self, name: &str, shape: &[usize]) -> Option<Vec<f32>> {
        let name = format!("{}{name}", self.prefix);
        let Some(view) = self.tensors.get(&name) else {
            self.problems.push(format!("{name} {shape:?} is missing"));
            return None;
        };
        self.taken.insert(name.clone());
        if view.shape() != shape {
            self.problems
                .push(format!("{name} is {:?}, not {shape:?}", view.shape()));
            return None;
        }
        let Some(values) = to_f32(view) else {
            self.problems.push(format!(
                "{name} has type {:?}, not a 32- or 16-bit float",
                view.dtype()
            ));
            return None;
        };
        if values.iter().any(|value| !value.is_finite()) {
            self.problems
                .push(format!("{name} holds values that are not finite"));
            return None;
        }
        Some(values)
    }
}

fn flip<T>(wanted: Option<Option<T>>) -> Option<Option<T>> {
    match wanted {
        Some(None) => None,
        Some(found) => Some(found),
        None => Some(None),
    }
}

/// The values of a float tensor, or nothing for other types.
pub(in crate::extract) fn to_f32(view: &TensorView<'_>) -> Option<Vec<f32>> {
    let bytes = view.data();
    let pairs = || bytes.chunks_exact(2).map(|pair| [pair[0], pair[1]]);
    match view.dtype() {
        Dtype::F32 => Some(
            bytes
                .chunks_exact(4)
                .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
                .collect(),
        ),
        Dtype::F16 => Some(
            pairs()
                .map(|pair| f16::from_le_bytes(pair).to_f32())
                .collect(),
        ),
        Dtype::BF16 => Some(
            pairs()
                .map(|pair| bf16::from_le_bytes(pair).to_f32())
                .collect(),
        ),
        _ => None,
    }
}

#[cfg(test)]
mod tests;

//! From a safetensors file to [`VitWeights`]: every tensor by name and shape, or an error that
//! lists all that is wrong.

use super::vit_weights::{BlockWeights, Linear, Norm, VitWeights};
use crate::extract::error::ExtractError;
use crate::extract::preset::{Geometry, Preset};
use crate::extract::tensor_file::{TensorFile, to_f32};
use safetensors::tensor::{SafeTensors, TensorView};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Beginnings of the names of tensors that a published file may hold and this method does not use.
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
    /// Loads `path` as weights of `preset`.
    ///
    /// The number of attention heads cannot be seen from any tensor's shape. It is `heads` if
    /// given, else the file's `num_heads` metadata, else the preset's.
    ///
    /// # Errors
    /// [`ExtractError::WrongTensors`] names every tensor that is missing, unexpected, or of another
    /// shape or type; [`ExtractError::BadFile`] if the file as a whole is not usable, and
    /// [`ExtractError::Io`] if it cannot be read.
    pub fn load(path: &Path, preset: Preset, heads: Option<usize>) -> Result<Self, ExtractError> {
        let bytes = std::fs::read(path).map_err(ExtractError::io(path))?;
        Self::from_bytes(&bytes, path, preset, heads)
    }

    /// As [`VitWeights::load`], from the bytes of the file; `path` is named in errors.
    ///
    /// # Errors
    /// As [`VitWeights::load`], but for reading the file.
    pub fn from_bytes(
        bytes: &[u8],
        path: &Path,
        preset: Preset,
        heads: Option<usize>,
    ) -> Result<Self, ExtractError> {
        let file = TensorFile::parse(bytes, path)?;
        let geometry = geometry_of(&file, preset, heads)?;
        let mut reader = Reader::new(&file.tensors).ok_or_else(|| {
            file.bad("holds no vision transformer under a known naming (Hugging Face, timm, DINO)")
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
}

/// The preset's geometry with the head count of the settings or of the file.
fn geometry_of(
    file: &TensorFile<'_>,
    preset: Preset,
    heads: Option<usize>,
) -> Result<Geometry, ExtractError> {
    let mut geometry = preset.geometry();
    if let Some(text) = file.metadata.get("num_heads") {
        geometry.heads = text
            .parse()
            .map_err(|_| file.bad(format!("metadata num_heads is {text:?}, not a number")))?;
    }
    if let Some(heads) = heads {
        geometry.heads = heads;
    }
    if geometry.heads == 0 || !geometry.dim.is_multiple_of(geometry.heads) {
        return Err(file.bad(format!(
            "{} heads do not divide tokens of width {}",
            geometry.heads, geometry.dim
        )));
    }
    Ok(geometry)
}

/// How a file names its tensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Naming {
    /// `encoder.layer.0.attention.attention.query.weight`
    HuggingFace,
    /// `blocks.0.attn.qkv.weight`
    Fused,
}

/// The names of the tensors outside the blocks.
struct OuterNames {
    cls_token: &'static str,
    positions: &'static str,
    patch_embed: &'static str,
    norm: &'static str,
}

impl Naming {
    fn outer(self) -> OuterNames {
        match self {
            Self::HuggingFace => OuterNames {
                cls_token: "embeddings.cls_token",
                positions: "embeddings.position_embeddings",
                patch_embed: "embeddings.patch_embeddings.projection",
                norm: "layernorm",
            },
            Self::Fused => OuterNames {
                cls_token: "cls_token",
                positions: "pos_embed",
                patch_embed: "patch_embed.proj",
                norm: "norm",
            },
        }
    }

    /// Beginning of the names of block `index`.
    fn block(self, index: usize) -> String {
        match self {
            Self::HuggingFace => format!("encoder.layer.{index}"),
            Self::Fused => format!("blocks.{index}"),
        }
    }

    /// Name of the attention output layer within a block.
    fn proj(self) -> &'static str {
        match self {
            Self::HuggingFace => "attention.output.dense",
            Self::Fused => "attn.proj",
        }
    }

    /// Names of the two LayerScales within a block.
    fn layer_scales(self) -> [&'static str; 2] {
        match self {
            Self::HuggingFace => ["layer_scale1.lambda1", "layer_scale2.lambda1"],
            Self::Fused => ["ls1.gamma", "ls2.gamma"],
        }
    }
}

/// Takes tensors out of a file one by one. What is wrong is collected, so that one error can name
/// all of it; a method returns `None` if something it needs is not there.
struct Reader<'a> {
    naming: Naming,
    /// Common beginning of all names, such as `backbone.`; often empty.
    prefix: String,
    tensors: BTreeMap<String, TensorView<'a>>,
    /// Names of the tensors that were asked for.
    taken: BTreeSet<String>,
    problems: Vec<String>,
}

impl<'a> Reader<'a> {
    /// Recognises the naming by the position table, whose name ends the same under every prefix;
    /// `None` if there is no position table.
    fn new(file: &SafeTensors<'a>) -> Option<Self> {
        let tensors: BTreeMap<_, _> = file.tensors().into_iter().collect();
        let (naming, prefix) = tensors.keys().find_map(|name| recognise(name))?;
        Some(Self {
            naming,
            prefix,
            tensors,
            taken: BTreeSet::new(),
            problems: Vec::new(),
        })
    }

    /// All problems, among them tensors that nothing asked for, and the number of values in tensors
    /// that are known to be of no use here.
    fn finish(mut self) -> (Vec<String>, usize) {
        let mut unused_parameters = 0;
        for (name, view) in &self.tensors {
            let bare = name.strip_prefix(self.prefix.as_str()).unwrap_or(name);
            let is_unused = UNUSED
                .iter()
                .any(|known| bare.starts_with(known) || name.starts_with(known));
            if is_unused {
                unused_parameters += view.shape().iter().product::<usize>();
            } else if !self.taken.contains(name) {
                let shape = view.shape();
                self.problems
                    .push(format!("{name} {shape:?} is unexpected"));
            }
        }
        (self.problems, unused_parameters)
    }

    fn read(&mut self, preset: Preset, geometry: Geometry) -> Option<VitWeights> {
        let dim = geometry.dim;
        let patch = geometry.patch;
        let names = self.naming.outer();
        let embed = names.patch_embed;
        // All tensors are asked for before the first `?`, so that every problem is found.
        let cls_token = self.take(names.cls_token, &[1, 1, dim]);
        let positions = self.take_positions(names.positions, preset, dim);
        let patch_weight = self.take(&format!("{embed}.weight"), &[dim, 3, patch, patch]);
        let patch_bias = self.take(&format!("{embed}.bias"), &[dim]);
        let blocks: Vec<Option<BlockWeights>> = (0..geometry.depth)
            .map(|index| self.block(index, &geometry))
            .collect();
        let norm = self.norm(names.norm, dim);

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
            merged: None,
        })
    }

    fn block(&mut self, index: usize, geometry: &Geometry) -> Option<BlockWeights> {
        let dim = geometry.dim;
        let mlp_dim = geometry.mlp_dim;
        let base = self.naming.block(index);
        let proj = self.naming.proj();
        let scales = self.naming.layer_scales();
        // As in `read`, everything is asked for before the first `?`.
        let norm1 = self.norm(&format!("{base}.norm1"), dim);
        let qkv = self.qkv(&base, dim);
        let proj = self.linear(&format!("{base}.{proj}"), dim, dim);
        let norm2 = self.norm(&format!("{base}.norm2"), dim);
        let fc1 = self.linear(&format!("{base}.mlp.fc1"), mlp_dim, dim);
        let fc2 = self.linear(&format!("{base}.mlp.fc2"), dim, mlp_dim);
        let [scale1, scale2] =
            scales.map(|name| self.layer_scale(&format!("{base}.{name}"), geometry));
        Some(BlockWeights {
            norm1: norm1?,
            qkv: qkv?,
            proj: proj?,
            layer_scale1: scale1?,
            norm2: norm2?,
            fc1: fc1?,
            fc2: fc2?,
            layer_scale2: scale2?,
        })
    }

    /// Query, key and value in the fused form.
    fn qkv(&mut self, base: &str, dim: usize) -> Option<Linear> {
        if self.naming == Naming::Fused {
            return self.linear(&format!("{base}.attn.qkv"), 3 * dim, dim);
        }
        let parts = ["query", "key", "value"]
            .map(|part| self.linear(&format!("{base}.attention.attention.{part}"), dim, dim));
        let mut fused = Linear {
            weight: Vec::new(),
            bias: Vec::new(),
        };
        for part in parts {
            let part = part?;
            fused.weight.extend(part.weight);
            fused.bias.extend(part.bias);
        }
        Some(fused)
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

    /// `Some(None)` for a geometry without LayerScale, `None` if the tensor should be there and is
    /// not usable.
    fn layer_scale(&mut self, name: &str, geometry: &Geometry) -> Option<Option<Vec<f32>>> {
        if !geometry.layer_scale {
            return Some(None);
        }
        self.take(name, &[geometry.dim]).map(Some)
    }

    /// The position table, and its rows and columns.
    fn take_positions(
        &mut self,
        name: &str,
        preset: Preset,
        dim: usize,
    ) -> Option<(Vec<f32>, (usize, usize))> {
        let full = format!("{}{name}", self.prefix);
        let shape = self.tensors.get(&full)?.shape().to_vec();
        let entries = match shape[..] {
            [1, entries, _] => entries,
            _ => 0,
        };
        // The first entry belongs to the CLS token.
        let grid = entries
            .checked_sub(1)
            .and_then(|patches| preset.position_grid(patches));
        let Some(grid) = grid else {
            self.problems.push(format!(
                "{full} is {shape:?}, no position table of {preset}"
            ));
            self.taken.insert(full);
            return None;
        };
        let positions = self.take(name, &[1, entries, dim])?;
        Some((positions, grid))
    }

    /// The values of a tensor of exactly this shape.
    fn take(&mut self, name: &str, shape: &[usize]) -> Option<Vec<f32>> {
        let name = format!("{}{name}", self.prefix);
        let values = match self.tensors.get(&name) {
            Some(view) => checked_values(&name, view, shape),
            None => Err(format!("{name} {shape:?} is missing")),
        };
        self.taken.insert(name);
        match values {
            Ok(values) => Some(values),
            Err(problem) => {
                self.problems.push(problem);
                None
            }
        }
    }
}

/// The naming and the prefix, if `name` is a position table's.
fn recognise(name: &str) -> Option<(Naming, String)> {
    [Naming::HuggingFace, Naming::Fused]
        .into_iter()
        .find_map(|naming| {
            let prefix = name.strip_suffix(naming.outer().positions)?;
            Some((naming, prefix.to_owned()))
        })
}

/// The values of a tensor, or what is wrong with it.
fn checked_values(name: &str, view: &TensorView<'_>, shape: &[usize]) -> Result<Vec<f32>, String> {
    if view.shape() != shape {
        return Err(format!("{name} is {:?}, not {shape:?}", view.shape()));
    }
    let Some(values) = to_f32(view) else {
        let dtype = view.dtype();
        return Err(format!(
            "{name} has type {dtype:?}, not a 32- or 16-bit float"
        ));
    };
    if values.iter().any(|value| !value.is_finite()) {
        return Err(format!("{name} holds values that are not finite"));
    }
    Ok(values)
}

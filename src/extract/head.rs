//! The linear projection from the pooled token to the global descriptor (paper III-A), bound to one backbone.
//!
//! A head is a small safetensors file: `weight` `[256, d]`, `bias` `[256]`, and metadata that says which backbone's
//! tokens it was made for. It is applied to the L2-normalised mean token, and its output is L2-normalised. Heads for the
//! models that ship are built into the binary.

use super::error::ExtractError;
use super::global::l2_normalise;
use super::weights::{hex, to_f32, write_atomically};
use crate::types::GLOBAL_DIM;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Heads that ship, one per backbone.
const BUILT_IN: [&[u8]; 1] = [include_bytes!("../../models/dinov2-vits14-b8.safetensors")];

/// A projection d -> 256.
#[derive(Debug, Clone, PartialEq)]
pub struct Head {
    /// `[256, dim]` row-major.
    weight: Vec<f32>,
    /// `[256]`.
    bias: Vec<f32>,
    dim: usize,
    /// The backbone part of a `ModelId`.
    backbone: String,
    /// How it was made, for people.
    notes: BTreeMap<String, String>,
}

impl Head {
    /// Builds a head for `backbone` from `weight` `[256, dim]` and `bias` `[256]`; `notes` say how it was made.
    pub fn new(
        weight: Vec<f32>,
        bias: Vec<f32>,
        backbone: impl Into<String>,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        let dim = weight.len() / GLOBAL_DIM;
        let finite = weight.iter().chain(&bias).all(|value| value.is_finite());
        if dim == 0 || weight.len() != dim * GLOBAL_DIM || bias.len() != GLOBAL_DIM || !finite {
            let reason = format!("a head needs a finite [{GLOBAL_DIM}, d] weight and a [{GLOBAL_DIM}] bias");
            return Err(ExtractError::BadFile { path: "head".into(), reason });
        }
        Ok(Self { weight, bias, dim, backbone: backbone.into(), notes })
    }

    /// Loads a head file; refuses anything but its two tensors and its metadata.
    pub fn load(path: &Path) -> Result<Self, ExtractError> {
        Self::from_bytes(&std::fs::read(path).map_err(ExtractError::io(path))?, path)
    }

    /// The head built in for `backbone`, if there is one.
    pub fn built_in(backbone: &str) -> Result<Option<Self>, ExtractError> {
        for bytes in BUILT_IN {
            let head = Self::from_bytes(bytes, Path::new("built-in head"))?;
            if head.backbone == backbone {
                return Ok(Some(head));
            }
        }
        Ok(None)
    }

    /// As [`Head::load`], from the bytes of the file that `path` names in errors.
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self, ExtractError> {
        let bad = |reason: String| ExtractError::BadFile { path: path.to_owned(), reason };
        let broken = |e| bad(format!("truncated or not a safetensors file: {e}"));
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(broken)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(broken)?;
        let mut notes: BTreeMap<_, _> = metadata.metadata().clone().unwrap_or_default().into_iter().collect();
        let backbone = notes.remove("backbone").ok_or_else(|| bad("no head: its metadata names no backbone".into()))?;
        if let Some(name) = tensors.names().into_iter().find(|name| !["weight", "bias"].contains(name)) {
            return Err(bad(format!("unexpected tensor {name}; a head holds weight and bias")));
        }
        let take = |name: &str| {
            let view = tensors.tensor(name).map_err(|_| bad(format!("{name} is missing")))?;
            let right = match *view.shape() {
                [GLOBAL_DIM, dim] => name == "weight" && dim > 0,
                [GLOBAL_DIM] => name == "bias",
                _ => false,
            };
            match to_f32(&view).filter(|_| right) {
                Some(values) if values.iter().all(|v| v.is_finite()) => Ok(values),
                Some(_) => Err(bad(format!("{name} holds values that are not finite"))),
                None => {
                    Err(bad(format!("{name} is {:?} {:?}, not a float [256, d] or [256]", view.dtype(), view.shape())))
                }
            }
        };
        Self::new(take("weight")?, take("bias")?, backbone, notes)
    }

    /// Writes the head, atomically.
    pub fn save(&self, path: &Path) -> Result<(), ExtractError> {
        let bad =
            |e: safetensors::SafeTensorError| ExtractError::BadFile { path: path.to_owned(), reason: e.to_string() };
        let weight = TensorView::new(Dtype::F32, vec![GLOBAL_DIM, self.dim], bytemuck::cast_slice(&self.weight));
        let bias = TensorView::new(Dtype::F32, vec![GLOBAL_DIM], bytemuck::cast_slice(&self.bias));
        let mut metadata: HashMap<String, String> = self.notes.clone().into_iter().collect();
        metadata.insert("backbone".into(), self.backbone.clone());
        let tensors = [("weight", weight.map_err(bad)?), ("bias", bias.map_err(bad)?)];
        write_atomically(path, &safetensors::serialize(tensors, Some(metadata)).map_err(bad)?)
    }

    /// Width of the tokens it takes.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// The backbone whose tokens it takes, as [`crate::extract::Extractor::backbone`] writes it.
    pub fn backbone(&self) -> &str {
        &self.backbone
    }

    /// How it was made.
    pub fn notes(&self) -> &BTreeMap<String, String> {
        &self.notes
    }

    /// SHA-256 over weight and bias, hexadecimal: the head's part of a `ModelId`.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(bytemuck::cast_slice::<f32, u8>(&self.weight));
        hasher.update(bytemuck::cast_slice::<f32, u8>(&self.bias));
        hex(&hasher.finalize())
    }

    /// The global descriptor `[256]` of an L2-normalised pooled token `[dim]`.
    pub fn project(&self, pooled: &[f32]) -> Vec<f32> {
        let mut global: Vec<f32> = self.affine(pooled).iter().map(|&value| value as f32).collect();
        l2_normalise(&mut global);
        global
    }

    /// W x + b, before normalisation.
    pub(super) fn affine(&self, pooled: &[f32]) -> Vec<f64> {
        assert_eq!(pooled.len(), self.dim, "a head takes tokens of its own width");
        let row = |(row, &bias): (&[f32], &f32)| {
            row.iter().zip(pooled).map(|(&w, &x)| w as f64 * x as f64).sum::<f64>() + bias as f64
        };
        self.weight.chunks_exact(self.dim).zip(&self.bias).map(row).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head() -> Head {
        let weight = (0..GLOBAL_DIM * 8).map(|i| ((i * 37) % 101) as f32 / 50.0 - 1.0).collect();
        let notes = [("method".to_owned(), "test".to_owned())].into();
        Head::new(weight, vec![0.5; GLOBAL_DIM], "backbone-x", notes).unwrap()
    }

    #[test]
    fn a_head_survives_its_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("h.safetensors");
        head().save(&path).unwrap();
        let back = Head::load(&path).unwrap();
        assert_eq!(back, head());
        assert_eq!(back.content_hash(), head().content_hash());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no unfinished file is left");
    }

    #[test]
    fn a_damaged_head_is_refused_with_its_fault() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("h.safetensors");
        head().save(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let truncated = Head::from_bytes(&bytes[..bytes.len() - 5], &path).unwrap_err().to_string();
        assert!(truncated.contains("truncated"), "{truncated}");
        let values = [0f32; 12];
        let view = || TensorView::new(Dtype::F32, vec![3, 4], bytemuck::cast_slice(&values)).unwrap();
        let meta: HashMap<_, _> = [("backbone".to_owned(), "x".to_owned())].into();
        let wrong = safetensors::serialize([("weight", view()), ("bias", view())], Some(meta.clone())).unwrap();
        assert!(Head::from_bytes(&wrong, &path).unwrap_err().to_string().contains("weight is F32 [3, 4]"));
        let extra = safetensors::serialize([("mu", view())], Some(meta)).unwrap();
        assert!(Head::from_bytes(&extra, &path).unwrap_err().to_string().contains("unexpected tensor mu"));
        let unbound = safetensors::serialize([("weight", view())], None).unwrap();
        assert!(Head::from_bytes(&unbound, &path).unwrap_err().to_string().contains("backbone"));
    }

    #[test]
    fn projection_is_affine_then_unit_length() {
        let global = head().project(&[0.25; 8]);
        assert_eq!(global.len(), GLOBAL_DIM);
        assert!((global.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
        let raw: f32 = head().weight[..8].iter().sum::<f32>() * 0.25 + 0.5;
        let other: f32 = head().weight[8..16].iter().sum::<f32>() * 0.25 + 0.5;
        assert!((global[0] / global[1] - raw / other).abs() < 1e-4);
    }
}

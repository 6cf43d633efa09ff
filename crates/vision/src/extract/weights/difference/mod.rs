//! What training changed of a backbone: a small file beside the published weights.
//!
//! Training moves a few blocks of a backbone that everyone can fetch. What ships is therefore not
//! another backbone, but the difference to the published one, in half precision: either the
//! difference of whole tensors, or the two factors of a low-rank one (LoRA, Hu et al. 2022), which
//! is smaller still. It is merged when the model is loaded, so that extraction costs the same.
//!
//! A difference means nothing beside other weights. So it carries the content hash of those it
//! belongs to and is refused by all others, and a [`ModelId`](placeformer_core::types::ModelId)
//! names both.

mod file;
#[cfg(test)]
mod tests;

use super::vit_weights::VitWeights;
use crate::extract::error::ExtractError;
use crate::extract::preset::Preset;
use half::f16;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;

/// The change of some tensors of a backbone.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    preset: Preset,
    /// Content hash of the weights that it belongs to, hexadecimal.
    base: String,
    /// By the fused names of the tensors.
    changes: BTreeMap<String, Change>,
    /// How it was made, for people to read.
    notes: BTreeMap<String, String>,
}

/// The change of one tensor. Its values are those of half floats, so that a difference is the same
/// before and after its file.
#[derive(Debug, Clone, PartialEq)]
enum Change {
    /// One value for each of the tensor's.
    Whole(Vec<f32>),
    /// A product of two factors.
    LowRank(Factors),
}

/// The factors of the change `up * down` of a tensor `[out, in]`; further dimensions count as `in`.
#[derive(Debug, Clone, PartialEq)]
pub struct Factors {
    /// The rank r.
    pub rank: usize,
    /// `[out, r]` row-major.
    pub up: Vec<f32>,
    /// `[r, in]` row-major.
    pub down: Vec<f32>,
}

/// Which weights were merged with which difference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Merged {
    /// Content hash of the weights before.
    pub base: String,
    /// Content hash of the difference.
    pub difference: String,
}

impl Difference {
    /// What `trained` has that `base` has not: the difference of every tensor that is not the same.
    ///
    /// # Errors
    /// [`ExtractError::BadFile`] if the two have tensors of different names or lengths, nothing
    /// differs, or a difference is no finite half float.
    pub fn between(
        base: &VitWeights,
        trained: &VitWeights,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        let mut changes = BTreeMap::new();
        let trained = trained.tensors();
        let tensors = base.tensors();
        if tensors.len() != trained.len() {
            return Err(unusable("the two backbones have different tensors"));
        }
        for ((name, shape, before), (other, other_shape, after)) in tensors.iter().zip(&trained) {
            if (name, shape) != (other, other_shape) {
                return Err(unusable("the two backbones have different tensors"));
            }
            if before != after {
                let change = after.iter().zip(*before).map(|(a, b)| a - b).collect();
                changes.insert(name.clone(), Change::Whole(change));
            }
        }
        Self::new(base, changes, notes)
    }

    /// Low-rank changes of the tensors with these fused names.
    ///
    /// # Errors
    /// [`ExtractError::BadFile`] if there is none, a tensor has no such name or other lengths, or a
    /// factor is no finite half float.
    pub fn of_factors(
        base: &VitWeights,
        factors: BTreeMap<String, Factors>,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        let changes = factors
            .into_iter()
            .map(|(name, factors)| (name, Change::LowRank(factors)))
            .collect();
        Self::new(base, changes, notes)
    }

    fn new(
        base: &VitWeights,
        mut changes: BTreeMap<String, Change>,
        notes: BTreeMap<String, String>,
    ) -> Result<Self, ExtractError> {
        for part in changes.values_mut().flat_map(Change::parts_mut) {
            for value in part.iter_mut() {
                *value = f16::from_f32(*value).to_f32();
            }
        }
        let difference = Self {
            preset: base.preset,
            base: base.content_hash(),
            changes,
            notes,
        };
        difference.check_values().map_err(unusable)?;
        difference.check_shapes(base).map_err(unusable)?;
        Ok(difference)
    }

    /// The content hash of the weights that it belongs to, hexadecimal.
    pub fn base(&self) -> &str {
        &self.base
    }

    /// How it was made.
    pub fn notes(&self) -> &BTreeMap<String, String> {
        &self.notes
    }

    /// SHA-256 over what it changes and how, hexadecimal: its part of a
    /// [`ModelId`](placeformer_core::types::ModelId). The notes do not count.
    pub fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(self.base.as_bytes());
        for (name, change) in &self.changes {
            hasher.update(format!("{name}{:?}", change.rank()));
            for part in change.parts() {
                hasher.update((part.len() as u64).to_le_bytes());
                hasher.update(bytemuck::cast_slice::<f32, u8>(part));
            }
        }
        hex::encode(hasher.finalize())
    }

    /// `base` with the changes.
    ///
    /// # Errors
    /// [`ExtractError::DifferenceMismatch`] if it belongs to other weights;
    /// [`ExtractError::BadFile`] if it names a tensor that they do not have, or of another shape.
    pub fn merge(&self, base: &VitWeights) -> Result<VitWeights, ExtractError> {
        let hash = base.content_hash();
        // Merged weights have tensors of their own, so their hash tells them apart, too.
        if hash != self.base {
            return Err(ExtractError::DifferenceMismatch {
                base: self.base.clone(),
                weights: hash,
            });
        }
        self.check_shapes(base).map_err(unusable)?;
        let mut merged = base.clone();
        for (name, shape, values) in base.tensors() {
            if let Some(change) = self.changes.get(&name) {
                let rows = shape.first().copied().unwrap_or(1);
                let sums = change.added_to(values, rows);
                if sums.iter().any(|value| !value.is_finite()) {
                    return Err(unusable(format!("with its change {name} is not finite")));
                }
                merged.replace(&name, &sums);
            }
        }
        merged.merged = Some(Merged {
            base: hash,
            difference: self.content_hash(),
        });
        Ok(merged)
    }

    /// Says which value cannot be computed with, or that nothing is changed.
    fn check_values(&self) -> Result<(), String> {
        if self.changes.is_empty() {
            return Err("it changes nothing".to_owned());
        }
        for (name, change) in &self.changes {
            let mut values = change.parts().into_iter().flatten();
            if !values.all(|value| value.is_finite()) {
                return Err(format!("the change of {name} is no finite half float"));
            }
        }
        Ok(())
    }

    /// Says which change fits no tensor of `weights`.
    fn check_shapes(&self, weights: &VitWeights) -> Result<(), String> {
        let shapes: BTreeMap<String, Vec<usize>> = weights
            .tensors()
            .into_iter()
            .map(|(name, shape, _)| (name, shape))
            .collect();
        for (name, change) in &self.changes {
            let Some(shape) = shapes.get(name) else {
                return Err(format!("the backbone has no tensor {name}"));
            };
            if !change.fits(shape) {
                return Err(format!("its change of {name} does not fit {shape:?}"));
            }
        }
        Ok(())
    }
}

impl Change {
    /// All values: one part of a whole change, up and down of a low-rank one.
    fn parts(&self) -> Vec<&[f32]> {
        match self {
            Self::Whole(values) => vec![values.as_slice()],
            Self::LowRank(factors) => vec![factors.up.as_slice(), factors.down.as_slice()],
        }
    }

    fn parts_mut(&mut self) -> Vec<&mut [f32]> {
        match self {
            Self::Whole(values) => vec![values.as_mut_slice()],
            Self::LowRank(factors) => {
                vec![factors.up.as_mut_slice(), factors.down.as_mut_slice()]
            }
        }
    }

    fn rank(&self) -> Option<usize> {
        match self {
            Self::Whole(_) => None,
            Self::LowRank(factors) => Some(factors.rank),
        }
    }

    fn fits(&self, shape: &[usize]) -> bool {
        let count: usize = shape.iter().product();
        match self {
            Self::Whole(values) => values.len() == count,
            Self::LowRank(factors) => {
                let rows = shape.first().copied().unwrap_or(0);
                let columns = count.checked_div(rows).unwrap_or(0);
                factors.rank > 0
                    && factors.up.len() == rows * factors.rank
                    && factors.down.len() == columns * factors.rank
            }
        }
    }

    /// The sum of a tensor of `rows` rows and its change.
    fn added_to(&self, values: &[f32], rows: usize) -> Vec<f32> {
        match self {
            Self::Whole(changes) => values.iter().zip(changes).map(|(a, b)| a + b).collect(),
            Self::LowRank(Factors { rank, up, down }) => {
                let columns = values.len() / rows;
                let mut sums = values.to_vec();
                for (sums, up) in sums.chunks_exact_mut(columns).zip(up.chunks_exact(*rank)) {
                    for (&factor, down) in up.iter().zip(down.chunks_exact(columns)) {
                        for (sum, value) in sums.iter_mut().zip(down) {
                            *sum += factor * value;
                        }
                    }
                }
                sums
            }
        }
    }
}

/// A difference that is not in a file yet, or no longer.
fn unusable(reason: impl Into<String>) -> ExtractError {
    ExtractError::BadFile {
        path: "difference".into(),
        reason: reason.into(),
    }
}

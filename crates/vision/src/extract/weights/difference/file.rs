//! Differences in files.
//!
//! A safetensors file of half floats. A tensor with the fused name of one of the backbone's is its
//! whole change; `NAME.up` `[out, r]` and `NAME.down` `[r, in]` are the factors of a low-rank one.
//! The metadata say which weights it belongs to: `difference_of`, their content hash, and `preset`.
//! All other metadata are notes for people.

use super::{Change, Difference, Factors};
use crate::extract::error::ExtractError;
use crate::extract::preset::Preset;
use crate::extract::tensor_file::{TensorFile, to_f32};
use half::f16;
use placeformer_core::files::write_atomically;
use safetensors::tensor::{Dtype, SafeTensorError, TensorView};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Metadata that holds the content hash of the weights.
const BASE: &str = "difference_of";
const PRESET: &str = "preset";
/// Endings of the names of two factors.
const UP: &str = ".up";
const DOWN: &str = ".down";

impl Difference {
    /// Loads the file at `path`.
    ///
    /// # Errors
    /// [`ExtractError::Io`] if it cannot be read; [`ExtractError::BadFile`] if it is no difference,
    /// a factor lacks its other one, or a value is not finite.
    pub fn load(path: &Path) -> Result<Self, ExtractError> {
        let bytes = std::fs::read(path).map_err(ExtractError::io(path))?;
        Self::from_bytes(&bytes, path)
    }

    /// As [`Difference::load`], from the bytes of the file; `path` is named in errors.
    ///
    /// # Errors
    /// As [`Difference::load`], but for reading the file.
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self, ExtractError> {
        let file = TensorFile::parse(bytes, path)?;
        let mut notes: BTreeMap<String, String> = file.metadata.clone().into_iter().collect();
        let base = notes.remove(BASE).ok_or_else(|| {
            file.bad("no difference: its metadata do not say which weights it belongs to")
        })?;
        let preset = notes.remove(PRESET).unwrap_or_default();
        let preset = preset
            .parse::<Preset>()
            .map_err(|error| file.bad(format!("{error}")))?;
        let difference = Self {
            preset,
            base,
            changes: read_changes(&file)?,
            notes,
        };
        difference
            .check_values()
            .map_err(|reason| file.bad(reason))?;
        Ok(difference)
    }

    /// Writes the difference to `path`. The file appears complete or not at all.
    ///
    /// # Errors
    /// [`ExtractError::Io`] if the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), ExtractError> {
        let bad = |error: SafeTensorError| ExtractError::BadFile {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let tensors = self.half_tensors();
        let mut views = Vec::new();
        for (name, shape, bytes) in &tensors {
            let view = TensorView::new(Dtype::F16, shape.clone(), bytes).map_err(bad)?;
            views.push((name, view));
        }
        let mut metadata: HashMap<String, String> = self.notes.clone().into_iter().collect();
        metadata.insert(BASE.to_owned(), self.base.clone());
        metadata.insert(PRESET.to_owned(), self.preset.to_string());
        let bytes = safetensors::serialize(views, Some(metadata)).map_err(bad)?;
        write_atomically(path, &bytes).map_err(ExtractError::io(path))
    }

    /// Names, shapes and bytes of the file's tensors. A whole change is flat, because its shape is
    /// the backbone's.
    fn half_tensors(&self) -> Vec<(String, Vec<usize>, Vec<u8>)> {
        let mut tensors = Vec::new();
        for (name, change) in &self.changes {
            match change {
                Change::Whole(values) => {
                    tensors.push((name.clone(), vec![values.len()], halves(values)));
                }
                Change::LowRank(Factors { rank, up, down }) => {
                    let up_shape = vec![up.len() / rank, *rank];
                    let down_shape = vec![*rank, down.len() / rank];
                    tensors.push((format!("{name}{UP}"), up_shape, halves(up)));
                    tensors.push((format!("{name}{DOWN}"), down_shape, halves(down)));
                }
            }
        }
        tensors
    }
}

fn halves(values: &[f32]) -> Vec<u8> {
    let bytes = |&value: &f32| f16::from_f32(value).to_le_bytes();
    values.iter().flat_map(bytes).collect()
}

fn read_changes(file: &TensorFile<'_>) -> Result<BTreeMap<String, Change>, ExtractError> {
    let mut changes = BTreeMap::new();
    for name in file.tensors.names() {
        if let Some(target) = name.strip_suffix(UP) {
            let factors = read_factors(file, target)?;
            changes.insert(target.to_owned(), Change::LowRank(factors));
        } else if let Some(target) = name.strip_suffix(DOWN) {
            // Read with the other factor, which must be there.
            read_values(file, &format!("{target}{UP}"))?;
        } else {
            let (_, values) = read_values(file, name)?;
            changes.insert(name.to_owned(), Change::Whole(values));
        }
    }
    Ok(changes)
}

fn read_factors(file: &TensorFile<'_>, target: &str) -> Result<Factors, ExtractError> {
    let (up_shape, up) = read_values(file, &format!("{target}{UP}"))?;
    let (down_shape, down) = read_values(file, &format!("{target}{DOWN}"))?;
    match (&up_shape[..], &down_shape[..]) {
        (&[_, rank], &[other, _]) if rank == other && rank > 0 => Ok(Factors { rank, up, down }),
        _ => Err(file.bad(format!(
            "the factors of {target} are {up_shape:?} and {down_shape:?}, \
             which have no common rank"
        ))),
    }
}

/// The shape of a tensor, and its values.
fn read_values(file: &TensorFile<'_>, name: &str) -> Result<(Vec<usize>, Vec<f32>), ExtractError> {
    let Ok(view) = file.tensors.tensor(name) else {
        return Err(file.bad(format!("{name} is missing")));
    };
    if view.dtype() != Dtype::F16 {
        let dtype = view.dtype();
        return Err(file.bad(format!("{name} has type {dtype:?}, not half floats")));
    }
    let values = to_f32(&view).unwrap_or_default();
    Ok((view.shape().to_vec(), values))
}

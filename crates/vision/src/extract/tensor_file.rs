//! Reading safetensors files: what weights and heads have in common.

use super::error::ExtractError;
use half::{bf16, f16};
use placeformer_core::types::Metadata;
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// The length of the header comes first, as a 64-bit integer.
const HEADER_LENGTH_BYTES: usize = 8;

/// A safetensors file in memory: its tensors, and the metadata in its header.
pub(super) struct TensorFile<'a> {
    /// Named in errors.
    pub path: PathBuf,
    pub tensors: SafeTensors<'a>,
    pub metadata: HashMap<String, String>,
}

impl<'a> TensorFile<'a> {
    /// Parses `bytes`, the content of the file at `path`.
    ///
    /// # Errors
    /// [`ExtractError::BadFile`] if the bytes are not a complete safetensors file, or a name occurs
    /// twice in its header.
    pub fn parse(bytes: &'a [u8], path: &Path) -> Result<Self, ExtractError> {
        let broken = |error: SafeTensorError| ExtractError::BadFile {
            path: path.to_owned(),
            reason: format!("truncated or not a safetensors file: {error}"),
        };
        let (header_bytes, header) = SafeTensors::read_metadata(bytes).map_err(broken)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(broken)?;
        // The reader above takes the last of several; another reader may take the first.
        let (_, rest) = bytes.split_at(HEADER_LENGTH_BYTES);
        let header_text = String::from_utf8_lossy(&rest[..header_bytes]);
        Metadata::parse(&header_text).map_err(|error| ExtractError::BadFile {
            path: path.to_owned(),
            reason: format!("its header is ambiguous: {}", error.reason),
        })?;
        Ok(Self {
            path: path.to_owned(),
            tensors,
            metadata: header.metadata().clone().unwrap_or_default(),
        })
    }

    /// An error about this file.
    pub fn bad(&self, reason: impl Into<String>) -> ExtractError {
        ExtractError::BadFile {
            path: self.path.clone(),
            reason: reason.into(),
        }
    }
}

/// The values of a tensor of floats (32 or 16 bits), or `None` for other types.
pub(super) fn to_f32(view: &TensorView<'_>) -> Option<Vec<f32>> {
    let bytes = view.data();
    let from_pairs = |convert: fn([u8; 2]) -> f32| -> Vec<f32> {
        let (pairs, _) = bytes.as_chunks::<2>();
        pairs.iter().map(|&pair| convert(pair)).collect()
    };
    match view.dtype() {
        Dtype::F32 => {
            let (words, _) = bytes.as_chunks::<4>();
            Some(words.iter().map(|&word| f32::from_le_bytes(word)).collect())
        }
        Dtype::F16 => Some(from_pairs(|pair| f16::from_le_bytes(pair).to_f32())),
        Dtype::BF16 => Some(from_pairs(|pair| bf16::from_le_bytes(pair).to_f32())),
        _ => None,
    }
}

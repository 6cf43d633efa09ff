//! A normalised image to its descriptor: transformer, global descriptor, fusion, selection (paper III-A to III-C).

use crate::error::ErrorCode;
use crate::types::{Descriptor, ImageSize, ImageTensor, ModelId};
use std::path::Path;

/// Settings of extraction.
#[derive(Debug, Clone, PartialEq, Default, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ExtractConfig {}

/// Why extraction, or loading what it needs, failed.
#[derive(Debug, thiserror::Error)]
pub enum ExtractError {}

impl ExtractError {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match *self {}
    }
}

/// A loaded model with its head.
pub struct Extractor {}

impl Extractor {
    /// Loads weights and head; refuses files that do not fit by name, shape or hash.
    pub fn load(_config: &ExtractConfig, _weights: &Path, _head: Option<&Path>) -> Result<Self, ExtractError> {
        unimplemented!()
    }

    /// What its descriptors may be compared with.
    pub fn model_id(&self) -> &ModelId {
        unimplemented!()
    }

    /// The size images must be resized to.
    pub fn input_size(&self) -> ImageSize {
        unimplemented!()
    }

    /// One descriptor per image; a batch gives bit for bit what single images give.
    pub fn extract(&self, _images: &[ImageTensor]) -> Result<Vec<Descriptor>, ExtractError> {
        unimplemented!()
    }
}

//! The nouns every stage shares. No I/O, no policy: only values that are valid by construction.

mod calibration;
mod deadline;
mod descriptor;
mod ids;
mod reference;

pub use crate::geography::{GeoCircle, GeoPoint, Heading};
pub use calibration::{Calibration, ConfidenceCurve, ConfidenceWeights};
pub use deadline::Deadline;
pub use descriptor::{
    Descriptor, GLOBAL_DIM, ImageSize, ImageTensor, KeyPatches, PackedPatches, PatchGrid,
    PoolingStride, SCALES, ScaleKeyPatches, ScaleSet,
};
pub use ids::{ContentHash, ExternalId, InvalidName, MapName, ModelId, ReferenceId, RerankId};
pub use reference::{NewReference, Reference, ReferenceFields, ReferenceFilter};

/// A value that breaks a type's own rule, with the rule in its message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {reason}")]
pub struct InvalidValue {
    /// Which field or parameter.
    pub field: &'static str,
    /// What is wrong with it, including the value given.
    pub reason: String,
}

impl InvalidValue {
    /// Builds the error for `field`.
    pub fn new(field: &'static str, reason: impl Into<String>) -> Self {
        Self {
            field,
            reason: reason.into(),
        }
    }
}

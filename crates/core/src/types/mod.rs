//! The nouns every stage shares. No I/O, no policy: only values that are valid by construction.
//!
//! A type checks its rule where a value enters, through `new`, `FromStr` or `Deserialize`, so no
//! later stage has to check again.

mod calibration;
mod deadline;
mod descriptor;
mod ids;
mod metadata;
mod reference;
mod score;
mod timestamp;

pub use crate::geography::{Altitude, GeoCircle, GeoPoint, Heading};
pub use crate::invalid::{InvalidName, InvalidValue};
pub use calibration::{Calibration, ConfidenceCurve, ConfidenceWeights};
pub use deadline::Deadline;
pub use descriptor::{
    Descriptor, GLOBAL_DIM, ImageSize, ImageTensor, KeyPatches, PackedPatches, PatchGrid,
    PoolingStride, SCALES, ScaleKeyPatches, ScaleSet,
};
pub use ids::{ContentHash, ExternalId, MapName, ModelId, ReferenceId, RerankId};
pub use metadata::Metadata;
pub use reference::{NewReference, Reference, ReferenceFields, ReferenceFilter};
pub use score::{LearnedScore, ScoreKind, ScoreTerm};
pub use timestamp::Timestamp;

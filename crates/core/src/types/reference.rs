//! A reference: one geo-tagged photo of a map, as its metadata.

use super::{
    ContentHash, Descriptor, ExternalId, GeoCircle, GeoPoint, Heading, MapName, ModelId,
    ReferenceId,
};
use time::OffsetDateTime;

/// What the map builder says about a photo.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ReferenceFields {
    /// The builder's own name for it, unique in the map.
    pub external_id: Option<ExternalId>,
    /// Where it was taken; absent on indoor maps.
    pub location: Option<GeoPoint>,
    /// Where the camera looked.
    pub heading: Option<Heading>,
    /// When it was taken.
    pub captured_at: Option<OffsetDateTime>,
    /// Anything else; a JSON object, returned as it came.
    pub metadata: Option<serde_json::Map<String, serde_json::Value>>,
}

/// A reference about to be stored.
#[derive(Debug, Clone)]
pub struct NewReference {
    /// Its map; created on first use.
    pub map: MapName,
    /// What the builder said.
    pub fields: ReferenceFields,
    /// Hash of the image bytes.
    pub content_hash: ContentHash,
    /// The model that made `descriptor`.
    pub model: ModelId,
    /// What the model saw.
    pub descriptor: Descriptor,
}

/// A stored reference without its descriptor.
#[derive(Debug, Clone, PartialEq)]
pub struct Reference {
    /// Identity.
    pub id: ReferenceId,
    /// Its map.
    pub map: MapName,
    /// What the builder said.
    pub fields: ReferenceFields,
    /// Hash of the image bytes.
    pub content_hash: ContentHash,
    /// The model that made its descriptor.
    pub model: ModelId,
    /// When it was committed.
    pub created_at: OffsetDateTime,
}

/// Which references of a map a search may return. Empty means all.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReferenceFilter {
    /// Only references located inside; those without a location never are.
    pub near: Option<GeoCircle>,
    /// Only references captured at or after this instant; those without a time never are.
    pub captured_after: Option<OffsetDateTime>,
    /// Only references captured before this instant; those without a time never are.
    pub captured_before: Option<OffsetDateTime>,
}

impl ReferenceFilter {
    /// Whether every reference passes.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Whether a reference with this location and capture time passes.
    pub fn accepts(&self, location: Option<GeoPoint>, captured_at: Option<OffsetDateTime>) -> bool {
        self.near
            .is_none_or(|circle| location.is_some_and(|point| circle.contains(point)))
            && self
                .captured_after
                .is_none_or(|start| captured_at.is_some_and(|time| time >= start))
            && self
                .captured_before
                .is_none_or(|end| captured_at.is_some_and(|time| time < end))
    }
}

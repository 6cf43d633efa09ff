//! A reference: one geo-tagged photo of a map, as its metadata.

use super::descriptor::Descriptor;
use super::ids::{ContentHash, ExternalId, MapName, ModelId, ReferenceId};
use super::metadata::Metadata;
use super::timestamp::Timestamp;
use crate::geography::{Altitude, GeoCircle, GeoPoint, Heading};

/// What the map builder says about a photo.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ReferenceFields {
    /// The builder's own name for it, unique in the map.
    pub external_id: Option<ExternalId>,
    /// Where it was taken; absent on indoor maps.
    pub location: Option<GeoPoint>,
    /// How high it was taken.
    pub alt: Option<Altitude>,
    /// Where the camera looked.
    pub heading: Option<Heading>,
    /// When it was taken.
    pub captured_at: Option<Timestamp>,
    /// Anything else.
    pub metadata: Option<Metadata>,
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
    pub created_at: Timestamp,
}

/// Which references of a map a search may return. Empty means all.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReferenceFilter {
    /// Only references located inside; those without a location never are.
    pub near: Option<GeoCircle>,
    /// Only references captured at or after this instant; those without a time never are.
    pub captured_after: Option<Timestamp>,
    /// Only references captured before this instant; those without a time never are.
    pub captured_before: Option<Timestamp>,
}

impl ReferenceFilter {
    /// Whether every reference passes.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Whether a reference with this location and capture time passes.
    pub fn accepts(&self, location: Option<GeoPoint>, captured_at: Option<Timestamp>) -> bool {
        let is_near = match self.near {
            Some(circle) => location.is_some_and(|point| circle.contains(point)),
            None => true,
        };
        let is_late_enough = match self.captured_after {
            Some(start) => captured_at.is_some_and(|time| time >= start),
            None => true,
        };
        let is_early_enough = match self.captured_before {
            Some(end) => captured_at.is_some_and(|time| time < end),
            None => true,
        };
        is_near && is_late_enough && is_early_enough
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use time::Duration;
    use time::macros::datetime;

    const HERE: (f64, f64) = (51.0, 7.0);

    /// Noon and so many hours.
    fn noon_and(hours: Duration) -> Timestamp {
        Timestamp::of(datetime!(2024-05-01 12:00 UTC) + hours).unwrap()
    }

    fn point((lat, lon): (f64, f64)) -> Option<GeoPoint> {
        Some(GeoPoint::new(lat, lon).unwrap())
    }

    #[test]
    fn an_empty_filter_accepts_everything() {
        let filter = ReferenceFilter::default();
        assert!(filter.is_empty());
        assert!(filter.accepts(None, None));
    }

    #[test]
    fn a_reference_without_a_location_or_time_fails_a_filter_that_asks_for_it() {
        let near = ReferenceFilter {
            near: Some(GeoCircle::new(point(HERE).unwrap(), 100.0).unwrap()),
            ..Default::default()
        };
        assert!(near.accepts(point(HERE), None));
        assert!(!near.accepts(point((51.01, 7.0)), None));
        assert!(!near.accepts(None, None));
        let recent = ReferenceFilter {
            captured_after: Some(noon_and(Duration::ZERO)),
            ..Default::default()
        };
        assert!(!recent.accepts(None, None));
    }

    #[test]
    fn the_start_of_a_time_range_belongs_to_it_and_the_end_does_not() {
        let filter = ReferenceFilter {
            captured_after: Some(noon_and(Duration::ZERO)),
            captured_before: Some(noon_and(Duration::HOUR)),
            ..Default::default()
        };
        assert!(filter.accepts(None, Some(noon_and(Duration::ZERO))));
        assert!(!filter.accepts(None, Some(noon_and(-Duration::SECOND))));
        assert!(!filter.accepts(None, Some(noon_and(Duration::HOUR))));
    }
}

//! Shapes shared by several answers.

use crate::http::answer;
use crate::http::codec::Workload;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use crate::pipeline::{FieldSource, FieldSources, Timings};
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::response::Response;
use placeformer_core::types::{Altitude, GeoPoint, Heading, Metadata, Reference, Timestamp};
use serde::de::value::MapAccessDeserializer;
use serde::de::{Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::fmt::Write;
use utoipa::ToSchema;

/// Header with the time in each stage.
const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");

/// Width and height in pixels.
#[derive(Debug, Serialize, ToSchema)]
pub struct SizeBody {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Where a photo was taken and where its camera looked.
#[derive(Debug, Serialize, ToSchema)]
pub struct LocationBody {
    /// Latitude in degrees; null on an indoor map.
    pub lat: Option<f64>,
    /// Longitude in degrees; null on an indoor map.
    pub lon: Option<f64>,
    /// Metres above the WGS84 ellipsoid, or above what the map's builder measures from.
    pub alt: Option<f64>,
    /// Degrees clockwise from north.
    pub heading: Option<f64>,
}

/// A stored reference.
#[derive(Debug, Serialize, ToSchema)]
pub struct ReferenceBody {
    /// Its identity.
    #[schema(format = Uuid, example = "0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f")]
    pub id: String,
    /// Its map.
    #[schema(example = "harbour")]
    pub map: String,
    /// The builder's own name for it.
    #[schema(example = "drive7/000123.jpg")]
    pub external_id: Option<String>,
    /// Where it was taken.
    pub location: Option<LocationBody>,
    /// When it was taken.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub captured_at: Option<Timestamp>,
    /// Anything else the builder said.
    #[schema(value_type = Option<Object>)]
    pub metadata: Option<Metadata>,
    /// SHA-256 of the image as it was sent, in hexadecimal.
    pub content_sha256: String,
    /// The model that made its descriptor.
    pub model: String,
    /// When it was committed.
    #[schema(value_type = String, format = DateTime)]
    pub created_at: Timestamp,
}

impl From<Reference> for ReferenceBody {
    fn from(reference: Reference) -> Self {
        Self {
            id: reference.id.to_string(),
            map: reference.map.to_string(),
            location: location(&reference),
            external_id: reference.fields.external_id.map(String::from),
            captured_at: reference.fields.captured_at,
            metadata: reference.fields.metadata,
            content_sha256: reference.content_hash.to_string(),
            model: reference.model.to_string(),
            created_at: reference.created_at,
        }
    }
}

/// A reference as the answer to its upload.
#[derive(Debug, Serialize, ToSchema)]
pub struct NewReferenceBody {
    #[serde(flatten)]
    reference: ReferenceBody,
    /// Where its fields come from.
    sources: SourcesBody,
}

/// Where the fields of a reference come from; null where it has no value.
#[derive(Debug, Serialize, ToSchema)]
pub struct SourcesBody {
    /// That of latitude and longitude.
    location: Option<SourceName>,
    /// That of the height.
    alt: Option<SourceName>,
    /// That of the heading.
    heading: Option<SourceName>,
    /// That of the time.
    captured_at: Option<SourceName>,
}

/// Where a field comes from: `request`, the photo's own `exif` or `xmp`, or `stored`, where the
/// photo was there before and its fields are as they were.
#[derive(Debug, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum SourceName {
    /// The request.
    Request,
    /// The photo's EXIF.
    Exif,
    /// The photo's XMP.
    Xmp,
    /// It was stored before.
    Stored,
}

impl From<FieldSource> for SourceName {
    fn from(source: FieldSource) -> Self {
        match source {
            FieldSource::Request => Self::Request,
            FieldSource::Exif => Self::Exif,
            FieldSource::Xmp => Self::Xmp,
            FieldSource::Stored => Self::Stored,
        }
    }
}

impl NewReferenceBody {
    /// The answer for a reference whose fields come from `sources`.
    pub fn new(reference: Reference, sources: FieldSources) -> Self {
        Self {
            reference: reference.into(),
            sources: SourcesBody {
                location: sources.location.map(Into::into),
                alt: sources.alt.map(Into::into),
                heading: sources.heading.map(Into::into),
                captured_at: sources.captured_at.map(Into::into),
            },
        }
    }
}

/// Location, height and heading of a reference, if it has any of them.
pub fn location(reference: &Reference) -> Option<LocationBody> {
    let point = reference.fields.location;
    let heading = reference.fields.heading;
    let alt = reference.fields.alt;
    if point.is_none() && heading.is_none() && alt.is_none() {
        return None;
    }
    Some(LocationBody {
        lat: point.map(GeoPoint::lat),
        lon: point.map(GeoPoint::lon),
        alt: alt.map(Altitude::metres),
        heading: heading.map(Heading::degrees),
    })
}

/// A position from its two coordinates, which are given together or not at all.
///
/// # Errors
/// `invalid_parameter` for one without the other, and for a value out of range.
pub fn point(lat: Option<f64>, lon: Option<f64>) -> Result<Option<GeoPoint>, ApiError> {
    match (lat, lon) {
        (Some(lat), Some(lon)) => Ok(Some(GeoPoint::new(lat, lon)?)),
        (None, None) => Ok(None),
        _ => Err(ApiError::invalid(
            "lat and lon belong together: give both or neither",
        )),
    }
}

/// Milliseconds per stage; a stage that ran twice counts once, with its sum.
pub fn timings_ms(timings: &Timings) -> BTreeMap<&'static str, f64> {
    let mut sums = BTreeMap::new();
    for (stage, took) in timings.iter() {
        let whole_microseconds = (took.as_secs_f64() * 1e6).round();
        *sums.entry(stage.as_str()).or_insert(0.0) += whole_microseconds / 1e3;
    }
    sums
}

/// JSON with the timings in a `Server-Timing` header.
///
/// # Errors
/// `overloaded` if too many bytes of answers wait to be taken; `internal` if the body cannot be
/// written as JSON. Nothing is answered then with the status of success.
pub async fn timed<T: Serialize>(
    state: &AppState,
    status: StatusCode,
    timings: &Timings,
    make: impl FnOnce() -> T + Send + 'static,
) -> Result<Response, ApiError> {
    let mut header = String::new();
    for (stage, ms) in timings_ms(timings) {
        let comma = if header.is_empty() { "" } else { ", " };
        // Writing to a string cannot fail.
        let _ = write!(header, "{comma}{stage};dur={ms}");
    }
    let mut response = answer::json(state, Workload::Small, make).await?;
    *response.status_mut() = status;
    if !header.is_empty()
        && let Ok(value) = HeaderValue::from_str(&header)
    {
        response.headers_mut().insert(SERVER_TIMING, value);
    }
    Ok(response)
}

/// Reads metadata from a JSON object, or from a string with the text of one, which is how it comes
/// in a query string.
///
/// # Errors
/// The value is something else.
pub fn metadata<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Metadata>, D::Error> {
    deserializer.deserialize_any(MetadataVisitor)
}

struct MetadataVisitor;

impl<'de> Visitor<'de> for MetadataVisitor {
    type Value = Option<Metadata>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON object")
    }

    fn visit_unit<E: Error>(self) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
        Metadata::parse(text).map(Some).map_err(E::custom)
    }

    fn visit_map<A: MapAccess<'de>>(self, entries: A) -> Result<Self::Value, A::Error> {
        Metadata::deserialize(MapAccessDeserializer::new(entries)).map(Some)
    }
}

/// Tells a field that is absent (`None`) from one that is null (`Some(None)`).
///
/// # Errors
/// The value is not a `T`.
pub fn present<'de, T: Deserialize<'de>, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<Option<T>>, D::Error> {
    Option::deserialize(deserializer).map(Some)
}

//! `/references`: the photos that make up the maps.

use super::shapes::{NewReferenceBody, ReferenceBody, metadata, point, present, timed};
use crate::http::access::Access;
use crate::http::answer;
use crate::http::body::{ImageUpload, read_json, read_query, read_upload};
use crate::http::codec::Workload;
use crate::http::examples;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use crate::pipeline::{IngestAnswer, IngestRequest};
use axum::Extension;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    Altitude, ExternalId, Heading, MapName, Metadata, ReferenceFields, ReferenceId, Timestamp,
};
use placeformer_store::{Cursor, ReferencePatch};
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, PartialSchema, ToSchema};

/// What the body of a new reference consists of.
pub static UPLOAD: ImageUpload = ImageUpload {
    images: &["image"],
    required_parameters: &["map"],
    parameters: ReferenceParams::schema,
    example: examples::new_reference,
};

/// References in a page when the client does not say.
const DEFAULT_PAGE: usize = 100;

/// What the map builder says about a photo.
#[derive(Debug, Default, Deserialize, IntoParams, ToSchema)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ReferenceParams {
    /// The map, created on first use: 1 to 64 of `A-Z a-z 0-9 . _ -`. Required here or in the JSON.
    #[schema(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", value_type = Option<String>)]
    #[param(
        pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
        value_type = Option<String>,
        example = "harbour",
    )]
    #[serde(default)]
    pub map: Option<MapName>,
    /// Your own name for the photo, unique in the map. Sending the same photo under it again
    /// changes nothing.
    #[schema(min_length = 1, max_length = 256, value_type = Option<String>)]
    #[param(
        min_length = 1,
        max_length = 256,
        value_type = Option<String>,
        example = "drive7/000123.jpg",
    )]
    #[serde(default)]
    pub external_id: Option<ExternalId>,
    /// Latitude in degrees (WGS84); with `lon` or not at all.
    #[schema(minimum = -90, maximum = 90)]
    #[param(minimum = -90, maximum = 90, example = 51.5072)]
    pub lat: Option<f64>,
    /// Longitude in degrees (WGS84); with `lat` or not at all.
    #[schema(minimum = -180, maximum = 180)]
    #[param(minimum = -180, maximum = 180, example = -0.1276)]
    pub lon: Option<f64>,
    /// How high the photo was taken, in metres above the WGS84 ellipsoid or above whatever the map
    /// measures from throughout.
    #[schema(minimum = -12000, maximum = 100000)]
    #[param(minimum = -12000, maximum = 100000, example = 83.5)]
    pub alt: Option<f64>,
    /// Where the camera looked, in degrees clockwise from north.
    #[schema(minimum = -360, maximum = 360)]
    #[param(minimum = -360, maximum = 360, example = 270)]
    pub heading: Option<f64>,
    /// When the photo was taken (RFC 3339).
    #[schema(value_type = Option<String>, format = DateTime)]
    #[param(
        value_type = Option<String>,
        format = DateTime,
        example = "2026-05-17T09:30:00Z",
    )]
    #[serde(default)]
    pub captured_at: Option<Timestamp>,
    /// Anything else, as a JSON object; numbers and the order of keys come back as they came. No
    /// key may occur twice in an object.
    #[schema(value_type = Option<Object>)]
    #[param(value_type = Option<String>, example = "{\"camera\":\"left\"}")]
    #[serde(default, deserialize_with = "metadata")]
    pub metadata: Option<Metadata>,
    /// Whether position, height, heading and time are read from the photo's EXIF and XMP where the
    /// request gives none. A time without an offset from UTC is then taken as UTC. By default they are.
    #[schema(default = true)]
    #[param(example = true)]
    pub exif: Option<bool>,
    /// Whether a photo is stored that shows nothing by which a place could be known: a dark or
    /// blank frame, a covered lens. By default it is refused (`image_uninformative`), because
    /// every other such frame would be found there.
    #[schema(default = false)]
    #[param(example = false)]
    pub allow_uninformative: Option<bool>,
}

impl ReferenceParams {
    /// Checks what the types cannot.
    ///
    /// # Errors
    /// `invalid_parameter` with the name of the parameter.
    pub fn checked(self) -> Result<(MapName, ReferenceFields), ApiError> {
        let map = self
            .map
            .ok_or_else(|| ApiError::invalid("map: it is required"))?;
        let fields = ReferenceFields {
            external_id: self.external_id,
            location: point(self.lat, self.lon)?,
            alt: self.alt.map(Altitude::new).transpose()?,
            heading: self.heading.map(Heading::new).transpose()?,
            captured_at: self.captured_at,
            metadata: self.metadata,
        };
        Ok((map, fields))
    }
}

/// Add a photo to a map
///
/// Acknowledged only after it is durable and can be found. The image is the raw body with the
/// fields as query parameters, or a multipart part `image` beside a part `json`, or base64 in JSON
/// beside the fields. Position, height, heading and time that the request leaves out are taken from
/// the photo's own EXIF or XMP, unless `exif` is false; `sources` says where each comes from.
///
/// A photo that shows nothing by which a place could be known is refused, unless
/// `allow_uninformative` is true.
#[utoipa::path(
    post,
    path = "/references",
    operation_id = "create_reference",
    tag = "references",
    params(ReferenceParams),
    responses(
        (
            status = 201,
            description = "It is new, durable and can be found.",
            body = NewReferenceBody,
            headers(
                ("location" = String, description = "Its path."),
                ("server-timing" = String, description = "Milliseconds per stage."),
            ),
        ),
        (
            status = 200,
            description = "The same photo was there before under this external id.",
            body = NewReferenceBody,
            headers(
                ("location" = String, description = "Its path."),
                ("server-timing" = String, description = "Milliseconds per stage."),
            ),
        ),
    ),
)]
pub async fn create(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    request: Request,
) -> Result<Response, ApiError> {
    let service = state.service()?;
    // A client whose photo cannot be stored now learns so before it sends the photo.
    service.may_store()?;
    let mut upload = read_upload::<ReferenceParams>(&state, request, &UPLOAD).await?;
    let image = upload.take("image")?;
    let reads_photo = upload.params.exif.unwrap_or(true);
    let allow_uninformative = upload.params.allow_uninformative.unwrap_or(false);
    let (map, fields) = std::mem::take(&mut upload.params).checked()?;
    access.check_map(&map)?;
    let new = IngestRequest {
        map,
        fields,
        image,
        reads_photo,
        allow_uninformative,
    };
    let answer = service.ingest(&access.caller, new).await?;
    let location = HeaderValue::from_str(&format!("/references/{}", answer.reference.id));
    let IngestAnswer {
        reference,
        sources,
        created,
        timings,
    } = answer;
    let status = if created {
        StatusCode::CREATED
    } else {
        StatusCode::OK
    };
    let body = move || NewReferenceBody::new(reference, sources);
    let mut response = timed(&state, status, &timings, body).await?;
    if let Ok(location) = location {
        response.headers_mut().insert(header::LOCATION, location);
    }
    Ok(response)
}

/// Which references to list.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ListParams {
    /// Only this map.
    #[param(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", value_type = Option<String>)]
    #[serde(default)]
    map: Option<MapName>,
    /// Only the reference with this external id; needs `map`.
    #[param(min_length = 1, max_length = 256, value_type = Option<String>)]
    #[serde(default)]
    external_id: Option<ExternalId>,
    /// The `next` of the page before.
    #[param(value_type = Option<String>, pattern = "^at-[0-9]{1,19}$")]
    cursor: Option<String>,
    /// References in a page.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
}

/// What a listing asks for, every value in its range.
#[derive(Debug, PartialEq)]
pub enum Listing {
    /// The one reference with this external id.
    Named(MapName, ExternalId),
    /// A page of a map, or of all.
    Page {
        /// Only this map.
        map: Option<MapName>,
        /// Starting behind this one.
        after: Option<Cursor>,
        /// References in the page.
        limit: usize,
    },
}

impl ListParams {
    /// Checks what the types cannot; a page has at most `max_page` references.
    ///
    /// # Errors
    /// `invalid_parameter` with the name of the parameter.
    pub fn checked(self, max_page: usize) -> Result<Listing, ApiError> {
        let limit = self.limit.unwrap_or(DEFAULT_PAGE.min(max_page));
        if !(1..=max_page).contains(&limit) {
            return Err(ApiError::invalid(format!(
                "limit: {limit} is outside 1 to {max_page}"
            )));
        }
        let after = self.cursor.as_deref().map(str::parse).transpose()?;
        match (self.map, self.external_id) {
            (Some(map), Some(external_id)) => Ok(Listing::Named(map, external_id)),
            (None, Some(_)) => Err(ApiError::invalid("external_id: it needs map")),
            (map, None) => Ok(Listing::Page { map, after, limit }),
        }
    }
}

/// A page of references.
#[derive(Debug, Serialize, ToSchema)]
pub struct ReferencePage {
    /// In the order they were added. With a key that is limited to maps there may be fewer than
    /// `limit`, also none, although there is a next page.
    references: Vec<ReferenceBody>,
    /// Pass as `cursor` for the next page; null on the last.
    next: Option<String>,
}

/// List references
///
/// In the order they were added, page by page. Whoever follows `next` to the end misses none that
/// was added before.
#[utoipa::path(
    get,
    path = "/references",
    operation_id = "list_references",
    tag = "references",
    params(ListParams),
    responses(
        (status = 200, description = "A page.", body = ReferencePage),
    ),
)]
pub async fn list(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    uri: Uri,
) -> Result<Response, ApiError> {
    let listing = read_query::<ListParams>(&uri)?.checked(state.http.max_page)?;
    let service = state.service()?;
    let (references, next) = match listing {
        Listing::Named(map, external_id) => {
            access.check_map(&map)?;
            let finding = service.find_external(&access.caller, map, external_id);
            (Vec::from_iter(finding.await?), None)
        }
        Listing::Page { map, after, limit } => {
            map.iter().try_for_each(|map| access.check_map(map))?;
            let listing = service.references(&access.caller, map, after, limit);
            let mut page = listing.await?;
            let references = &mut page.references;
            references.retain(|reference| access.maps.allows(&reference.map));
            (page.references, page.next)
        }
    };
    let page = move || ReferencePage {
        references: references.into_iter().map(Into::into).collect(),
        next: next.map(|id| id.to_string()),
    };
    answer::json(&state, Workload::Large, page).await
}

fn parse_id(text: &str) -> Result<ReferenceId, ApiError> {
    text.parse().map_err(|_| {
        ApiError::new(
            ErrorCode::ReferenceNotFound,
            "the id in the path is not a UUID, so nothing has it",
        )
    })
}

/// One reference
///
/// Its metadata; the image itself is not kept.
#[utoipa::path(
    get,
    path = "/references/{id}",
    operation_id = "get_reference",
    tag = "references",
    params(("id" = String, Path, description = "The reference's id.", format = Uuid)),
    responses(
        (status = 200, description = "The reference.", body = ReferenceBody),
    ),
)]
pub async fn get(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(id): Path<String>,
) -> Result<Response, ApiError> {
    let service = state.service()?;
    let id = parse_id(&id)?;
    access.check_reference(service, id).await?;
    let reference = service.reference(&access.caller, id).await?;
    answer::json(&state, Workload::Small, || ReferenceBody::from(reference)).await
}

/// Fields to change: one left out stays as it is, null clears it.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ReferenceChange {
    /// Your own name for the photo.
    #[schema(min_length = 1, max_length = 256, value_type = Option<String>)]
    #[serde(default, deserialize_with = "present")]
    external_id: Option<Option<ExternalId>>,
    /// Latitude in degrees; together with `lon`.
    #[schema(minimum = -90, maximum = 90, value_type = Option<f64>)]
    #[serde(default, deserialize_with = "present")]
    lat: Option<Option<f64>>,
    /// Longitude in degrees; together with `lat`.
    #[schema(minimum = -180, maximum = 180, value_type = Option<f64>)]
    #[serde(default, deserialize_with = "present")]
    lon: Option<Option<f64>>,
    /// Metres above the WGS84 ellipsoid, or above what the map measures from.
    #[schema(minimum = -12000, maximum = 100000, value_type = Option<f64>)]
    #[serde(default, deserialize_with = "present")]
    alt: Option<Option<f64>>,
    /// Degrees clockwise from north.
    #[schema(minimum = -360, maximum = 360, value_type = Option<f64>)]
    #[serde(default, deserialize_with = "present")]
    heading: Option<Option<f64>>,
    /// When the photo was taken (RFC 3339).
    #[schema(value_type = Option<String>, format = DateTime)]
    #[serde(default, deserialize_with = "present")]
    captured_at: Option<Option<Timestamp>>,
    /// Replaces the whole object.
    #[schema(value_type = Option<Object>)]
    #[serde(default, deserialize_with = "present")]
    metadata: Option<Option<Metadata>>,
}

impl ReferenceChange {
    fn checked(self) -> Result<ReferencePatch, ApiError> {
        let location = match (self.lat, self.lon) {
            (None, None) => None,
            (Some(lat), Some(lon)) => Some(point(lat, lon)?),
            _ => {
                return Err(ApiError::invalid(
                    "lat and lon belong together: change both or neither",
                ));
            }
        };
        let alt = self.alt.map(|alt| alt.map(Altitude::new).transpose());
        let heading = self
            .heading
            .map(|degrees| degrees.map(Heading::new).transpose());
        Ok(ReferencePatch {
            external_id: self.external_id,
            location,
            alt: alt.transpose()?,
            heading: heading.transpose()?,
            captured_at: self.captured_at,
            metadata: self.metadata,
        })
    }
}

/// Change a reference's metadata
///
/// The photo and what was computed from it stay. A new position is used by the next query.
#[utoipa::path(
    patch,
    path = "/references/{id}",
    operation_id = "update_reference",
    tag = "references",
    request_body = ReferenceChange,
    params(("id" = String, Path, description = "The reference's id.", format = Uuid)),
    responses(
        (status = 200, description = "The reference as it is now.", body = ReferenceBody),
    ),
)]
pub async fn update(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(id): Path<String>,
    request: Request,
) -> Result<Response, ApiError> {
    let service = state.service()?;
    let id = parse_id(&id)?;
    access.check_reference(service, id).await?;
    let change: ReferenceChange = read_json(&state, request).await?;
    let changing = service.update(&access.caller, id, change.checked()?);
    let reference = changing.await?;
    answer::json(&state, Workload::Small, || ReferenceBody::from(reference)).await
}

/// Delete a reference
///
/// It is found by no query that begins after the answer.
#[utoipa::path(
    delete,
    path = "/references/{id}",
    operation_id = "delete_reference",
    tag = "references",
    params(("id" = String, Path, description = "The reference's id.", format = Uuid)),
    responses(
        (status = 204, description = "It is gone."),
    ),
)]
pub async fn delete(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(id): Path<String>,
) -> Result<Response, ApiError> {
    let service = state.service()?;
    let id = parse_id(&id)?;
    access.check_reference(service, id).await?;
    service.delete(&access.caller, id).await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}

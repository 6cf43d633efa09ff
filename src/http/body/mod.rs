//! Bodies: bounded and timed while they arrive, then taken apart into images and parameters.
//!
//! An image comes in one of three ways: as the raw body with parameters in the query string; as
//! multipart, with parameters in a part named `json` or in the query string; as JSON with the image
//! in base64 beside the parameters. A raw body without a type of its own is taken for an image if
//! its bytes begin as one.
//!
//! Taking a body apart is work, which is done on threads of its own ([`codec`](super::codec)).
//!
//! Whatever memory a body takes is reserved in one budget first
//! ([`memory_budget`](super::memory_budget)): the buffer it arrives in, and the images copied or decoded
//! out of it. The images then carry their reservation along, so that it is given back when the
//! pipeline is done with them, also when the client has left meanwhile.

mod json;
mod multipart;
mod parts;
mod receive;

use super::codec::Workload;
use super::memory_budget::Reservation;
use super::problem::ApiError;
use super::state::AppState;
use axum::extract::{Query, Request};
use axum::http::{HeaderMap, Uri, header};
use bytes::Bytes;
use json::split_json;
use multipart::split_multipart;
use parts::{BodyParts, JsonObject, MAX_PARAMETER_BYTES};
use placeformer_core::error::ErrorCode;
use placeformer_vision::image;
use receive::{ReceivedBody, receive};
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::collections::HashMap;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;

/// The types that a body of images may have.
const UPLOAD_TYPES: &str = "one of image/jpeg, image/png, image/webp, application/octet-stream, \
     multipart/form-data, application/json";

/// Largest body without an image, in bytes.
pub const MAX_JSON_BYTES: usize = 256 << 10;

/// What a body of images consists of.
pub struct ImageUpload {
    /// The names of the images. A raw body is the first, which is also the one that is required in
    /// every case.
    pub images: &'static [&'static str],
    /// The parameters that are required, wherever they are sent.
    pub required_parameters: &'static [&'static str],
    /// Makes the schema of the parameters.
    pub parameters: fn() -> RefOr<Schema>,
    /// Makes a realistic JSON body for the OpenAPI document.
    pub example: fn() -> Value,
}

/// Images and parameters of one request. An image counts against the budget until the last clone of
/// it is dropped.
pub struct UploadedImages<P> {
    images: HashMap<&'static str, Bytes>,
    /// The parameters, wherever they came from.
    pub params: P,
}

impl<P> UploadedImages<P> {
    /// Takes the image called `name`.
    ///
    /// # Errors
    /// `invalid_parameter` if it was not sent, `empty_image` if it has no bytes.
    pub fn take(&mut self, name: &'static str) -> Result<Bytes, ApiError> {
        self.take_optional(name)?
            .ok_or_else(|| ApiError::invalid(format!("the image {name:?} is missing")))
    }

    /// Takes the image called `name`, if it was sent.
    ///
    /// # Errors
    /// `empty_image` if it has no bytes.
    pub fn take_optional(&mut self, name: &'static str) -> Result<Option<Bytes>, ApiError> {
        match self.images.remove(name) {
            Some(bytes) if bytes.is_empty() => Err(ApiError::new(
                ErrorCode::EmptyImage,
                format!("the image {name:?} has no bytes"),
            )),
            found => Ok(found),
        }
    }
}

/// Reads a request that carries the images of `upload`.
///
/// # Errors
/// Every code of a body, as [`Route::error_codes`](super::route::Route::error_codes) lists them.
pub async fn read_upload<P: DeserializeOwned + Send + 'static>(
    state: &AppState,
    request: Request,
    upload: &ImageUpload,
) -> Result<UploadedImages<P>, ApiError> {
    let kind = media_type(request.headers());
    let uri = request.uri().clone();
    let names = upload.images;
    let image_bytes = state.max_image_bytes * names.len();
    match kind.as_deref() {
        Some("multipart/form-data") => {
            let headers = request.headers().clone();
            let received = receive(state, request, image_bytes + MAX_PARAMETER_BYTES).await?;
            let workload = Workload::of_body(received.bytes.len());
            let split = move || {
                let (parts, reservation) = split_multipart(headers, received, names)?;
                hand_over(parts, reservation, &uri)
            };
            state.codec.run(workload, split).await
        }
        Some("application/json") => {
            let base64_bytes = image_bytes / 3 * 4;
            let received = receive(state, request, base64_bytes + MAX_PARAMETER_BYTES).await?;
            let workload = Workload::of_body(received.bytes.len());
            let split = move || {
                let (parts, reservation) = split_json(received, names)?;
                hand_over(parts, reservation, &uri)
            };
            state.codec.run(workload, split).await
        }
        Some("image/jpeg" | "image/png" | "image/webp" | "application/octet-stream") => {
            read_raw_image(state, request, names).await
        }
        // What clients send that do not know the type: `curl --data-binary` calls everything a form.
        None | Some("application/x-www-form-urlencoded") => {
            let upload = read_raw_image(state, request, names).await?;
            let is_image = |bytes: &Bytes| image::is_image(bytes);
            if !upload.images.values().all(is_image) {
                let expected = format!("{UPLOAD_TYPES}, and the body is no JPEG, PNG or WebP");
                return Err(unsupported_type(kind.as_deref(), &expected));
            }
            Ok(upload)
        }
        _ => Err(unsupported_type(kind.as_deref(), UPLOAD_TYPES)),
    }
}

/// Reads a body that is the first of the images, as it is.
async fn read_raw_image<P: DeserializeOwned>(
    state: &AppState,
    request: Request,
    names: &'static [&'static str],
) -> Result<UploadedImages<P>, ApiError> {
    let params = parameters_of(request.uri(), None)?;
    let received = receive(state, request, state.max_image_bytes).await?;
    let image = received.reservation.attach_one(received.bytes);
    let images = names.iter().copied().zip([image]).collect();
    Ok(UploadedImages { images, params })
}

/// Reads a JSON object without images, of at most [`MAX_JSON_BYTES`].
///
/// # Errors
/// The codes of a body without those of images.
pub async fn read_json<T: DeserializeOwned + Send + 'static>(
    state: &AppState,
    request: Request,
) -> Result<T, ApiError> {
    let kind = media_type(request.headers());
    if !matches!(
        kind.as_deref(),
        Some("application/json" | "application/merge-patch+json")
    ) {
        return Err(unsupported_type(kind.as_deref(), "application/json"));
    }
    let received = receive(state, request, MAX_JSON_BYTES).await?;
    let parse = move || {
        // The reservation is released at the end of the function, when the bytes are parsed.
        let ReceivedBody {
            bytes,
            reservation: _reservation,
        } = received;
        JsonObject::new(bytes)?.read()
    };
    state.codec.run(Workload::Small, parse).await
}

/// Reads a body that is one file of at most `limit` bytes. They count against the budget until they
/// are dropped.
///
/// # Errors
/// The codes of a body without those of images.
pub async fn read_file(
    state: &AppState,
    request: Request,
    limit: usize,
) -> Result<Bytes, ApiError> {
    let kind = media_type(request.headers());
    if kind.as_deref() != Some("application/octet-stream") {
        let expected = "application/octet-stream";
        return Err(unsupported_type(kind.as_deref(), expected));
    }
    let ReceivedBody { bytes, reservation } = receive(state, request, limit).await?;
    Ok(reservation.attach_one(bytes))
}

/// Parses the query string.
///
/// # Errors
/// `invalid_parameter` for a value of the wrong type, and for a name that the type does not know.
pub fn read_query<T: DeserializeOwned>(uri: &Uri) -> Result<T, ApiError> {
    match Query::try_from_uri(uri) {
        Ok(Query(value)) => Ok(value),
        Err(rejection) => Err(ApiError::invalid(rejection.body_text())),
    }
}

/// The content type in lower case, without its parameters.
fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next()?.trim().to_ascii_lowercase())
}

fn unsupported_type(kind: Option<&str>, expected: &str) -> ApiError {
    let kind = kind.unwrap_or("(none)");
    ApiError::new(
        ErrorCode::UnsupportedMediaType,
        format!("content-type {kind} is not {expected}"),
    )
}

/// Attaches the reservation to the images, reduced to what they take.
fn hand_over<P: DeserializeOwned>(
    parts: BodyParts,
    mut reservation: Reservation,
    uri: &Uri,
) -> Result<UploadedImages<P>, ApiError> {
    let (names, buffers): (Vec<_>, Vec<_>) = parts.images.into_iter().unzip();
    reservation.resize(buffers.iter().map(Vec::capacity).sum())?;
    let images = names.into_iter().zip(reservation.attach(buffers)).collect();
    Ok(UploadedImages {
        images,
        params: parameters_of(uri, parts.parameters)?,
    })
}

/// The parameters from the query string or from the JSON of the body, which may not both have some.
fn parameters_of<P: DeserializeOwned>(uri: &Uri, json: Option<JsonObject>) -> Result<P, ApiError> {
    let in_query = uri.query().is_some_and(|query| !query.is_empty());
    match json {
        Some(json) if !json.is_empty() && in_query => Err(ApiError::invalid(
            "parameters are in the query string and in JSON; use one of them",
        )),
        Some(json) if !in_query => json.read(),
        _ => read_query(uri),
    }
}

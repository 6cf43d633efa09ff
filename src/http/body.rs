//! Bodies: bounded and timed while they arrive, then taken apart into images and parameters.
//!
//! An image comes in one of three ways: as the raw body with parameters in the query string; as multipart, with
//! parameters in a part named `json` or in the query string; as JSON with the image in base64 beside the parameters.

use super::AppState;
use super::limits::Held;
use super::problem::ApiError;
use crate::error::ErrorCode;
use axum::body::{Body, HttpBody};
use axum::extract::{FromRequest, Multipart, Query, Request};
use axum::http::{HeaderMap, Uri, header};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use bytes::{Bytes, BytesMut};
use http_body_util::BodyExt;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use std::collections::HashMap;
use std::time::Duration;
use tokio::time::{Instant, timeout, timeout_at};

/// Bytes of a body beyond its image: parameters, multipart boundaries.
const BESIDE_THE_IMAGE: usize = 256 << 10;
/// Largest body without an image.
const MAX_JSON_BYTES: usize = 256 << 10;

/// Images and parameters of one request. The bytes count against the budget until it is dropped.
pub struct Upload<P> {
    images: HashMap<&'static str, Bytes>,
    /// The parameters, wherever they came from.
    pub params: P,
    _held: Held,
}

impl<P> Upload<P> {
    /// Takes the image called `name`.
    pub fn take(&mut self, name: &'static str) -> Result<Bytes, ApiError> {
        self.take_optional(name)?.ok_or_else(|| ApiError::invalid(format!("the image {name:?} is missing")))
    }

    /// Takes the image called `name`, if it was sent.
    pub fn take_optional(&mut self, name: &'static str) -> Result<Option<Bytes>, ApiError> {
        match self.images.remove(name) {
            Some(bytes) if bytes.is_empty() => {
                Err(ApiError::new(ErrorCode::EmptyImage, format!("the image {name:?} has no bytes")))
            }
            found => Ok(found),
        }
    }
}

/// Reads a request that carries images; a raw body becomes the first of `names`.
pub async fn read_upload<P: DeserializeOwned>(
    state: &AppState,
    request: Request,
    names: &'static [&'static str],
) -> Result<Upload<P>, ApiError> {
    let kind = media_type(request.headers());
    let uri = request.uri().clone();
    let image_bytes = state.max_image_bytes * names.len();
    match kind.as_deref() {
        Some("multipart/form-data") => {
            let headers = request.headers().clone();
            let (bytes, held) = read_bytes(state, request, image_bytes + BESIDE_THE_IMAGE).await?;
            let (images, json) = split_multipart(headers, bytes, names).await?;
            Ok(Upload { images, params: one_source(&uri, json)?, _held: held })
        }
        Some("application/json") => {
            let (bytes, held) = read_bytes(state, request, image_bytes / 3 * 4 + BESIDE_THE_IMAGE).await?;
            let (images, json) = split_json(&bytes, names)?;
            Ok(Upload { images, params: one_source(&uri, Some(json))?, _held: held })
        }
        Some("image/jpeg" | "image/png" | "image/webp" | "application/octet-stream") => {
            let params = one_source(&uri, None)?;
            let (bytes, held) = read_bytes(state, request, state.max_image_bytes).await?;
            Ok(Upload { images: HashMap::from([(names[0], bytes)]), params, _held: held })
        }
        other => Err(ApiError::new(
            ErrorCode::UnsupportedMediaType,
            format!(
                "content-type {} is not one of image/jpeg, image/png, image/webp, application/octet-stream, \
                 multipart/form-data, application/json",
                other.unwrap_or("(none)")
            ),
        )),
    }
}

/// Reads a JSON body without images.
pub async fn read_json<T: DeserializeOwned>(state: &AppState, request: Request) -> Result<T, ApiError> {
    let kind = media_type(request.headers());
    if !matches!(kind.as_deref(), Some("application/json" | "application/merge-patch+json")) {
        let detail = format!("content-type {} is not application/json", kind.as_deref().unwrap_or("(none)"));
        return Err(ApiError::new(ErrorCode::UnsupportedMediaType, detail));
    }
    let (bytes, _held) = read_bytes(state, request, MAX_JSON_BYTES).await?;
    // Through an object, because a struct would also be read from an array.
    let object: Map<String, Value> = serde_json::from_slice(&bytes).map_err(json_error)?;
    serde_json::from_value(Value::Object(object)).map_err(json_error)
}

/// Reads a body that is one file of at most `limit` bytes; they count against the budget until the second value is
/// dropped.
pub async fn read_file(state: &AppState, request: Request, limit: usize) -> Result<(Bytes, Held), ApiError> {
    let kind = media_type(request.headers());
    if kind.as_deref() != Some("application/octet-stream") {
        let detail = format!("content-type {} is not application/octet-stream", kind.as_deref().unwrap_or("(none)"));
        return Err(ApiError::new(ErrorCode::UnsupportedMediaType, detail));
    }
    read_bytes(state, request, limit).await
}

/// Parses the query string; unknown names are refused by the type.
pub fn read_query<T: DeserializeOwned>(uri: &Uri) -> Result<T, ApiError> {
    Query::try_from_uri(uri).map(|Query(value)| value).map_err(|rejection| ApiError::invalid(rejection.body_text()))
}

fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next()?.trim().to_ascii_lowercase())
}

/// Buffers a body of at most `limit` bytes within the body timeouts and the budget.
async fn read_bytes(state: &AppState, request: Request, limit: usize) -> Result<(Bytes, Held), ApiError> {
    let too_large = || ApiError::new(ErrorCode::BodyTooLarge, format!("the body has more than {limit} bytes"));
    let mut body = request.into_body();
    if HttpBody::size_hint(&body).lower() > limit as u64 {
        return Err(too_large());
    }
    let whole = Instant::now() + Duration::from_millis(state.http.body_timeout_ms);
    let pause = Duration::from_millis(state.http.body_idle_timeout_ms);
    let mut held = state.body_memory.hold()?;
    let mut bytes = BytesMut::new();
    loop {
        let frame = timeout_at(whole, timeout(pause, body.frame())).await;
        let frame = frame
            .ok()
            .and_then(Result::ok)
            .ok_or_else(|| ApiError::new(ErrorCode::RequestTimeout, "the body stopped arriving or took too long"))?;
        let Some(frame) = frame else { return Ok((bytes.freeze(), held)) };
        let frame = frame.map_err(|error| ApiError::malformed(format!("the body broke off: {error}")))?;
        let Ok(data) = frame.into_data() else { continue };
        if bytes.len() + data.len() > limit {
            return Err(too_large());
        }
        state.body_memory.cover(&mut held, bytes.len() + data.len())?;
        bytes.extend_from_slice(&data);
    }
}

type Images = HashMap<&'static str, Bytes>;

async fn split_multipart(
    headers: HeaderMap,
    bytes: Bytes,
    names: &'static [&'static str],
) -> Result<(Images, Option<Map<String, Value>>), ApiError> {
    let mut request = Request::new(Body::from(bytes));
    *request.headers_mut() = headers;
    axum::extract::DefaultBodyLimit::disable().apply(&mut request);
    let broken = |error: &dyn std::fmt::Display| ApiError::malformed(format!("the multipart body is broken: {error}"));
    let mut multipart = Multipart::from_request(request, &()).await.map_err(|error| broken(&error.body_text()))?;
    let (mut images, mut json) = (HashMap::new(), None);
    while let Some(field) = multipart.next_field().await.map_err(|error| broken(&error.body_text()))? {
        let name = field.name().unwrap_or_default().to_owned();
        let content = field.bytes().await.map_err(|error| broken(&error.body_text()))?;
        let repeated = if name == "json" {
            json.replace(serde_json::from_slice(&content).map_err(json_error)?).is_some()
        } else if let Some(&known) = names.iter().find(|known| **known == name) {
            images.insert(known, content).is_some()
        } else {
            let name: String = name.chars().take(80).collect();
            return Err(ApiError::invalid(format!("the part {name:?} is not known; use {names:?} and \"json\"")));
        };
        if repeated {
            return Err(ApiError::invalid(format!("the part {name:?} was sent twice")));
        }
    }
    Ok((images, json))
}

fn split_json(bytes: &[u8], names: &'static [&'static str]) -> Result<(Images, Map<String, Value>), ApiError> {
    let mut json: Map<String, Value> = serde_json::from_slice(bytes).map_err(json_error)?;
    let mut images = HashMap::new();
    for &name in names {
        match json.remove(name) {
            None => {}
            Some(Value::String(text)) => {
                let image = STANDARD.decode(text).map_err(|error| ApiError::invalid(format!("{name}: {error}")))?;
                images.insert(name, Bytes::from(image));
            }
            Some(_) => return Err(ApiError::invalid(format!("{name}: it must be a string of base64"))),
        }
    }
    Ok((images, json))
}

/// Parameters come from the query string or from JSON, not from both.
fn one_source<P: DeserializeOwned>(uri: &Uri, json: Option<Map<String, Value>>) -> Result<P, ApiError> {
    let in_query = uri.query().is_some_and(|query| !query.is_empty());
    match json {
        Some(json) if !json.is_empty() && in_query => {
            Err(ApiError::invalid("parameters are in the query string and in JSON; use one of them"))
        }
        Some(json) if !in_query => serde_json::from_value(Value::Object(json)).map_err(json_error),
        _ => read_query(uri),
    }
}

/// JSON that cannot be parsed is malformed; JSON that says the wrong thing is invalid.
fn json_error(error: serde_json::Error) -> ApiError {
    if error.is_data() { ApiError::invalid(error.to_string()) } else { ApiError::malformed(error.to_string()) }
}

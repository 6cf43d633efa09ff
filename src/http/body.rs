//! Bodies: bounded and timed while they arrive, then taken apart into images and parameters.
//!
//! An image comes in one of three ways: as the raw body with parameters in the query string; as
//! multipart, with parameters in a part named `json` or in the query string; as JSON with the image
//! in base64 beside the parameters.
//!
//! Whatever memory a body takes on its way is taken from one budget first: the buffer it arrives
//! in, and the images copied or decoded out of it. The images then carry their share along, so that
//! it is given back when the pipeline is done with them, also when the client has left meanwhile.

use super::AppState;
use super::limits::Held;
use super::problem::ApiError;
use axum::body::{Body, HttpBody};
use axum::extract::{FromRequest, Multipart, Query, Request};
use axum::http::{HeaderMap, Uri, header};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use http_body_util::BodyExt;
use placeformer_core::error::ErrorCode;
use serde::Deserializer;
use serde::de::{DeserializeOwned, MapAccess, Visitor};
use serde_json::value::RawValue;
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::collections::HashMap;
use std::convert::Infallible;
use std::time::Duration;
use tokio::time::{Instant, timeout, timeout_at};

/// Bytes of a body beyond its image: parameters, multipart boundaries.
const BESIDE_THE_IMAGE: usize = 256 << 10;
/// Least bytes of a member of an object beside its key and value: quotes, colon, comma.
const MEMBER: usize = 4;
/// First size of the buffer of a body whose length is not known.
const FIRST_BUFFER: usize = 16 << 10;
/// Bytes that the multipart parser gets at a time.
const PIECE: usize = 64 << 10;
/// Largest body without an image.
const MAX_JSON_BYTES: usize = 256 << 10;

/// Images and parameters of one request. An image counts against the budget until the last clone of
/// it is dropped.
pub struct Upload<P> {
    images: HashMap<&'static str, Bytes>,
    /// The parameters, wherever they came from.
    pub params: P,
}

/// A body that has arrived.
struct Received {
    bytes: Vec<u8>,
    /// Covers the buffer's capacity.
    held: Held,
}

/// What a body is taken apart into.
#[derive(Default)]
struct Parts {
    images: Vec<(&'static str, Vec<u8>)>,
    json: Option<Map<String, Value>>,
}

impl<P> Upload<P> {
    /// Takes the image called `name`.
    pub fn take(&mut self, name: &'static str) -> Result<Bytes, ApiError> {
        self.take_optional(name)?
            .ok_or_else(|| ApiError::invalid(format!("the image {name:?} is missing")))
    }

    /// Takes the image called `name`, if it was sent.
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
            let received = read_bytes(state, request, image_bytes + BESIDE_THE_IMAGE).await?;
            let (parts, held) = split_multipart(headers, received, names).await?;
            finish(parts, held, &uri)
        }
        Some("application/json") => {
            let received =
                read_bytes(state, request, image_bytes / 3 * 4 + BESIDE_THE_IMAGE).await?;
            let (parts, held) = split_json(received, names)?;
            finish(parts, held, &uri)
        }
        Some("image/jpeg" | "image/png" | "image/webp" | "application/octet-stream") => {
            let params = one_source(&uri, None)?;
            let Received { bytes, held } =
                read_bytes(state, request, state.max_image_bytes).await?;
            Ok(Upload {
                images: names.iter().copied().zip(held.keep(vec![bytes])).collect(),
                params,
            })
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
pub async fn read_json<T: DeserializeOwned>(
    state: &AppState,
    request: Request,
) -> Result<T, ApiError> {
    let kind = media_type(request.headers());
    if !matches!(
        kind.as_deref(),
        Some("application/json" | "application/merge-patch+json")
    ) {
        let detail = format!(
            "content-type {} is not application/json",
            kind.as_deref().unwrap_or("(none)")
        );
        return Err(ApiError::new(ErrorCode::UnsupportedMediaType, detail));
    }
    let Received { bytes, held: _held } = read_bytes(state, request, MAX_JSON_BYTES).await?;
    // Through an object, because a struct would also be read from an array.
    let object: Map<String, Value> = serde_json::from_slice(&bytes).map_err(json_error)?;
    serde_json::from_value(Value::Object(object)).map_err(json_error)
}

/// Reads a body that is one file of at most `limit` bytes; they count against the budget until they
/// are dropped.
pub async fn read_file(
    state: &AppState,
    request: Request,
    limit: usize,
) -> Result<Bytes, ApiError> {
    let kind = media_type(request.headers());
    if kind.as_deref() != Some("application/octet-stream") {
        let detail = format!(
            "content-type {} is not application/octet-stream",
            kind.as_deref().unwrap_or("(none)")
        );
        return Err(ApiError::new(ErrorCode::UnsupportedMediaType, detail));
    }
    let Received { bytes, held } = read_bytes(state, request, limit).await?;
    Ok(held.keep_one(bytes))
}

/// Parses the query string; unknown names are refused by the type.
pub fn read_query<T: DeserializeOwned>(uri: &Uri) -> Result<T, ApiError> {
    Query::try_from_uri(uri)
        .map(|Query(value)| value)
        .map_err(|rejection| ApiError::invalid(rejection.body_text()))
}

fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next()?.trim().to_ascii_lowercase())
}

/// Buffers a body of at most `limit` bytes within the body timeouts and the budget.
async fn read_bytes(
    state: &AppState,
    request: Request,
    limit: usize,
) -> Result<Received, ApiError> {
    let too_large = || {
        ApiError::new(
            ErrorCode::BodyTooLarge,
            format!("the body has more than {limit} bytes"),
        )
    };
    let mut body = request.into_body();
    let announced = HttpBody::size_hint(&body);
    if announced.lower() > limit as u64 {
        return Err(too_large());
    }
    let most = announced
        .upper()
        .and_then(|upper| usize::try_from(upper).ok())
        .map_or(limit, |upper| upper.min(limit));
    let whole = Instant::now() + Duration::from_millis(state.http.body_timeout_ms);
    let pause = Duration::from_millis(state.http.body_idle_timeout_ms);
    let mut received = Received {
        bytes: Vec::new(),
        held: state.body_memory.hold()?,
    };
    loop {
        let frame = timeout_at(whole, timeout(pause, body.frame())).await;
        let frame = frame.ok().and_then(Result::ok).ok_or_else(|| {
            ApiError::new(
                ErrorCode::RequestTimeout,
                "the body stopped arriving or took too long",
            )
        })?;
        let Some(frame) = frame else {
            return Ok(received);
        };
        let frame =
            frame.map_err(|error| ApiError::malformed(format!("the body broke off: {error}")))?;
        let Ok(data) = frame.into_data() else {
            continue;
        };
        if received.bytes.len() + data.len() > limit {
            return Err(too_large());
        }
        received.append(&data, most)?;
    }
}

impl Received {
    /// Appends to the buffer, which doubles as bytes come, but not beyond the `most` that can come:
    /// what a client only announces costs nothing.
    fn append(&mut self, data: &[u8], most: usize) -> Result<(), ApiError> {
        let (needed, capacity) = (self.bytes.len() + data.len(), self.bytes.capacity());
        if needed > capacity {
            let larger = needed.max((2 * capacity).max(FIRST_BUFFER).min(most));
            // While the bytes move, there are two buffers.
            self.held.resize(capacity + larger)?;
            self.bytes.reserve_exact(larger - self.bytes.len());
            self.held.resize(self.bytes.capacity())?;
        }
        self.bytes.extend_from_slice(data);
        Ok(())
    }
}

/// Hands the images over with the room they take.
fn finish<P: DeserializeOwned>(
    parts: Parts,
    mut held: Held,
    uri: &Uri,
) -> Result<Upload<P>, ApiError> {
    let (names, images): (Vec<_>, Vec<_>) = parts.images.into_iter().unzip();
    held.resize(images.iter().map(Vec::capacity).sum())?;
    let images = names.into_iter().zip(held.keep(images)).collect();
    Ok(Upload {
        images,
        params: one_source(uri, parts.json)?,
    })
}

async fn split_multipart(
    headers: HeaderMap,
    received: Received,
    names: &'static [&'static str],
) -> Result<(Parts, Held), ApiError> {
    let Received { bytes, mut held } = received;
    // All images together are shorter than the body they are copied from.
    held.resize(bytes.capacity() + bytes.len() + PIECE)?;
    let mut left = bytes.len();
    let mut request = Request::new(in_pieces(Bytes::from(bytes)));
    *request.headers_mut() = headers;
    axum::extract::DefaultBodyLimit::disable().apply(&mut request);
    let broken = |error: &dyn std::fmt::Display| {
        ApiError::malformed(format!("the multipart body is broken: {error}"))
    };
    let mut multipart = Multipart::from_request(request, &())
        .await
        .map_err(|error| broken(&error.body_text()))?;
    let mut parts = Parts::default();
    while let Some(mut field) = multipart
        .next_field()
        .await
        .map_err(|error| broken(&error.body_text()))?
    {
        let name = field.name().unwrap_or_default().to_owned();
        let mut content = Vec::with_capacity(left);
        while let Some(chunk) = field
            .chunk()
            .await
            .map_err(|error| broken(&error.body_text()))?
        {
            content.extend_from_slice(&chunk);
        }
        content.shrink_to_fit();
        left = left.saturating_sub(content.len());
        let repeated = if name == "json" {
            parts.json.replace(parameters(&content)?).is_some()
        } else if let Some(&known) = names.iter().find(|known| **known == name) {
            let repeated = parts.images.iter().any(|(other, _)| *other == known);
            parts.images.push((known, content));
            repeated
        } else {
            let name: String = name.chars().take(80).collect();
            return Err(ApiError::invalid(format!(
                "the part {name:?} is not known; use {names:?} and \"json\""
            )));
        };
        if repeated {
            return Err(ApiError::invalid(format!(
                "the part {name:?} was sent twice"
            )));
        }
    }
    Ok((parts, held))
}

/// The JSON part. Once parsed, JSON takes many times its length, so it may not be as long as an
/// image.
fn parameters(content: &[u8]) -> Result<Map<String, Value>, ApiError> {
    if content.len() > BESIDE_THE_IMAGE {
        return Err(too_many_parameters());
    }
    serde_json::from_slice(content).map_err(json_error)
}

fn too_many_parameters() -> ApiError {
    ApiError::new(
        ErrorCode::BodyTooLarge,
        format!("the parameters beside the images take more than {BESIDE_THE_IMAGE} bytes"),
    )
}

/// A body that comes bit by bit: the parser copies what it is given, and so never holds more than a
/// piece.
fn in_pieces(mut rest: Bytes) -> Body {
    let pieces = std::iter::from_fn(move || {
        let piece = rest.split_to(rest.len().min(PIECE));
        (!piece.is_empty()).then_some(Ok::<_, Infallible>(piece))
    });
    Body::from_stream(futures_util::stream::iter(pieces))
}

fn split_json(
    received: Received,
    names: &'static [&'static str],
) -> Result<(Parts, Held), ApiError> {
    let Received { bytes, mut held } = received;
    let sent = SentJson::parse(&bytes, names)?;
    let mut parts = Parts::default();
    let mut taken = bytes.capacity();
    for (name, raw) in sent.images {
        let text = raw.get();
        if !text.starts_with('"') {
            return Err(ApiError::invalid(format!(
                "{name}: it must be a string of base64"
            )));
        }
        // Base64 needs no escapes, but some writers escape its slashes.
        let escaped = text.contains('\\');
        taken += text.len() / 4 * 3 + 3;
        held.resize(taken + if escaped { text.len() } else { 0 })?;
        let text: Cow<'_, str> = if escaped {
            Cow::Owned(serde_json::from_str(text).map_err(json_error)?)
        } else {
            Cow::Borrowed(text.trim_matches('"'))
        };
        let image = STANDARD
            .decode(text.as_ref())
            .map_err(|error| ApiError::invalid(format!("{name}: {error}")))?;
        parts.images.push((name, image));
    }
    let json: Result<Map<_, _>, _> = sent
        .beside
        .into_iter()
        .map(|(key, raw)| Ok((key, serde_json::from_str(raw.get())?)))
        .collect();
    parts.json = Some(json.map_err(json_error)?);
    Ok((parts, held))
}

/// A JSON body looked at, but not copied: images are long, and parsed JSON takes many times its
/// length.
struct SentJson<'a> {
    images: HashMap<&'static str, &'a RawValue>,
    beside: Vec<(String, &'a RawValue)>,
}

impl<'a> SentJson<'a> {
    fn parse(bytes: &'a [u8], names: &'static [&'static str]) -> Result<Self, ApiError> {
        let mut deserializer = serde_json::Deserializer::from_slice(bytes);
        let sent = deserializer
            .deserialize_map(ImagesApart(names))
            .map_err(json_error)?;
        deserializer.end().map_err(json_error)?;
        sent.ok_or_else(too_many_parameters)
    }
}

/// Sorts the members of an object; `None` if those beside the images are too long.
struct ImagesApart(&'static [&'static str]);

impl<'de> Visitor<'de> for ImagesApart {
    type Value = Option<SentJson<'de>>;

    fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Self::Value, A::Error> {
        let mut sent = SentJson {
            images: HashMap::new(),
            beside: Vec::new(),
        };
        let mut room = Some(BESIDE_THE_IMAGE);
        while let Some((key, value)) = members.next_entry::<String, &RawValue>()? {
            if let Some(&name) = self.0.iter().find(|name| **name == key) {
                sent.images.insert(name, value);
                continue;
            }
            room = room.and_then(|room| room.checked_sub(key.len() + value.get().len() + MEMBER));
            if room.is_some() {
                sent.beside.push((key, value));
            }
        }
        Ok(room.map(|_| sent))
    }
}

/// Parameters come from the query string or from JSON, not from both.
fn one_source<P: DeserializeOwned>(
    uri: &Uri,
    json: Option<Map<String, Value>>,
) -> Result<P, ApiError> {
    let in_query = uri.query().is_some_and(|query| !query.is_empty());
    match json {
        Some(json) if !json.is_empty() && in_query => Err(ApiError::invalid(
            "parameters are in the query string and in JSON; use one of them",
        )),
        Some(json) if !in_query => serde_json::from_value(Value::Object(json)).map_err(json_error),
        _ => read_query(uri),
    }
}

/// JSON that cannot be parsed is malformed; JSON that says the wrong thing is invalid.
fn json_error(error: serde_json::Error) -> ApiError {
    if error.is_data() {
        ApiError::invalid(error.to_string())
    } else {
        ApiError::malformed(error.to_string())
    }
}

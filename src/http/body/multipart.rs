//! Takes a multipart body apart: one part for each image, and parameters in a part named `json`.

use super::parts::{BodyParts, JsonObject, MAX_PARAMETER_BYTES, parameters_too_long};
use super::receive::ReceivedBody;
use crate::http::body_budget::Reservation;
use crate::http::problem::ApiError;
use axum::body::Body;
use axum::extract::multipart::{Field, MultipartError};
use axum::extract::{DefaultBodyLimit, FromRequest, Multipart, Request};
use axum::http::HeaderMap;
use bytes::Bytes;
use std::convert::Infallible;

/// Bytes that the multipart parser is given at a time.
const PIECE_BYTES: usize = 64 << 10;

/// Most characters of an unknown part's name that an error repeats.
const MAX_SHOWN_NAME: usize = 80;

/// Copies the parts of a multipart body whose images have these `names`.
pub(super) async fn split_multipart(
    headers: HeaderMap,
    received: ReceivedBody,
    names: &'static [&'static str],
) -> Result<(BodyParts, Reservation), ApiError> {
    let ReceivedBody {
        bytes,
        mut reservation,
    } = received;
    // All images together are shorter than the body they are copied from.
    reservation.resize(bytes.capacity() + bytes.len() + PIECE_BYTES)?;
    let mut bytes_left = bytes.len();
    let mut multipart = parser(headers, bytes).await?;
    let mut parts = BodyParts::default();
    while let Some(field) = multipart.next_field().await.map_err(broken)? {
        let name = field.name().unwrap_or_default().to_owned();
        let content = read_field(field, bytes_left).await?;
        bytes_left = bytes_left.saturating_sub(content.len());
        add_part(&mut parts, &name, content, names)?;
    }
    Ok((parts, reservation))
}

async fn parser(headers: HeaderMap, bytes: Vec<u8>) -> Result<Multipart, ApiError> {
    let mut request = Request::new(in_pieces(Bytes::from(bytes)));
    *request.headers_mut() = headers;
    DefaultBodyLimit::disable().apply(&mut request);
    Multipart::from_request(request, &())
        .await
        .map_err(|rejection| broken_because(&rejection.body_text()))
}

/// A body that comes bit by bit. The parser copies what it is given, so it never has more than one
/// piece in memory.
fn in_pieces(mut rest: Bytes) -> Body {
    let pieces = std::iter::from_fn(move || {
        let piece = rest.split_to(rest.len().min(PIECE_BYTES));
        (!piece.is_empty()).then_some(Ok::<_, Infallible>(piece))
    });
    Body::from_stream(futures_util::stream::iter(pieces))
}

/// The content of one part, which has at most `bytes_left` bytes.
async fn read_field(mut field: Field<'_>, bytes_left: usize) -> Result<Vec<u8>, ApiError> {
    let mut content = Vec::with_capacity(bytes_left);
    while let Some(chunk) = field.chunk().await.map_err(broken)? {
        content.extend_from_slice(&chunk);
    }
    content.shrink_to_fit();
    Ok(content)
}

/// Puts a part where its name says.
fn add_part(
    parts: &mut BodyParts,
    name: &str,
    content: Vec<u8>,
    names: &'static [&'static str],
) -> Result<(), ApiError> {
    let is_repeated;
    if name == "json" {
        is_repeated = parts.parameters.is_some();
        parts.parameters = Some(parse_parameters(content)?);
    } else if let Some(&known) = names.iter().find(|known| **known == name) {
        is_repeated = parts.images.iter().any(|(other, _)| *other == known);
        parts.images.push((known, content));
    } else {
        let shown: String = name.chars().take(MAX_SHOWN_NAME).collect();
        return Err(ApiError::invalid(format!(
            "the part {shown:?} is not known; use {names:?} and \"json\""
        )));
    }
    if is_repeated {
        let detail = format!("the part {name:?} was sent twice");
        return Err(ApiError::invalid(detail));
    }
    Ok(())
}

/// The part named `json`. Once parsed, JSON takes many times its length, so it may not be as long
/// as an image.
fn parse_parameters(content: Vec<u8>) -> Result<JsonObject, ApiError> {
    if content.len() > MAX_PARAMETER_BYTES {
        return Err(parameters_too_long());
    }
    JsonObject::new(content)
}

fn broken(error: MultipartError) -> ApiError {
    broken_because(&error.body_text())
}

fn broken_because(reason: &str) -> ApiError {
    ApiError::malformed(format!("the multipart body is broken: {reason}"))
}

//! Takes a multipart body apart: one part for each image, and parameters in a part named `json`.

use super::parts::{BodyParts, JsonObject, MAX_PARAMETER_BYTES, parameters_too_long};
use super::receive::ReceivedBody;
use crate::http::memory_budget::Reservation;
use crate::http::problem::ApiError;
use axum::body::Body;
use axum::extract::multipart::{Field, MultipartError};
use axum::extract::{DefaultBodyLimit, FromRequest, Multipart, Request};
use axum::http::{HeaderMap, header};
use bytes::Bytes;
use futures_util::stream;
use memchr::memmem;
use std::convert::Infallible;
use std::task::Poll;
use tokio::runtime::Handle;

/// Bytes that the multipart parser is given at a time.
const PIECE_BYTES: usize = 64 << 10;

/// Most characters of an unknown part's name that an error repeats.
const MAX_SHOWN_NAME: usize = 80;

/// Most bytes before the first part, and of the head of a part.
const MAX_HEAD_BYTES: usize = 16 << 10;

/// Copies the parts of a multipart body whose images have these `names`. Runs on a thread that may
/// block.
pub(super) fn split_multipart(
    headers: HeaderMap,
    received: ReceivedBody,
    names: &'static [&'static str],
) -> Result<(BodyParts, Reservation), ApiError> {
    check_heads(&headers, &received.bytes)?;
    // The parser is asynchronous, but all that it waits for is there.
    Handle::current().block_on(split(headers, received, names))
}

/// Refuses a body in which what comes before the content of a part is long: the parser keeps all of
/// it and searches it again with every piece, so that it would take quadratic time.
fn check_heads(headers: &HeaderMap, bytes: &[u8]) -> Result<(), ApiError> {
    let content_type = headers.get(header::CONTENT_TYPE);
    let content_type = content_type.and_then(|value| value.to_str().ok());
    let boundary = multer::parse_boundary(content_type.unwrap_or_default())
        .map_err(|error| broken_because(&error.to_string()))?;
    let opening = format!("--{boundary}");
    let delimiter = format!("\r\n{opening}");
    let delimiter = memmem::Finder::new(&delimiter);
    let mut at = find_soon(bytes, opening.as_bytes())
        .ok_or_else(|| broken_because("no part begins soon after its start"))?;
    loop {
        let rest = bytes.get(at..).unwrap_or_default();
        if rest.starts_with(b"--") {
            return Ok(());
        }
        let head = find_soon(rest, b"\r\n\r\n");
        let head = head.ok_or_else(|| broken_because("the head of a part does not end soon"))?;
        // The two bytes before may begin the next delimiter, where a part has no content.
        let content = &rest[head - 2..];
        match delimiter.find(content) {
            Some(end) => at += head - 2 + end + delimiter.needle().len(),
            // The parser says what is missing.
            None => return Ok(()),
        }
    }
}

/// Where the first `needle` ends, if that is near the start.
fn find_soon(bytes: &[u8], needle: &[u8]) -> Option<usize> {
    let near = &bytes[..bytes.len().min(MAX_HEAD_BYTES)];
    memmem::find(near, needle).map(|found| found + needle.len())
}

async fn split(
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

/// A body that comes bit by bit. The parser copies whatever is there before it looks at any of it,
/// so there is a pause before each piece, and it never has more than one piece in memory.
fn in_pieces(mut rest: Bytes) -> Body {
    let mut has_paused = false;
    let pieces = stream::poll_fn(move |context| {
        has_paused = !has_paused;
        if has_paused {
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        let piece = rest.split_to(rest.len().min(PIECE_BYTES));
        Poll::Ready((!piece.is_empty()).then_some(Ok::<_, Infallible>(piece)))
    });
    Body::from_stream(pieces)
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

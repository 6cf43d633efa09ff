//! Every failure as RFC 9457 `application/problem+json`, from the one error table.
//!
//! Handlers return [`ApiError`]; its response carries the error itself as an extension and no body.
//! The outermost layer writes the body with [`finish`], because only it knows the request's id. It
//! also gives the same shape to whatever else answers with an error status: the router's 404 and
//! 405, and a panic.

use crate::pipeline::PipelineError;
use axum::body::Body;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{InvalidName, InvalidValue};
use serde::Serialize;
use std::time::Duration;
use utoipa::ToSchema;

/// Media type of every error.
pub const PROBLEM_JSON: &str = "application/problem+json";

/// An error on its way to the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{detail}")]
pub struct ApiError {
    /// The row of the error table.
    pub code: ErrorCode,
    /// What exactly is wrong with this request.
    pub detail: String,
    /// When to come back, if that is known better than the error table knows it.
    pub retry_after: Option<Duration>,
}

/// What a client sees of an error (RFC 9457).
#[derive(Debug, Serialize, ToSchema)]
#[schema(example = json!({
    "type": "urn:placeformer:error:map_not_found", "title": "The map does not exist", "status": 404,
    "code": "map_not_found", "detail": "there is no map harbour",
    "request_id": "0197f3c2-7c1e-7d3a-9b1f-2f6f0c1d2e3f", "retryable": false
}))]
pub struct ProblemBody {
    /// `urn:placeformer:error:` and the code.
    #[serde(rename = "type")]
    pub kind: String,
    /// The code in words; never changes for a code.
    pub title: &'static str,
    /// The HTTP status.
    pub status: u16,
    /// The stable name to match on.
    pub code: &'static str,
    /// What exactly is wrong with this request.
    pub detail: String,
    /// The request's id, as in the `x-request-id` header and in the logs.
    pub request_id: String,
    /// Whether the same request may succeed later.
    pub retryable: bool,
}

impl ApiError {
    /// An error with its cause in words.
    pub fn new(code: ErrorCode, detail: impl Into<String>) -> Self {
        Self {
            code,
            detail: detail.into(),
            retry_after: None,
        }
    }

    /// `invalid_parameter`: a parameter is missing, unknown, of the wrong type or out of range.
    pub fn invalid(detail: impl Into<String>) -> Self {
        Self::new(ErrorCode::InvalidParameter, detail)
    }

    /// `malformed_request`: the request cannot be parsed.
    pub fn malformed(detail: impl Into<String>) -> Self {
        Self::new(ErrorCode::MalformedRequest, detail)
    }

    /// Says when to come back, where that is known better than the error table knows it. It counts
    /// only for codes that have a `Retry-After` in the table.
    pub fn retry_after(mut self, after: Duration) -> Self {
        self.retry_after = Some(after);
        self
    }

    /// The error as it is written to the client.
    pub fn body(&self, request_id: &str) -> ProblemBody {
        ProblemBody {
            kind: format!("urn:placeformer:error:{}", self.code.as_str()),
            title: self.code.title(),
            status: self.code.status(),
            code: self.code.as_str(),
            detail: self.detail.clone(),
            request_id: request_id.to_owned(),
            retryable: self.code.retryable(),
        }
    }
}

/// A header that the answer to an error carries, sent and documented alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorHeader {
    /// How many seconds to wait before sending the request again.
    RetryAfter(u32),
    /// How to present a key.
    WwwAuthenticate,
}

impl ErrorHeader {
    /// The headers of an answer with `code`, with the values of the error table.
    pub fn of(code: ErrorCode) -> Vec<Self> {
        let mut headers = Vec::new();
        if let Some(seconds) = code.retry_after() {
            headers.push(Self::RetryAfter(seconds));
        }
        if code == ErrorCode::Unauthorized {
            headers.push(Self::WwwAuthenticate);
        }
        headers
    }

    /// Its name.
    pub fn name(self) -> HeaderName {
        match self {
            Self::RetryAfter(_) => header::RETRY_AFTER,
            Self::WwwAuthenticate => header::WWW_AUTHENTICATE,
        }
    }

    /// Its value.
    pub fn value(self) -> HeaderValue {
        match self {
            Self::RetryAfter(seconds) => HeaderValue::from(seconds),
            Self::WwwAuthenticate => HeaderValue::from_static("Bearer"),
        }
    }
}

/// Sets the headers of an answer with `code`, with the values of the error table.
pub fn set_error_headers(headers: &mut HeaderMap, code: ErrorCode) {
    for header in ErrorHeader::of(code) {
        headers.insert(header.name(), header.value());
    }
}

impl From<PipelineError> for ApiError {
    fn from(error: PipelineError) -> Self {
        let code = error.code();
        // Only what somebody has to repair is loud. A refusal for want of capacity or room is counted
        // in the metrics, and a deadline is what the client asked for.
        match code.status() {
            500 => {
                tracing::error!(code = code.as_str(), error = %error_chain(&error), "request failed");
            }
            501.. => {
                let error = error_chain(&error);
                tracing::debug!(code = code.as_str(), %error, "request refused");
            }
            _ => {}
        }
        // What broke inside is for the log; a client can do nothing with it.
        let detail = match code {
            ErrorCode::Internal => {
                "the server failed; the log names the cause under this request's id".to_owned()
            }
            _ => error_chain(&error),
        };
        Self {
            code,
            detail,
            retry_after: error.retry_after(),
        }
    }
}

impl From<InvalidValue> for ApiError {
    fn from(error: InvalidValue) -> Self {
        Self::invalid(error.to_string())
    }
}

impl From<InvalidName> for ApiError {
    fn from(error: InvalidName) -> Self {
        Self::invalid(error.to_string())
    }
}

/// The error with its causes. A cause whose words are already in the text is left out, because many
/// errors repeat their source.
pub fn error_chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let words = cause.to_string();
        if !text.contains(&words) {
            text = format!("{text}: {words}");
        }
        source = cause.source();
    }
    text
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let mut response = status_of(self.code).into_response();
        response.extensions_mut().insert(self);
        response
    }
}

fn status_of(code: ErrorCode) -> StatusCode {
    // Every status of the table lies in 400..600; its test says so.
    StatusCode::from_u16(code.status()).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR)
}

/// Marks an error response that has its own documented body, so that it is left as it is.
#[derive(Debug, Clone, Copy)]
pub struct OwnBody;

/// Gives an error response its headers and its body; leaves every other response alone.
pub fn finish(response: Response, request_id: &str) -> Response {
    let status = response.status();
    let is_error = status.is_client_error() || status.is_server_error();
    if !is_error || response.extensions().get::<OwnBody>().is_some() {
        return response;
    }
    let (mut parts, _) = response.into_parts();
    let error = match parts.extensions.remove::<ApiError>() {
        Some(error) => error,
        None => framework_error(status),
    };
    parts.status = status_of(error.code);
    set_problem_headers(&mut parts.headers, &error);
    // A struct of strings and numbers always serialises.
    let body = serde_json::to_vec(&error.body(request_id)).unwrap_or_default();
    Response::from_parts(parts, Body::from(body))
}

fn set_problem_headers(headers: &mut HeaderMap, error: &ApiError) {
    set_error_headers(headers, error.code);
    if let Some(after) = error.retry_after
        && headers.contains_key(header::RETRY_AFTER)
    {
        let seconds = after.as_secs_f64().ceil().max(1.0) as u64;
        headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    }
    if matches!(
        error.code,
        ErrorCode::RequestTimeout | ErrorCode::BodyTooLarge
    ) {
        // The rest of the body is not read, so the connection cannot be used again.
        headers.insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    headers.remove(header::CONTENT_LENGTH);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(PROBLEM_JSON));
}

/// The error for a status that the framework answered by itself.
fn framework_error(status: StatusCode) -> ApiError {
    match status {
        StatusCode::NOT_FOUND => ApiError::new(
            ErrorCode::RouteNotFound,
            "see /docs for the paths there are",
        ),
        StatusCode::METHOD_NOT_ALLOWED => ApiError::new(
            ErrorCode::MethodNotAllowed,
            "the Allow header names the methods this path supports",
        ),
        StatusCode::PAYLOAD_TOO_LARGE => {
            ApiError::new(ErrorCode::BodyTooLarge, "the body is larger than allowed")
        }
        StatusCode::UNSUPPORTED_MEDIA_TYPE => ApiError::new(
            ErrorCode::UnsupportedMediaType,
            "the body's media type is not supported here",
        ),
        StatusCode::REQUEST_TIMEOUT => ApiError::new(
            ErrorCode::RequestTimeout,
            "the request took too long to arrive",
        ),
        status if status.is_client_error() => {
            ApiError::malformed("the request cannot be understood")
        }
        _ => ApiError::new(ErrorCode::Internal, "the server failed"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_asks_to_come_back_exactly_if_the_table_says_so() {
        for &code in ErrorCode::ALL {
            let response = finish(ApiError::new(code, "x").into_response(), "id");
            let sent = response.headers().get(header::RETRY_AFTER);
            let seconds = sent.map(|value| value.to_str().unwrap().parse().unwrap());
            assert_eq!(seconds, code.retry_after(), "{}", code.as_str());
        }
    }

    #[test]
    fn a_time_known_better_replaces_that_of_the_table() {
        let header_of = |code, milliseconds| {
            let after = Duration::from_millis(milliseconds);
            let error = ApiError::new(code, "x").retry_after(after);
            let response = finish(error.into_response(), "id");
            response.headers().get(header::RETRY_AFTER).cloned()
        };
        assert_eq!(header_of(ErrorCode::Overloaded, 2001).unwrap(), "3");
        assert_eq!(header_of(ErrorCode::RateLimited, 2).unwrap(), "1");
        assert_eq!(header_of(ErrorCode::MapNotFound, 2001), None);
    }
}

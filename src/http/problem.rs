//! Every failure as RFC 9457 `application/problem+json`, from the one error table.
//!
//! Handlers return [`ApiError`]; its response carries the error itself as an extension and no body.
//! The outermost layer writes the body, because only it knows the request's id; it also turns
//! whatever else answers with an error status (the router's 404 and 405, a panic) into the same
//! shape.

use crate::pipeline::PipelineError;
use axum::body::Body;
use axum::http::{HeaderValue, StatusCode, header};
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
    /// When to come back, if that is known.
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

    /// A parameter is missing, unknown, of the wrong type or out of range.
    pub fn invalid(detail: impl Into<String>) -> Self {
        Self::new(ErrorCode::InvalidParameter, detail)
    }

    /// The request cannot be parsed.
    pub fn malformed(detail: impl Into<String>) -> Self {
        Self::new(ErrorCode::MalformedRequest, detail)
    }

    /// Sets when to come back.
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

    /// Answers that ask the client to come back say when: as known, else after a second.
    fn retry_after_seconds(&self) -> Option<u64> {
        let asks = matches!(self.code.status(), 429 | 503 | 504 | 507);
        let known = self
            .retry_after
            .map(|after| after.as_secs_f64().ceil().max(1.0) as u64);
        known.or(asks.then_some(if self.code == ErrorCode::DiskFull {
            30
        } else {
            1
        }))
    }
}

impl From<PipelineError> for ApiError {
    fn from(error: PipelineError) -> Self {
        let code = error.code();
        if code.status() >= 500 && code.status() != 503 {
            tracing::error!(code = code.as_str(), error = %error_chain(&error), "request failed");
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

/// The error with its causes, those left out that repeat what was said.
fn error_chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let said = error.to_string();
        if !text.contains(&said) {
            text = format!("{text}: {said}");
        }
        cause = error.source();
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

/// Gives an error response its body; leaves every other response alone.
pub fn finish(response: Response, request_id: &str) -> Response {
    let status = response.status();
    let is_error = status.is_client_error() || status.is_server_error();
    if !is_error || response.extensions().get::<OwnBody>().is_some() {
        return response;
    }
    let (mut parts, _) = response.into_parts();
    let error = parts
        .extensions
        .remove::<ApiError>()
        .unwrap_or_else(|| of_status(status));
    parts.status = status_of(error.code);
    if let Some(seconds) = error.retry_after_seconds() {
        parts
            .headers
            .insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    }
    if error.code == ErrorCode::Unauthorized {
        parts
            .headers
            .insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    }
    if matches!(
        error.code,
        ErrorCode::RequestTimeout | ErrorCode::BodyTooLarge
    ) {
        // The rest of the body is not read, so the connection cannot be used again.
        parts
            .headers
            .insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    parts.headers.remove(header::CONTENT_LENGTH);
    parts
        .headers
        .insert(header::CONTENT_TYPE, HeaderValue::from_static(PROBLEM_JSON));
    // A struct of strings and numbers always serialises.
    let body = serde_json::to_vec(&error.body(request_id)).unwrap_or_default();
    Response::from_parts(parts, Body::from(body))
}

/// An error that the framework answered by itself.
fn of_status(status: StatusCode) -> ApiError {
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

//! The outermost layer: gives every request an id and a span, gives an error its body, and counts
//! and logs the answer.

use super::problem::{self, ApiError};
use super::route::AccessLog;
use super::routes;
use super::state::AppState;
use crate::ops::metrics::Rejection;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderValue, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use placeformer_core::error::ErrorCode;
use std::time::Instant;
use tracing::Instrument;
use uuid::Uuid;

/// Header that carries the request's id both ways.
pub const REQUEST_ID: &str = "x-request-id";

/// Longest id that is taken over from a client.
const MAX_REQUEST_ID_BYTES: usize = 128;

/// The label of all paths that no route has.
const UNMATCHED: &str = "unmatched";

/// The layer itself.
///
/// Cancel safety: the future is dropped when the client leaves; its [`RequestRecord`] then counts
/// and logs that.
pub async fn observe(State(state): State<AppState>, request: Request, next: Next) -> Response {
    let request_id = accepted_or_new_id(&request);
    let method = method_label(request.method());
    let span = tracing::info_span!(
        "request",
        request_id,
        method,
        path = request.uri().path(),
        key = tracing::field::Empty
    );
    let mut record = RequestRecord {
        state: state.clone(),
        route: route_label(&request),
        method,
        started: Instant::now(),
        span: span.clone(),
        is_answered: false,
    };
    let response = answer_before_stop(&state, request, next)
        .instrument(span)
        .await;
    let mut response = problem::finish(response, &request_id);
    if let Ok(value) = HeaderValue::from_str(&request_id) {
        response.headers_mut().insert(REQUEST_ID, value);
    }
    record.answered(&response);
    response
}

/// The answer of the inner layers, or `shutting_down` if the server stops before they have one.
async fn answer_before_stop(state: &AppState, request: Request, next: Next) -> Response {
    tokio::select! {
        biased;
        response = next.run(request) => response,
        () = state.stopping.cancelled() => {
            state.metrics.rejected(Rejection::Draining);
            let detail = "the server stopped before this was done";
            ApiError::new(ErrorCode::ShuttingDown, detail).into_response()
        }
    }
}

/// The client's own id if it is harmless in a log line, else a new one.
fn accepted_or_new_id(request: &Request) -> String {
    let given = request.headers().get(REQUEST_ID);
    let given = given.and_then(|value| value.to_str().ok());
    match given {
        Some(id) if is_harmless_id(id) => id.to_owned(),
        _ => Uuid::now_v7().to_string(),
    }
}

fn is_harmless_id(id: &str) -> bool {
    let is_harmless = |byte: u8| byte.is_ascii_alphanumeric() || b"._-".contains(&byte);
    (1..=MAX_REQUEST_ID_BYTES).contains(&id.len()) && id.bytes().all(is_harmless)
}

/// The path of the request's route.
fn route_label(request: &Request) -> String {
    match request.extensions().get::<MatchedPath>() {
        Some(path) => path.as_str().to_owned(),
        None => UNMATCHED.to_owned(),
    }
}

/// The method, or `other`: clients may invent methods, and each label is a series in memory.
fn method_label(method: &Method) -> &'static str {
    match method.as_str() {
        "GET" => "GET",
        "HEAD" => "HEAD",
        "POST" => "POST",
        "PUT" => "PUT",
        "PATCH" => "PATCH",
        "DELETE" => "DELETE",
        "OPTIONS" => "OPTIONS",
        _ => "other",
    }
}

/// Counts and logs one request, either when it is answered or, if it never is, when it is dropped.
struct RequestRecord {
    state: AppState,
    route: String,
    method: &'static str,
    started: Instant,
    span: tracing::Span,
    is_answered: bool,
}

impl RequestRecord {
    fn answered(&mut self, response: &Response) {
        self.is_answered = true;
        self.write(response.status().as_u16());
    }

    fn write(&self, status: u16) {
        let took = self.started.elapsed();
        self.state
            .metrics
            .request(&self.route, self.method, status, took);
        let ms = took.as_secs_f64() * 1e3;
        self.span
            .in_scope(|| match routes::access_log_of(&self.route) {
                AccessLog::Quiet => tracing::debug!(status, ms, "answered"),
                AccessLog::Logged => tracing::info!(status, ms, "answered"),
            });
    }
}

impl Drop for RequestRecord {
    fn drop(&mut self) {
        if !self.is_answered {
            self.state.metrics.rejected(Rejection::ClientGone);
            self.write(ErrorCode::ClientGone.status());
        }
    }
}

//! Around every request: an id, a span, a line in the log, its metrics, and the body of its error.

use super::AppState;
use super::problem::{self, ApiError};
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

/// The layer itself.
///
/// Cancel safety: dropped when the client leaves; the guard then counts and logs that.
pub async fn observe(State(state): State<AppState>, request: Request, next: Next) -> Response {
    let request_id = accepted_or_minted(&request);
    let method = method_label(request.method());
    let matched = request.extensions().get::<MatchedPath>();
    let route = matched.map_or("unmatched", MatchedPath::as_str).to_owned();
    let span = tracing::info_span!(
        "request",
        request_id,
        method,
        path = request.uri().path(),
        key = tracing::field::Empty
    );
    let mut guard = Guard {
        state: state.clone(),
        route,
        method,
        started: Instant::now(),
        span: span.clone(),
        done: false,
    };
    let stopping = state.stopping.clone();
    let answered = async {
        tokio::select! {
            biased;
            response = next.run(request) => response,
            () = stopping.cancelled() => {
                state.metrics.rejected(Rejection::Draining);
                ApiError::new(ErrorCode::ShuttingDown, "the server stopped before this was done").into_response()
            }
        }
    };
    let response = answered.instrument(span).await;
    let mut response = problem::finish(response, &request_id);
    if let Ok(value) = HeaderValue::from_str(&request_id) {
        response.headers_mut().insert(REQUEST_ID, value);
    }
    guard.answered(&response);
    response
}

/// The client's own id if it is harmless in a log line, else a new one.
fn accepted_or_minted(request: &Request) -> String {
    let harmless = |text: &&str| {
        (1..=128).contains(&text.len())
            && text
                .bytes()
                .all(|c| c.is_ascii_alphanumeric() || b"._-".contains(&c))
    };
    let given = request
        .headers()
        .get(REQUEST_ID)
        .and_then(|value| value.to_str().ok())
        .filter(harmless);
    given.map_or_else(|| Uuid::now_v7().to_string(), str::to_owned)
}

/// Methods are invented by clients; a label must not be.
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

struct Guard {
    state: AppState,
    route: String,
    method: &'static str,
    started: Instant,
    span: tracing::Span,
    done: bool,
}

impl Guard {
    fn answered(&mut self, response: &Response) {
        self.done = true;
        self.note(response.status().as_u16());
    }

    fn note(&self, status: u16) {
        let took = self.started.elapsed();
        self.state
            .metrics
            .request(&self.route, self.method, status, took);
        let ms = took.as_secs_f64() * 1e3;
        self.span.in_scope(|| match self.route.as_str() {
            "/livez" | "/readyz" | "/metrics" => tracing::debug!(status, ms, "answered"),
            _ => tracing::info!(status, ms, "answered"),
        });
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        if !self.done {
            self.state.metrics.rejected(Rejection::ClientGone);
            self.note(ErrorCode::ClientGone.status());
        }
    }
}

//! The layer that keeps reserved connections for probes.
//!
//! When all connections are taken, a few further ones are there for those who watch over the
//! service: they are told that it lives and what it measures, while everyone else is told to come
//! back. Each of these connections ends with its first answer, so that it is free again soon.

use super::connection_info::ConnectionInfo;
use super::problem::ApiError;
use super::routes;
use super::state::AppState;
use crate::ops::metrics::Rejection;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderValue, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use placeformer_core::error::ErrorCode;

/// The layer itself.
pub async fn keep_for_probes(
    State(state): State<AppState>,
    request: Request,
    next: Next,
) -> Response {
    let info = request.extensions().get::<ConnectionInfo>();
    if !info.is_some_and(|info| info.is_reserved) {
        return next.run(request).await;
    }
    let path = request.extensions().get::<MatchedPath>();
    let mut response = if path.is_some_and(|path| routes::is_probe(path.as_str())) {
        next.run(request).await
    } else {
        state.metrics.rejected(Rejection::Connections);
        let detail = "all connections are taken; this one is only for probes";
        ApiError::new(ErrorCode::Overloaded, detail).into_response()
    };
    let close = HeaderValue::from_static("close");
    response.headers_mut().insert(header::CONNECTION, close);
    response
}

//! `/livez`, `/readyz`, `/metrics`: for supervisors, balancers and Prometheus.

use crate::error::ErrorCode;
use crate::http::AppState;
use crate::http::problem::{ApiError, OwnBody};
use crate::ops::{Metrics, Unready};
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Serialize;
use utoipa::ToSchema;

/// A sign of life.
#[derive(Debug, Serialize, ToSchema)]
pub struct LiveBody {
    /// Always `live`.
    #[schema(example = "live")]
    status: &'static str,
}

/// Ready or not, and why not.
#[derive(Debug, Serialize, ToSchema)]
pub struct ReadyBody {
    /// `ready`, or why not: `loading_model`, `migrating`, `building_index`, `draining`, `disk_full`.
    #[schema(example = "ready")]
    status: &'static str,
    /// Progress of `building_index`: references indexed and in all.
    progress: Option<ProgressBody>,
}

/// How far the index is.
#[derive(Debug, Serialize, ToSchema)]
pub struct ProgressBody {
    /// References indexed.
    done: u64,
    /// References in the store.
    total: u64,
}

/// Is the process alive?
///
/// Answers as long as the process can answer anything. Restart it when it does not.
#[utoipa::path(get, path = "/livez", operation_id = "livez", tag = "service", responses(
    (status = 200, description = "It is.", body = LiveBody),
))]
pub async fn livez() -> Json<LiveBody> {
    Json(LiveBody { status: "live" })
}

/// Can it take requests?
///
/// 503 with the reason while it cannot; send requests elsewhere meanwhile, do not restart it.
#[utoipa::path(get, path = "/readyz", operation_id = "readyz", tag = "service", responses(
    (status = 200, description = "It can.", body = ReadyBody),
    (status = 503, description = "It cannot: `status` says why.", body = ReadyBody),
))]
pub async fn readyz(State(state): State<AppState>) -> Response {
    let Some(reason) = state.health.unready() else {
        return Json(ReadyBody { status: "ready", progress: None }).into_response();
    };
    let progress = match reason {
        Unready::BuildingIndex { done, total } => Some(ProgressBody { done, total }),
        _ => None,
    };
    let body = Json(ReadyBody { status: reason.as_str(), progress });
    (StatusCode::SERVICE_UNAVAILABLE, Extension(OwnBody), [(header::RETRY_AFTER, "1")], body).into_response()
}

/// Metrics for Prometheus
///
/// In the text exposition format.
#[utoipa::path(get, path = "/metrics", operation_id = "metrics", tag = "service", responses(
    (status = 200, description = "All series.", body = String, content_type = "text/plain"),
))]
pub async fn metrics(State(state): State<AppState>) -> Result<Response, ApiError> {
    if let Some(service) = state.started() {
        service.observe().await;
    }
    let text = state.metrics.render().map_err(|error| {
        tracing::error!(%error, "the metrics cannot be rendered");
        ApiError::new(ErrorCode::Internal, "the metrics cannot be rendered")
    })?;
    Ok(([(header::CONTENT_TYPE, Metrics::content_type())], text).into_response())
}

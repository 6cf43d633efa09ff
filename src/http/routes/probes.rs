//! `/livez`, `/readyz`, `/metrics`: for supervisors, balancers and Prometheus.

use crate::http::access::Access;
use crate::http::answer::BudgetedWriter;
use crate::http::body::read_query;
use crate::http::codec::Workload;
use crate::http::problem::{self, ApiError, OwnBody};
use crate::http::state::AppState;
use crate::ops::{Metrics, Unready};
use axum::extract::State;
use axum::http::{StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::MapName;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

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
    /// `ready`, or why not: `loading_model`, `migrating`, `building_index`, `draining`,
    /// `storage_lost`, `disk_full`.
    #[schema(example = "ready")]
    status: &'static str,
    /// Progress of `building_index`: references indexed and in all.
    progress: Option<ProgressBody>,
    /// Of `storage_lost`: what is wrong.
    detail: Option<String>,
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
#[utoipa::path(
    get,
    path = "/livez",
    operation_id = "livez",
    tag = "service",
    responses((status = 200, description = "It is.", body = LiveBody)),
)]
pub async fn livez() -> Json<LiveBody> {
    Json(LiveBody { status: "live" })
}

/// What is asked about.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ReadyParams {
    /// `query`: only whether queries, listings and deletions are answered, which they are on a full
    /// disk, too. Left out: also whether new references are taken.
    #[serde(rename = "for")]
    #[param(rename = "for", inline)]
    purpose: Option<ReadyFor>,
}

/// A part of the service that may be ready alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
enum ReadyFor {
    /// All that a full disk leaves.
    Query,
}

/// Can it take requests?
///
/// 503 with the reason while it cannot; send requests elsewhere meanwhile, do not restart it. A
/// balancer should ask `/readyz?for=query`: a full disk (`disk_full`) keeps a server from storing,
/// which it answers with 507 itself, but not from answering queries and deleting. Neither does a
/// data directory that has gone or cannot be written (`storage_lost`) keep it from answering
/// queries.
#[utoipa::path(
    get,
    path = "/readyz",
    operation_id = "readyz",
    tag = "service",
    params(ReadyParams),
    responses(
        (status = 200, description = "It can.", body = ReadyBody),
        (status = 503, description = "It cannot: `status` says why.", body = ReadyBody),
    ),
)]
pub async fn readyz(State(state): State<AppState>, uri: Uri) -> Result<Response, ApiError> {
    let params: ReadyParams = read_query(&uri)?;
    let unready = match params.purpose {
        Some(ReadyFor::Query) => state.health.unready_for_queries(),
        None => state.health.unready(),
    };
    Ok(answer(unready))
}

fn answer(unready: Option<Unready>) -> Response {
    let Some(reason) = unready else {
        return Json(ReadyBody {
            status: "ready",
            progress: None,
            detail: None,
        })
        .into_response();
    };
    let status = reason.as_str();
    let (progress, detail) = match reason {
        Unready::BuildingIndex { done, total } => (Some(ProgressBody { done, total }), None),
        Unready::StorageLost { reason } => (None, Some(reason)),
        _ => (None, None),
    };
    let body = ReadyBody {
        status,
        progress,
        detail,
    };
    let mut response = (
        StatusCode::SERVICE_UNAVAILABLE,
        Extension(OwnBody),
        Json(body),
    )
        .into_response();
    // The same header as of the error `not_ready`, although the body is another.
    problem::set_error_headers(response.headers_mut(), ErrorCode::NotReady);
    response
}

/// Metrics for Prometheus
///
/// In the text exposition format. Where the server has keys, the names of maps are shown to those
/// who present one, as far as it allows; for all others, and of all other maps, there is a sum.
#[utoipa::path(
    get,
    path = "/metrics",
    operation_id = "metrics",
    tag = "service",
    responses(
        (status = 200, description = "All series.", body = String, content_type = "text/plain"),
    ),
)]
pub async fn metrics(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
) -> Result<Response, ApiError> {
    state
        .metrics
        .set_ready(state.health.unready_for_queries().is_none());
    if let Some(service) = state.started() {
        service.observe().await;
    }
    let shared = state.clone();
    let text = state
        .codec
        .run(Workload::Small, move || render(&shared, &access))
        .await?;
    Ok(([(header::CONTENT_TYPE, Metrics::content_type())], text).into_response())
}

/// The text of all series. It counts against a budget until the client has taken it, because
/// everyone may ask for it.
fn render(state: &AppState, access: &Access) -> Result<Bytes, ApiError> {
    let mut writer = BudgetedWriter::new(&state.metrics_budget);
    let is_shown = |map: &MapName| access.maps.allows(map);
    match state.metrics.render_to(is_shown, &mut writer) {
        Ok(()) => Ok(writer.finish()),
        Err(error) => Err(writer.failure(&error)),
    }
}

//! `/info`: what this server runs.

use super::shapes::SizeBody;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use axum::Json;
use axum::extract::State;
use placeformer_core::types::{Calibration, ScoreKind};
use serde::Serialize;
use utoipa::ToSchema;

/// Version, model, and bounds of a server.
#[derive(Debug, Serialize, ToSchema)]
pub struct InfoBody {
    /// Version of the program.
    #[schema(example = "0.1.0")]
    pub version: &'static str,
    /// The model: maps of another one can be searched here only if they keep a head of their own
    /// for the same backbone.
    pub model: String,
    /// Images are resized to this before anything is computed.
    pub input_size: SizeBody,
    /// Scale combinations whose inliers add up to S.
    #[schema(example = json!(["1", "1+2", "2+3"]))]
    pub scales: Vec<String>,
    /// What candidates are ordered by, where what that takes is known.
    pub score: ScoreKind,
    /// What `matched` and `confidence` come from on maps without a calibration of their own; null:
    /// they are null there.
    pub calibration: Option<Calibration>,
    /// Bounds and defaults of requests.
    pub limits: LimitsBody,
}

/// Bounds and defaults of requests.
#[derive(Debug, Serialize, ToSchema)]
pub struct LimitsBody {
    /// Largest image in bytes.
    pub max_image_bytes: usize,
    /// Results of a query that does not say.
    pub top_k: usize,
    /// Candidates of a query that does not say.
    pub candidates: usize,
    /// Most results or candidates.
    pub max_candidates: usize,
    /// Milliseconds for a query that does not say, and the most it may ask for.
    pub deadline_ms: u64,
    /// Longest metadata in bytes of JSON.
    pub max_metadata_bytes: usize,
    /// Most references in a page.
    pub max_page: usize,
}

/// What this server runs
///
/// Its version, its model, and the bounds of requests.
#[utoipa::path(
    get,
    path = "/info",
    operation_id = "info",
    tag = "service",
    responses((status = 200, description = "Version, model and bounds.", body = InfoBody)),
)]
pub async fn info(State(state): State<AppState>) -> Result<Json<InfoBody>, ApiError> {
    let info = state.service()?.info();
    Ok(Json(InfoBody {
        version: env!("CARGO_PKG_VERSION"),
        model: info.model.to_string(),
        input_size: SizeBody {
            width: info.input_size.width,
            height: info.input_size.height,
        },
        scales: info.rerank.scales.iter().map(ToString::to_string).collect(),
        score: info.rerank.score,
        calibration: info.calibration,
        limits: LimitsBody {
            max_image_bytes: state.max_image_bytes,
            top_k: info.pipeline.top_k,
            candidates: info.pipeline.candidates,
            max_candidates: info.pipeline.max_candidates,
            deadline_ms: info.pipeline.deadline_ms,
            max_metadata_bytes: info.pipeline.max_metadata_bytes,
            max_page: state.http.max_page,
        },
    }))
}

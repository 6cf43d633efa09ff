//! `/query`: which place does this photo show?

use super::shapes::{LocationBody, location, timed, timings_ms};
use crate::http::access::Access;
use crate::http::body::{ImageUpload, read_upload};
use crate::http::examples;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use crate::pipeline::{QueryAnswer, QueryOptions, QueryRequest, QueryResult, UnmatchedReason};
use axum::Extension;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::Response;
use placeformer_core::types::{
    Deadline, GeoCircle, GeoPoint, MapName, Metadata, ReferenceFilter, ScoreKind, Timestamp,
};
use placeformer_vision::rerank::PairScore;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use utoipa::{IntoParams, PartialSchema, ToSchema};

/// What the body of a query consists of.
pub static UPLOAD: ImageUpload = ImageUpload {
    images: &["image"],
    required_parameters: &["map"],
    parameters: QueryParams::schema,
    example: examples::query_body,
};

/// Where to look, how hard, and how long.
#[derive(Debug, Default, Deserialize, IntoParams, ToSchema)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct QueryParams {
    /// The map to look in. Required here or in the JSON.
    #[schema(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", value_type = Option<String>)]
    #[param(
        pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
        value_type = Option<String>,
        example = "harbour",
    )]
    #[serde(default)]
    pub map: Option<MapName>,
    /// Results wanted; 10 unless configured otherwise.
    #[schema(minimum = 1, maximum = 1000)]
    #[param(minimum = 1, maximum = 1000, example = 10)]
    pub top_k: Option<usize>,
    /// Nearest neighbours that are re-ranked; 100 unless configured otherwise.
    #[schema(minimum = 1, maximum = 1000)]
    #[param(minimum = 1, maximum = 1000, example = 100)]
    pub candidates: Option<usize>,
    /// False: answer with the global ranking.
    pub rerank: Option<bool>,
    /// Only references around this position, `lat,lon`; needs `radius_m`.
    #[param(example = "51.5072,-0.1276")]
    pub near: Option<String>,
    /// Radius around `near` in metres.
    #[schema(exclusive_minimum = 0)]
    #[param(exclusive_minimum = 0, example = 500)]
    pub radius_m: Option<f64>,
    /// Only references captured at or after this time (RFC 3339).
    #[schema(value_type = Option<String>, format = DateTime)]
    #[param(value_type = Option<String>, format = DateTime)]
    #[serde(default)]
    pub captured_after: Option<Timestamp>,
    /// Only references captured before this time (RFC 3339).
    #[schema(value_type = Option<String>, format = DateTime)]
    #[param(value_type = Option<String>, format = DateTime)]
    #[serde(default)]
    pub captured_before: Option<Timestamp>,
    /// Milliseconds for the answer, counted from the arrival of the request's head. Too short for
    /// re-ranking, the answer is the global ranking and says `"reranked": false`.
    #[schema(minimum = 1)]
    #[param(minimum = 1, example = 2000)]
    pub deadline_ms: Option<u64>,
}

/// Parameters of a query, each in its range.
#[derive(Debug)]
pub struct CheckedQuery {
    /// The map to look in.
    pub map: MapName,
    /// How to answer; the deadline is still missing.
    pub options: QueryOptions,
    /// Time for the answer, if the client says.
    pub budget: Option<Duration>,
}

impl QueryParams {
    /// Checks what the types cannot. The counts are left to the pipeline, which knows their bounds.
    ///
    /// # Errors
    /// `invalid_parameter` with the name of the parameter.
    pub fn checked(self) -> Result<CheckedQuery, ApiError> {
        let filter = ReferenceFilter {
            near: self.near()?,
            captured_after: self.captured_after,
            captured_before: self.captured_before,
        };
        if self.deadline_ms == Some(0) {
            return Err(ApiError::invalid("deadline_ms: it must be at least 1"));
        }
        let map = self
            .map
            .ok_or_else(|| ApiError::invalid("map: it is required"))?;
        Ok(CheckedQuery {
            map,
            options: QueryOptions {
                top_k: self.top_k,
                candidates: self.candidates,
                rerank: self.rerank,
                filter,
                deadline: None,
            },
            budget: self.deadline_ms.map(Duration::from_millis),
        })
    }

    fn near(&self) -> Result<Option<GeoCircle>, ApiError> {
        match (&self.near, self.radius_m) {
            (Some(near), Some(radius_m)) => Ok(Some(GeoCircle::new(parse_point(near)?, radius_m)?)),
            (None, None) => Ok(None),
            _ => Err(ApiError::invalid(
                "near and radius_m belong together: give both or neither",
            )),
        }
    }
}

fn parse_point(text: &str) -> Result<GeoPoint, ApiError> {
    let wrong = || {
        ApiError::invalid(format!(
            "near: {text:?} is not LAT,LON, such as 51.5072,-0.1276"
        ))
    };
    let (lat, lon) = text.split_once(',').ok_or_else(wrong)?;
    let parse = |part: &str| part.trim().parse::<f64>().map_err(|_| wrong());
    Ok(GeoPoint::new(parse(lat)?, parse(lon)?)?)
}

/// The ranked places.
#[derive(Debug, Serialize, ToSchema)]
pub struct QueryAnswerBody {
    /// Best first.
    pub results: Vec<QueryResultBody>,
    /// Whether the order comes from re-ranking; else it is the order of global distance.
    pub reranked: bool,
    /// What re-ranked candidates are ordered by: the number of inliers S (`paper`), S fused with
    /// the global distance (`fused`), or a learned score (`learned`); null if nothing was
    /// re-ranked.
    pub ranked_by: Option<ScoreKind>,
    /// Whether the first result is trusted: its confidence reaches the threshold of the map's
    /// calibration, else of the model's. False without any result, and for a photo that shows
    /// nothing to know a place by; else null if there is no calibration.
    pub matched: Option<bool>,
    /// Probability that the first result shows the right place; 0 without any result, and for a
    /// photo that shows nothing to know a place by; else null if there is no calibration.
    #[schema(minimum = 0, maximum = 1, example = 0.97)]
    pub confidence: Option<f64>,
    /// Why the first result is not trusted; null if it is, or if there is no calibration.
    pub unmatched_reason: Option<UnmatchedReasonName>,
    /// Milliseconds per stage, as in the `Server-Timing` header.
    #[schema(
        value_type = std::collections::HashMap<String, f64>,
        example = json!({"decode": 6.1, "extract": 210.0, "rerank": 44.9}),
    )]
    pub timings_ms: BTreeMap<&'static str, f64>,
    /// The model that computed it.
    pub model: String,
}

/// Why a first result is not trusted: there is none (`no_results`), the photo shows nothing by
/// which a place could be known (`image_uninformative`: a dark or blank frame, a covered lens), or
/// its confidence is below the threshold (`low_confidence`).
#[derive(Debug, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum UnmatchedReasonName {
    /// There is no result.
    NoResults,
    /// The photo shows nothing by which a place could be known.
    ImageUninformative,
    /// The confidence is below the threshold.
    LowConfidence,
}

impl From<UnmatchedReason> for UnmatchedReasonName {
    fn from(reason: UnmatchedReason) -> Self {
        match reason {
            UnmatchedReason::NoResults => Self::NoResults,
            UnmatchedReason::ImageUninformative => Self::ImageUninformative,
            UnmatchedReason::LowConfidence => Self::LowConfidence,
        }
    }
}

/// One place found.
#[derive(Debug, Serialize, ToSchema)]
pub struct QueryResultBody {
    /// 1 is the best.
    pub rank: usize,
    /// The reference that shows it.
    #[schema(format = Uuid)]
    pub reference_id: String,
    /// The builder's own name for it.
    pub external_id: Option<String>,
    /// Where it was taken.
    pub location: Option<LocationBody>,
    /// Euclidean distance of the global descriptors, 0 to 2.
    pub global_distance: f32,
    /// What the re-ranked results are ordered by, the largest first (`ranked_by`); null if this
    /// result was not re-ranked.
    pub score: Option<f64>,
    /// S, the number of inliers over all scale combinations; null if this result was not
    /// re-ranked.
    pub spatial_score: Option<u32>,
    /// S by scale combination; null if this result was not re-ranked.
    #[schema(example = json!({
        "s11": {"matches": 96, "inliers": 41}, "s12": {"matches": 130, "inliers": 60},
    }))]
    pub scores: Option<BTreeMap<String, CombinationBody>>,
    /// When it was taken.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub captured_at: Option<Timestamp>,
    /// Anything else the builder said.
    #[schema(value_type = Option<Object>)]
    pub metadata: Option<Metadata>,
}

/// Outcome of one scale combination.
#[derive(Debug, Clone, Copy, Serialize, ToSchema)]
pub struct CombinationBody {
    /// Mutual nearest neighbours.
    pub matches: u32,
    /// Of these, how many one homography explains.
    pub inliers: u32,
}

impl QueryResultBody {
    fn new(position: usize, result: QueryResult) -> Self {
        let pair = result.score.as_ref().map(|score| &score.pair);
        Self {
            rank: position + 1,
            reference_id: result.reference.id.to_string(),
            location: location(&result.reference),
            external_id: result.reference.fields.external_id.map(String::from),
            global_distance: result.global_distance,
            score: result.score.as_ref().map(|score| score.value),
            spatial_score: pair.map(|pair| pair.spatial_score),
            scores: pair.map(scores),
            captured_at: result.reference.fields.captured_at,
            metadata: result.reference.fields.metadata,
        }
    }
}

fn scores(score: &PairScore) -> BTreeMap<String, CombinationBody> {
    let mut bodies = BTreeMap::new();
    for combination in &score.combinations {
        let body = CombinationBody {
            matches: combination.matches,
            inliers: combination.inliers,
        };
        bodies.insert(combination.scales.score_name(), body);
    }
    bodies
}

/// Find the places a photo may show
///
/// The image is the raw body with the options as query parameters, or a multipart part `image`
/// beside a part `json`, or base64 in JSON beside the options.
#[utoipa::path(
    post,
    path = "/query",
    operation_id = "query",
    tag = "query",
    params(QueryParams),
    responses(
        (
            status = 200,
            description = "The ranked places; none if the map, or what the filter leaves of it, \
                is empty.",
            body = QueryAnswerBody,
            headers(("server-timing" = String, description = "Milliseconds per stage.")),
        ),
    ),
)]
pub async fn query(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    request: Request,
) -> Result<Response, ApiError> {
    let arrived = Instant::now();
    let service = state.service()?;
    let mut upload = read_upload::<QueryParams>(&state, request, &UPLOAD).await?;
    let image = upload.take("image")?;
    let CheckedQuery {
        map,
        mut options,
        budget,
    } = std::mem::take(&mut upload.params).checked()?;
    access.check_map(&map)?;
    let longest = Duration::from_millis(service.config().deadline_ms);
    let budget = budget.unwrap_or(longest).min(longest);
    // The time that the body took to arrive is part of the budget.
    let time_left = budget.saturating_sub(arrived.elapsed());
    options.deadline = Some(Deadline::after(time_left));
    let query = QueryRequest {
        map,
        image,
        options,
    };
    let answer = service.query(&access.caller, query).await?;
    let timings = answer.timings.clone();
    timed(&state, StatusCode::OK, &timings, || answer_body(answer)).await
}

fn answer_body(answer: QueryAnswer) -> QueryAnswerBody {
    let mut results = Vec::with_capacity(answer.results.len());
    for (position, result) in answer.results.into_iter().enumerate() {
        results.push(QueryResultBody::new(position, result));
    }
    QueryAnswerBody {
        results,
        reranked: answer.ranked_by.is_some(),
        ranked_by: answer.ranked_by,
        matched: answer.confidence.matched,
        confidence: answer.confidence.confidence,
        unmatched_reason: answer.confidence.reason.map(Into::into),
        timings_ms: timings_ms(&answer.timings),
        model: answer.model.to_string(),
    }
}

//! `/query`: which place does this photo show?

use super::shapes::{LocationBody, location, timed, timings_ms};
use crate::http::access::Access;
use crate::http::body::{ImageUpload, read_upload};
use crate::http::examples;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use crate::pipeline::{
    QueryAnswer, QueryOptions, QueryRequest, QueryResult, TrackAnswer, TrackOptions,
    UnmatchedReason,
};
use axum::Extension;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::Response;
use placeformer_core::types::{
    Altitude, Deadline, GeoCircle, GeoPoint, Heading, MapName, Metadata, ReferenceFilter,
    ScoreKind, Timestamp,
};
use placeformer_track::Estimate;
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
    /// Continues a track: the token of the previous answer, or empty to begin one. The answer is
    /// then ranked by all that is known of the vehicle, and has the next token.
    #[schema(max_length = 8192)]
    #[param(max_length = 8192, example = "")]
    pub track: Option<String>,
    /// When the frame was taken (RFC 3339), by the vehicle's clock; with every frame of a track or
    /// with none. Left out: when it arrives.
    #[schema(value_type = Option<String>, format = DateTime)]
    #[param(value_type = Option<String>, format = DateTime)]
    #[serde(default)]
    pub captured_at: Option<Timestamp>,
    /// Metres that the vehicle moved since the previous frame, by odometry.
    #[schema(minimum = 0)]
    #[param(minimum = 0, example = 12.5)]
    pub moved_m: Option<f64>,
    /// Standard deviation of `moved_m`; a tenth of it and a metre if left out.
    #[schema(minimum = 0)]
    #[param(minimum = 0, example = 0.5)]
    pub moved_sigma_m: Option<f64>,
    /// Degrees that the vehicle turned since the previous frame, clockwise positive.
    #[schema(minimum = -3600, maximum = 3600)]
    #[param(minimum = -3600, maximum = 3600, example = -15)]
    pub turned_deg: Option<f64>,
    /// Standard deviation of `turned_deg`; 5 if left out.
    #[schema(exclusive_minimum = 0, maximum = 360)]
    #[param(exclusive_minimum = 0, maximum = 360, example = 2)]
    pub turned_sigma_deg: Option<f64>,
    /// Highest speed of the vehicle in metres a second, which bounds how far it came where there is
    /// no `moved_m`; 40 unless configured otherwise.
    #[schema(exclusive_minimum = 0, maximum = 1000)]
    #[param(exclusive_minimum = 0, maximum = 1000, example = 14)]
    pub max_speed_mps: Option<f64>,
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
        let track = self.track_options()?;
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
                track,
            },
            budget: self.deadline_ms.map(Duration::from_millis),
        })
    }

    /// What continues a track. The numbers are left to the pipeline, which knows their bounds.
    fn track_options(&self) -> Result<Option<TrackOptions>, ApiError> {
        let only_in_tracks = [
            ("captured_at", self.captured_at.is_some()),
            ("moved_m", self.moved_m.is_some()),
            ("moved_sigma_m", self.moved_sigma_m.is_some()),
            ("turned_deg", self.turned_deg.is_some()),
            ("turned_sigma_deg", self.turned_sigma_deg.is_some()),
            ("max_speed_mps", self.max_speed_mps.is_some()),
        ];
        let Some(token) = &self.track else {
            return match only_in_tracks.iter().find(|(_, is_given)| *is_given) {
                Some((name, _)) => Err(ApiError::invalid(format!("{name}: it needs track"))),
                None => Ok(None),
            };
        };
        Ok(Some(TrackOptions {
            token: token.clone(),
            captured_at: self.captured_at,
            moved_m: self.moved_m,
            moved_sigma_m: self.moved_sigma_m,
            turned_deg: self.turned_deg,
            turned_sigma_deg: self.turned_sigma_deg,
            max_speed_mps: self.max_speed_mps,
        }))
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
    /// Whether the candidates were re-ranked; the order is then that of S, else that of global
    /// distance. In a track it is that of the probability by all that is known.
    pub reranked: bool,
    /// What re-ranked candidates are ordered by: the number of inliers S (`paper`), S fused with
    /// the global distance (`fused`), or a learned score (`learned`); null if nothing was
    /// re-ranked.
    pub ranked_by: Option<ScoreKind>,
    /// Whether the first result is trusted: its confidence reaches the threshold of the map's
    /// calibration, else of the model's. False without any result, and for a photo that shows
    /// nothing to know a place by; else null if there is no calibration. In a track the confidence
    /// is that of the track.
    pub matched: Option<bool>,
    /// Probability that the first result shows the right place; 0 without any result, and for a
    /// photo that shows nothing to know a place by; else null if there is no calibration.
    #[schema(minimum = 0, maximum = 1, example = 0.97)]
    pub confidence: Option<f64>,
    /// Why the first result is not trusted; null if it is, or if there is no calibration.
    pub unmatched_reason: Option<UnmatchedReasonName>,
    /// Where exactly the photo was taken; null if the first result is not trusted, or has no
    /// position.
    pub estimate: Option<EstimateBody>,
    /// The track after this frame; null if the query is not one of a track.
    pub track: Option<TrackBody>,
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

/// Where a trusted photo was taken: the mean of the references that see the place, each weighed by
/// its probability.
#[derive(Debug, Serialize, ToSchema)]
pub struct EstimateBody {
    /// Latitude in degrees.
    pub lat: f64,
    /// Longitude in degrees.
    pub lon: f64,
    /// Height in metres, as the references say it; null if none of them does.
    pub alt: Option<f64>,
    /// Degrees clockwise from north; null if no reference has a heading.
    pub heading: Option<f64>,
    /// Radius in metres that holds the true position in 68 of 100 cases.
    pub accuracy_m: f64,
    /// Degrees to each side that hold the true heading in 68 of 100 cases; null without one.
    pub accuracy_deg: Option<f64>,
    /// Covariance of the position in square metres: east-east, east-north, north-east,
    /// north-north.
    #[schema(example = json!([31.2, 4.0, 4.0, 27.5]))]
    pub horizontal_covariance: [f64; 4],
}

impl From<Estimate> for EstimateBody {
    fn from(estimate: Estimate) -> Self {
        Self {
            lat: estimate.point.lat(),
            lon: estimate.point.lon(),
            alt: estimate.alt.map(Altitude::metres),
            heading: estimate.heading.map(Heading::degrees),
            accuracy_m: estimate.accuracy_m,
            accuracy_deg: estimate.accuracy_deg,
            horizontal_covariance: estimate.covariance,
        }
    }
}

/// What is known of a vehicle after a frame.
#[derive(Debug, Serialize, ToSchema)]
pub struct TrackBody {
    /// To be sent as `track` with the next frame, to any node that has the same key.
    #[schema(max_length = 8192)]
    pub token: String,
    /// Probability that the vehicle is where the first result shows it.
    #[schema(minimum = 0, maximum = 1, example = 0.99)]
    pub probability: f64,
    /// Whether the vehicle is more likely at no known place.
    pub lost: bool,
    /// Frames so far.
    #[schema(minimum = 1, example = 17)]
    pub frames: u32,
}

impl From<TrackAnswer> for TrackBody {
    fn from(track: TrackAnswer) -> Self {
        Self {
            token: track.token,
            probability: track.probability,
            lost: track.lost,
            frames: track.frames,
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
///
/// The frames of a vehicle make a track: each query takes the token of the answer before. What is
/// known of the vehicle then decides between places that look alike, and says when it is lost.
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
        estimate: answer.estimate.map(Into::into),
        track: answer.track.map(Into::into),
        timings_ms: timings_ms(&answer.timings),
        model: answer.model.to_string(),
    }
}

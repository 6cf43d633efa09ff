//! `/maps`: sets of references that are searched together.

use crate::http::access::Access;
use crate::http::answer;
use crate::http::body::{read_file, read_json};
use crate::http::codec::Workload;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use axum::extract::{Path, Request, State};
use axum::http::StatusCode;
use axum::response::Response;
use axum::{Extension, Json};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{Calibration, MapName, Timestamp};
use placeformer_store::MapInfo;
use serde::Serialize;
use utoipa::ToSchema;

/// Largest file of a head in bytes: a VLAD of 80 words of ViT-S tokens, or of 20 of ViT-L tokens.
pub const MAX_HEAD_BYTES: usize = 32 << 20;

/// A map.
#[derive(Debug, Serialize, ToSchema)]
pub struct MapBody {
    /// Its name.
    #[schema(example = "harbour")]
    pub name: String,
    /// The model that made all its descriptors.
    pub model: String,
    /// References in it.
    pub references: u64,
    /// When it was created.
    #[schema(value_type = String, format = DateTime)]
    pub created_at: Timestamp,
    /// How far its best answers can be trusted; null: as far as the model's own calibration says,
    /// see `/info`.
    pub calibration: Option<Calibration>,
}

impl From<MapInfo> for MapBody {
    fn from(info: MapInfo) -> Self {
        Self {
            name: info.name.to_string(),
            model: info.model.to_string(),
            references: info.references,
            created_at: info.created_at,
            calibration: info.calibration,
        }
    }
}

/// All maps.
#[derive(Debug, Serialize, ToSchema)]
pub struct MapList {
    /// By name.
    maps: Vec<MapBody>,
}

/// What became of a map.
#[derive(Debug, Serialize, ToSchema)]
pub struct MapDeleted {
    /// References that were deleted with it.
    references_deleted: u64,
}

/// List maps
///
/// All of them, by name; with a key that is limited to maps, those.
#[utoipa::path(
    get,
    path = "/maps",
    operation_id = "list_maps",
    tag = "maps",
    responses(
        (status = 200, description = "All maps.", body = MapList),
    ),
)]
pub async fn list(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
) -> Result<Response, ApiError> {
    let mut maps = state.service()?.maps(&access.caller).await?;
    maps.retain(|map| access.maps.allows(&map.name));
    let list = || MapList {
        maps: maps.into_iter().map(Into::into).collect(),
    };
    answer::json(&state, Workload::Large, list).await
}

/// The name in the path, of a map that the caller may use.
fn parse_name(access: &Access, text: &str) -> Result<MapName, ApiError> {
    let name = text.parse().map_err(|error| {
        ApiError::new(
            ErrorCode::MapNotFound,
            format!("no map can have this name: {error}"),
        )
    })?;
    access.check_map(&name)?;
    Ok(name)
}

/// One map
///
/// With the model it is bound to and its size.
#[utoipa::path(
    get,
    path = "/maps/{map}",
    operation_id = "get_map",
    tag = "maps",
    params(("map" = String, Path, description = "The map's name.")),
    responses(
        (status = 200, description = "The map.", body = MapBody),
    ),
)]
pub async fn get(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(map): Path<String>,
) -> Result<Json<MapBody>, ApiError> {
    let map = parse_name(&access, &map)?;
    let info = state.service()?.map(&access.caller, map).await?;
    Ok(Json(info.into()))
}

/// Delete a map
///
/// With every reference in it.
#[utoipa::path(
    delete,
    path = "/maps/{map}",
    operation_id = "delete_map",
    tag = "maps",
    params(("map" = String, Path, description = "The map's name.")),
    responses(
        (status = 200, description = "It is gone.", body = MapDeleted),
    ),
)]
pub async fn delete(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(map): Path<String>,
) -> Result<Json<MapDeleted>, ApiError> {
    let map = parse_name(&access, &map)?;
    let references_deleted = state.service()?.delete_map(&access.caller, map).await?;
    Ok(Json(MapDeleted { references_deleted }))
}

/// Calibrate a map
///
/// From the next query on, `matched` and `confidence` come from this. `placeformer eval calibrate`
/// fits it. It must have been fitted for the map's model and this server's re-ranking, else the
/// answer is 409 with both identities.
#[utoipa::path(
    put,
    path = "/maps/{map}/calibration",
    operation_id = "calibrate_map",
    tag = "maps",
    request_body = Calibration,
    params(("map" = String, Path, description = "The map's name.")),
    responses(
        (status = 200, description = "The calibration as it is stored.", body = Calibration),
    ),
)]
pub async fn set_calibration(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(map): Path<String>,
    request: Request,
) -> Result<Json<Calibration>, ApiError> {
    let service = state.service()?;
    let map = parse_name(&access, &map)?;
    let calibration: Calibration = read_json(&state, request).await?;
    service
        .set_calibration(&access.caller, map, Some(calibration.clone()))
        .await?;
    Ok(Json(calibration))
}

/// Remove a map's calibration
///
/// The model's own is in force again, if it has one.
#[utoipa::path(
    delete,
    path = "/maps/{map}/calibration",
    operation_id = "uncalibrate_map",
    tag = "maps",
    params(("map" = String, Path, description = "The map's name.")),
    responses(
        (status = 204, description = "The map has no calibration of its own."),
    ),
)]
pub async fn remove_calibration(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(map): Path<String>,
) -> Result<StatusCode, ApiError> {
    let map = parse_name(&access, &map)?;
    state
        .service()?
        .set_calibration(&access.caller, map, None)
        .await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Give a map another head
///
/// The body is a head's file, as `placeformer head fit` or `head train` writes it. The global
/// descriptors of all references are made anew from the pooled tokens that are kept, without the
/// images; the answer comes when that is done. Queries are answered throughout, with the old head
/// until the new one is in force; new references wait only for the moment of changing over. The map
/// keeps its head whatever head the server runs, and loses its calibration, which holds for the old
/// model alone.
///
/// A head made for another backbone or another pooling of tokens is refused with both identities
/// (409). One head can be given at a time (503).
#[utoipa::path(
    put,
    path = "/maps/{map}/head",
    operation_id = "give_map_head",
    tag = "maps",
    request_body(content = String, content_type = "application/octet-stream"),
    params(("map" = String, Path, description = "The map's name.")),
    responses(
        (status = 200, description = "The map with its new model.", body = MapBody),
    ),
)]
pub async fn set_head(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(map): Path<String>,
    request: Request,
) -> Result<Json<MapBody>, ApiError> {
    let service = state.service()?;
    let map = parse_name(&access, &map)?;
    let file = read_file(&state, request, MAX_HEAD_BYTES).await?;
    let info = service.set_head(&access.caller, map, Some(file)).await?;
    Ok(Json(info.into()))
}

/// Give a map the server's head
///
/// As with `PUT`, but with the head that the server itself runs, which the map then goes along
/// with. This is also how a map made by a server with another head is brought over to this one.
#[utoipa::path(
    delete,
    path = "/maps/{map}/head",
    operation_id = "remove_map_head",
    tag = "maps",
    params(("map" = String, Path, description = "The map's name.")),
    responses(
        (status = 200, description = "The map with the server's model.", body = MapBody),
    ),
)]
pub async fn remove_head(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    Path(map): Path<String>,
) -> Result<Json<MapBody>, ApiError> {
    let service = state.service()?;
    let map = parse_name(&access, &map)?;
    let info = service.set_head(&access.caller, map, None).await?;
    Ok(Json(info.into()))
}

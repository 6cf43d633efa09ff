//! `/match`: the evidence that two images show the same place.

use super::shapes::{SizeBody, timed, timings_ms};
use crate::http::access::Access;
use crate::http::body::{ImageUpload, read_upload};
use crate::http::examples;
use crate::http::problem::ApiError;
use crate::http::state::AppState;
use crate::pipeline::{MatchAnswer, MatchTarget, MatchedPair};
use axum::Extension;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::Response;
use placeformer_core::types::{PackedPatches, ReferenceId};
use placeformer_vision::rerank::CombinationMatch;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::{IntoParams, PartialSchema, ToSchema};

/// What the body of a match consists of.
pub static UPLOAD: ImageUpload = ImageUpload {
    images: &["query", "reference"],
    required_parameters: &[],
    parameters: MatchParams::schema,
    example: examples::match_body,
};

/// What to match the query image against.
#[derive(Debug, Default, Deserialize, IntoParams, ToSchema)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct MatchParams {
    /// A stored reference; instead of a second image.
    #[schema(format = Uuid)]
    #[param(format = Uuid)]
    pub reference_id: Option<String>,
    /// Whether the answer lists the key patches of both images, too. By default it does not.
    #[schema(default = false)]
    #[param(example = true)]
    pub key_patches: Option<bool>,
}

impl MatchParams {
    /// The stored reference to match against, if one is named.
    ///
    /// # Errors
    /// `invalid_parameter` if the id is not one.
    pub fn reference(&self) -> Result<Option<ReferenceId>, ApiError> {
        Ok(self.reference_id.as_deref().map(str::parse).transpose()?)
    }
}

/// Correspondences and homographies of a pair.
#[derive(Debug, Serialize, ToSchema)]
pub struct MatchAnswerBody {
    /// S, the number of inliers over all scale combinations.
    pub spatial_score: u32,
    /// By scale combination: `s11`, `s12`, `s23`, ...
    #[schema(value_type = std::collections::HashMap<String, CombinationMatchBody>)]
    pub combinations: BTreeMap<String, CombinationMatchBody>,
    /// All key patches of both images; null unless `key_patches` asks for them.
    pub key_patches: Option<KeyPatchesBody>,
    /// Positions are pixels of images of this size; both images were resized to it.
    pub input_size: SizeBody,
    /// Milliseconds per stage.
    #[schema(value_type = std::collections::HashMap<String, f64>)]
    pub timings_ms: BTreeMap<&'static str, f64>,
    /// The model that computed it.
    pub model: String,
}

/// One scale combination with its evidence.
#[derive(Debug, Serialize, ToSchema)]
pub struct CombinationMatchBody {
    /// Mutual nearest neighbours.
    pub matches: u32,
    /// Of these, how many the homography explains.
    pub inliers: u32,
    /// Row-major 3x3 matrix from query pixels to reference pixels; null if none was found.
    #[schema(min_items = 9, max_items = 9)]
    pub homography: Option<Vec<f64>>,
    /// Every mutual pair.
    pub correspondences: Vec<CorrespondenceBody>,
}

/// Two key patches that are each other's nearest.
#[derive(Debug, Serialize, ToSchema)]
pub struct CorrespondenceBody {
    /// Centre in the query image, x and y in pixels.
    #[schema(min_items = 2, max_items = 2)]
    pub query: [f32; 2],
    /// Scale of the query's patch: 1, 2 or 3.
    pub query_scale: usize,
    /// Centre in the reference image, x and y in pixels.
    #[schema(min_items = 2, max_items = 2)]
    pub reference: [f32; 2],
    /// Scale of the reference's patch: 1, 2 or 3.
    pub reference_scale: usize,
    /// Whether the homography explains it.
    pub inlier: bool,
}

/// The key patches of a pair: what was compared.
#[derive(Debug, Serialize, ToSchema)]
pub struct KeyPatchesBody {
    /// Side of a patch of scale 1 in pixels; those of scale 2 and 3 are 2 and 3 times as wide.
    pub patch_size: u16,
    /// Those of the query image, by scale, then by attention from the highest.
    pub query: Vec<KeyPatchBody>,
    /// Those of the reference image, in the same order.
    pub reference: Vec<KeyPatchBody>,
}

/// One key patch.
#[derive(Debug, Serialize, ToSchema)]
pub struct KeyPatchBody {
    /// Centre in the image, x and y in pixels.
    #[schema(min_items = 2, max_items = 2)]
    pub centre: [f32; 2],
    /// Its scale: 1, 2 or 3.
    pub scale: usize,
    /// Attention that the model pays to it, in multiples of what an even share would be.
    pub attention: f32,
}

/// Match two images
///
/// Send the images as the multipart parts `query` and `reference`, as base64 in JSON under the same
/// names, or the query as the raw body with `reference_id`.
#[utoipa::path(
    post,
    path = "/match",
    operation_id = "match_images",
    tag = "query",
    params(MatchParams),
    responses(
        (
            status = 200,
            description = "The correspondences and homographies.",
            body = MatchAnswerBody,
            headers(("server-timing" = String, description = "Milliseconds per stage.")),
        ),
    ),
)]
pub async fn match_images(
    State(state): State<AppState>,
    Extension(access): Extension<Access>,
    request: Request,
) -> Result<Response, ApiError> {
    let service = state.service()?;
    let mut upload = read_upload::<MatchParams>(&state, request, &UPLOAD).await?;
    let query = upload.take("query")?;
    let reference_id = upload.params.reference()?;
    let with_key_patches = upload.params.key_patches.unwrap_or(false);
    let other = match (upload.take_optional("reference")?, reference_id) {
        (Some(image), None) => MatchTarget::Image(image),
        (None, Some(id)) => {
            access.check_reference(service, id).await?;
            MatchTarget::Reference(id)
        }
        _ => {
            return Err(ApiError::invalid(
                "give either the image \"reference\" or reference_id",
            ));
        }
    };
    let answer = service.match_images(&access.caller, query, other).await?;
    let timings = answer.timings.clone();
    timed(&state, StatusCode::OK, &timings, move || {
        answer_body(&answer, with_key_patches)
    })
    .await
}

fn answer_body(answer: &MatchAnswer, with_key_patches: bool) -> MatchAnswerBody {
    let mut spatial_score = 0;
    let mut combinations = BTreeMap::new();
    for combination in &answer.matched.combinations {
        spatial_score += combination.score.inliers;
        let name = combination.score.scales.score_name();
        combinations.insert(name, combination_body(&answer.matched, combination));
    }
    MatchAnswerBody {
        spatial_score,
        combinations,
        key_patches: with_key_patches.then(|| key_patches_body(&answer.matched)),
        input_size: SizeBody {
            width: answer.input_size.width,
            height: answer.input_size.height,
        },
        timings_ms: timings_ms(&answer.timings),
        model: answer.model.to_string(),
    }
}

fn combination_body(pair: &MatchedPair, combination: &CombinationMatch) -> CombinationMatchBody {
    let mut correspondences = Vec::with_capacity(combination.correspondences.len());
    for correspondence in &combination.correspondences {
        let query = correspondence.query as usize;
        let reference = correspondence.reference as usize;
        correspondences.push(CorrespondenceBody {
            query: pair.query.centre(query),
            query_scale: pair.query.scale_of(query),
            reference: pair.reference.centre(reference),
            reference_scale: pair.reference.scale_of(reference),
            inlier: correspondence.inlier,
        });
    }
    CombinationMatchBody {
        matches: combination.score.matches,
        inliers: combination.score.inliers,
        homography: combination.homography.map(|matrix| matrix.to_vec()),
        correspondences,
    }
}

fn key_patches_body(pair: &MatchedPair) -> KeyPatchesBody {
    KeyPatchesBody {
        patch_size: pair.query.grid.patch_px,
        query: key_patches_of(&pair.query),
        reference: key_patches_of(&pair.reference),
    }
}

fn key_patches_of(patches: &PackedPatches) -> Vec<KeyPatchBody> {
    let mut bodies = Vec::with_capacity(patches.len());
    for row in 0..patches.len() {
        bodies.push(KeyPatchBody {
            centre: patches.centre(row),
            scale: patches.scale_of(row),
            attention: patches.attention[row].to_f32(),
        });
    }
    bodies
}

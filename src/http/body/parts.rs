//! What multipart and JSON bodies are taken apart into, and what both refuse alike.

use crate::http::problem::ApiError;
use placeformer_core::error::ErrorCode;
use serde_json::{Map, Value};

/// Bytes of a body beyond its images: parameters, multipart boundaries.
pub(super) const MAX_PARAMETER_BYTES: usize = 256 << 10;

/// Images and parameters, still in the buffers they were copied or decoded to.
#[derive(Default)]
pub(super) struct BodyParts {
    /// Each image with its name.
    pub images: Vec<(&'static str, Vec<u8>)>,
    /// The parameters; `None` if the body has no JSON.
    pub parameters: Option<Map<String, Value>>,
}

/// JSON that cannot be parsed is malformed; JSON that says the wrong thing is invalid.
pub(super) fn json_error(error: serde_json::Error) -> ApiError {
    if error.is_data() {
        ApiError::invalid(error.to_string())
    } else {
        ApiError::malformed(error.to_string())
    }
}

/// The parameters are longer than [`MAX_PARAMETER_BYTES`].
pub(super) fn parameters_too_long() -> ApiError {
    ApiError::new(
        ErrorCode::BodyTooLarge,
        format!("the parameters beside the images take more than {MAX_PARAMETER_BYTES} bytes"),
    )
}

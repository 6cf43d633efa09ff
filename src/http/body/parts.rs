//! What multipart and JSON bodies are taken apart into, and what both refuse alike.

use crate::http::problem::ApiError;
use placeformer_core::error::ErrorCode;
use serde::Deserializer;
use serde::de::{DeserializeOwned, IgnoredAny, MapAccess, Visitor};
use std::fmt;

/// Bytes of a body beyond its images: parameters, multipart boundaries.
pub(super) const MAX_PARAMETER_BYTES: usize = 256 << 10;

/// Deepest nesting of JSON, as of the parsers that others use.
const DEEPEST: usize = 127;

/// Images and parameters, still in the buffers they were copied or decoded to.
#[derive(Default)]
pub(super) struct BodyParts {
    /// Each image with its name.
    pub images: Vec<(&'static str, Vec<u8>)>,
    /// The parameters; `None` if the body has no JSON.
    pub parameters: Option<JsonObject>,
}

/// The text of a JSON object.
///
/// It stays text until it is read into the type it is meant for. A tree of values in between would
/// keep the last of several members with one name, and would round numbers.
pub(super) struct JsonObject {
    text: Vec<u8>,
    members: usize,
}

impl JsonObject {
    /// Takes a text whose syntax is checked, and that it is an object: a struct would also be read
    /// from an array.
    ///
    /// # Errors
    /// `malformed_request` if it is not JSON, `invalid_parameter` if it is no object.
    pub fn new(text: Vec<u8>) -> Result<Self, ApiError> {
        let mut deserializer = serde_json::Deserializer::from_slice(&text);
        let counted = deserializer.deserialize_map(CountMembers);
        let members = counted
            .and_then(|members| deserializer.end().map(|()| members))
            .map_err(json_error)?;
        if is_deeper_than(&text, DEEPEST) {
            let reason = format!("the JSON is nested more than {DEEPEST} levels deep");
            return Err(ApiError::malformed(reason));
        }
        Ok(Self { text, members })
    }

    /// Whether it has no members.
    pub fn is_empty(&self) -> bool {
        self.members == 0
    }

    /// Reads it.
    ///
    /// # Errors
    /// `invalid_parameter` with the name of the member that does not fit, is not known, or occurs
    /// twice.
    pub fn read<T: DeserializeOwned>(&self) -> Result<T, ApiError> {
        let mut deserializer = serde_json::Deserializer::from_slice(&self.text);
        serde_path_to_error::deserialize(&mut deserializer).map_err(|error| {
            let path = error.path().to_string();
            let reason = json_error(error.into_inner());
            // The path is a dot where the object itself is at fault.
            if path == "." {
                return reason;
            }
            ApiError::new(reason.code, format!("{path}: {}", reason.detail))
        })
    }
}

/// Whether JSON, whose syntax is known to be right, has more than `levels` open brackets anywhere.
fn is_deeper_than(json: &[u8], levels: usize) -> bool {
    let mut open = 0;
    let mut in_text = false;
    let mut is_escaped = false;
    for byte in json {
        match byte {
            _ if is_escaped => is_escaped = false,
            b'\\' => is_escaped = true,
            b'"' => in_text = !in_text,
            b'{' | b'[' if !in_text => open += 1,
            b'}' | b']' if !in_text => open -= 1,
            _ => {}
        }
        if open > levels {
            return true;
        }
    }
    false
}

struct CountMembers;

impl<'de> Visitor<'de> for CountMembers {
    type Value = usize;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
        let mut members = 0;
        while entries.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {
            members += 1;
        }
        Ok(members)
    }
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

//! Takes a JSON body apart: images as strings of base64 beside the parameters.
//!
//! The images are long, and parsed JSON takes many times the length of its text. So the body is
//! only looked at first; then the images are decoded straight from its bytes, and only the rest,
//! which is short, is kept to be parsed.

use super::parts::{BodyParts, JsonObject, MAX_PARAMETER_BYTES, json_error, parameters_too_long};
use super::receive::ReceivedBody;
use crate::http::memory_budget::Reservation;
use crate::http::problem::ApiError;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Deserializer;
use serde::de::{Error, MapAccess, Visitor};
use serde_json::value::RawValue;
use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt;

/// Fewest bytes that a member of an object takes beyond its key and value: two quotes, a colon and
/// a comma.
const MEMBER_OVERHEAD_BYTES: usize = 4;

/// Decodes the images called `names` out of a JSON body, and parses the rest.
pub(super) fn split_json(
    received: ReceivedBody,
    names: &'static [&'static str],
) -> Result<(BodyParts, Reservation), ApiError> {
    let ReceivedBody {
        bytes,
        mut reservation,
    } = received;
    let members = JsonMembers::find(&bytes, names)?;
    let mut images = Vec::with_capacity(members.images.len());
    let mut bytes_in_use = bytes.capacity();
    for (name, value) in members.images {
        let image = decode_image(name, value.get(), &mut bytes_in_use, &mut reservation)?;
        images.push((name, image));
    }
    let parts = BodyParts {
        images,
        parameters: Some(join(&members.parameters)?),
    };
    Ok((parts, reservation))
}

/// The object of these members alone. Members of one name stay two, so that they are noticed.
fn join(members: &[(String, &RawValue)]) -> Result<JsonObject, ApiError> {
    let mut text = String::from("{");
    for (i, (key, value)) in members.iter().enumerate() {
        if i > 0 {
            text.push(',');
        }
        text.push_str(&serde_json::to_string(key).map_err(json_error)?);
        text.push(':');
        text.push_str(value.get());
    }
    text.push('}');
    JsonObject::new(text.into_bytes())
}

/// Decodes one image from `json`, the JSON text of its string. Its memory is added to
/// `bytes_in_use`, which `reservation` is made to cover.
fn decode_image(
    name: &str,
    json: &str,
    bytes_in_use: &mut usize,
    reservation: &mut Reservation,
) -> Result<Vec<u8>, ApiError> {
    if !json.starts_with('"') {
        let detail = format!("{name}: it must be a string of base64");
        return Err(ApiError::invalid(detail));
    }
    *bytes_in_use += json.len() / 4 * 3 + 3;
    // Base64 needs no escapes, but some writers escape its slashes. Then the text is copied once
    // more, for as long as it is decoded.
    let is_escaped = json.contains('\\');
    let copy_bytes = if is_escaped { json.len() } else { 0 };
    reservation.resize(*bytes_in_use + copy_bytes)?;
    let base64: Cow<'_, str> = if is_escaped {
        Cow::Owned(serde_json::from_str(json).map_err(json_error)?)
    } else {
        Cow::Borrowed(json.trim_matches('"'))
    };
    STANDARD
        .decode(base64.as_ref())
        .map_err(|error| ApiError::invalid(format!("{name}: {error}")))
}

/// The members of a JSON object, as slices of its text.
struct JsonMembers<'a> {
    images: HashMap<&'static str, &'a RawValue>,
    parameters: Vec<(String, &'a RawValue)>,
}

impl<'a> JsonMembers<'a> {
    fn find(bytes: &'a [u8], names: &'static [&'static str]) -> Result<Self, ApiError> {
        let mut deserializer = serde_json::Deserializer::from_slice(bytes);
        let members = deserializer
            .deserialize_map(MemberVisitor { names })
            .map_err(json_error)?;
        deserializer.end().map_err(json_error)?;
        members.ok_or_else(parameters_too_long)
    }
}

/// Sorts the members of an object into images, which have these names, and parameters. Its value is
/// `None` if the parameters are too long; the object is read to its end all the same, because a
/// syntax error further on is the more important thing to report.
struct MemberVisitor {
    names: &'static [&'static str],
}

impl<'de> Visitor<'de> for MemberVisitor {
    type Value = Option<JsonMembers<'de>>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
        let mut members = JsonMembers {
            images: HashMap::new(),
            parameters: Vec::new(),
        };
        let mut bytes_left = Some(MAX_PARAMETER_BYTES);
        while let Some((key, value)) = entries.next_entry::<String, &RawValue>()? {
            if let Some(&name) = self.names.iter().find(|name| **name == key) {
                if members.images.insert(name, value).is_some() {
                    return Err(A::Error::duplicate_field(name));
                }
                continue;
            }
            let member_bytes = key.len() + value.get().len() + MEMBER_OVERHEAD_BYTES;
            bytes_left = bytes_left.and_then(|left| left.checked_sub(member_bytes));
            if bytes_left.is_some() {
                members.parameters.push((key, value));
            }
        }
        Ok(bytes_left.map(|_| members))
    }
}

//! The map builder's own JSON about a photo, kept as its text.

use crate::invalid::InvalidValue;
use serde::de::{Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::value::RawValue;
use std::collections::HashSet;
use std::fmt;

/// A JSON object in which no key occurs twice, at any depth.
///
/// It is kept as text and not as parsed values, because those would change what they parse: a
/// number of thirty digits, `1.0` beside `1`, `-0`, `1e400`, and the order of the keys. All of that
/// comes back as it came; only white space between the outermost members does not.
#[derive(Debug, Clone)]
pub struct Metadata(Box<RawValue>);

impl Metadata {
    /// Deepest nesting. Each level is read once more for the levels above it, so that the depth
    /// bounds the cost.
    const DEEPEST: usize = 64;

    /// Takes the text of a JSON object.
    ///
    /// # Errors
    /// It is no object, a key occurs twice in it or in an object within it, or it is nested too
    /// deeply.
    pub fn parse(text: &str) -> Result<Self, InvalidValue> {
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let parsed = Self::deserialize(&mut deserializer);
        parsed
            .and_then(|parsed| deserializer.end().map(|()| parsed))
            .map_err(|error| InvalidValue::new("metadata", error.to_string()))
    }

    /// Takes text that a store has kept. Earlier releases checked less, and what they stored is
    /// still good to read, so that only its syntax is checked.
    ///
    /// # Errors
    /// It is not JSON, or no object.
    pub fn from_stored(text: String) -> Result<Self, InvalidValue> {
        let broken = |reason: String| InvalidValue::new("metadata", reason);
        let raw = RawValue::from_string(text).map_err(|error| broken(error.to_string()))?;
        if !raw.get().starts_with('{') {
            return Err(broken("it is not a JSON object".to_owned()));
        }
        Ok(Self(raw))
    }

    /// Its text.
    pub fn as_str(&self) -> &str {
        self.0.get()
    }
}

impl PartialEq for Metadata {
    fn eq(&self, other: &Self) -> bool {
        self.as_str() == other.as_str()
    }
}

impl fmt::Display for Metadata {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl Serialize for Metadata {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.0.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Metadata {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(Members)
    }
}

/// Joins the members of an object to its text again, after checking them.
struct Members;

impl<'de> Visitor<'de> for Members {
    type Value = Metadata;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
        let mut seen = HashSet::new();
        let mut text = String::from("{");
        while let Some((key, value)) = entries.next_entry::<String, Box<RawValue>>()? {
            check_value(value.get(), Metadata::DEEPEST - 1).map_err(A::Error::custom)?;
            if !seen.is_empty() {
                text.push(',');
            }
            text.push_str(&serde_json::to_string(&key).map_err(A::Error::custom)?);
            text.push(':');
            text.push_str(value.get());
            if let Some(twice) = seen.replace(key) {
                return Err(A::Error::custom(twice_in_object(&twice)));
            }
        }
        text.push('}');
        let raw = RawValue::from_string(text).map_err(A::Error::custom)?;
        Ok(Metadata(raw))
    }
}

fn twice_in_object(key: &str) -> String {
    let shown: String = key.chars().take(80).collect();
    format!("the key {shown:?} occurs twice in one object")
}

/// Checks a value whose syntax is known to be right; `levels` may still be nested in it.
fn check_value(json: &str, levels: usize) -> Result<(), serde_json::Error> {
    let json = json.trim_start();
    match json.as_bytes().first() {
        Some(b'{' | b'[') if levels == 0 => {
            let reason = format!("it is nested more than {} levels deep", Metadata::DEEPEST);
            Err(serde_json::Error::custom(reason))
        }
        Some(b'{') => serde_json::from_str::<Distinct<'_>>(json)?
            .0
            .into_iter()
            .try_for_each(|value| check_value(value.get(), levels - 1)),
        Some(b'[') => serde_json::from_str::<Vec<&RawValue>>(json)?
            .into_iter()
            .try_for_each(|value| check_value(value.get(), levels - 1)),
        // Parsing a string finds escapes that stand for no character.
        Some(b'"') => serde_json::from_str::<String>(json).map(drop),
        // Numbers and literals are checked by the parser that cut them out.
        _ => Ok(()),
    }
}

/// The values of an object whose keys are all different.
struct Distinct<'a>(Vec<&'a RawValue>);

impl<'de: 'a, 'a> Deserialize<'de> for Distinct<'a> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(DistinctVisitor).map(Self)
    }
}

struct DistinctVisitor;

impl<'de> Visitor<'de> for DistinctVisitor {
    type Value = Vec<&'de RawValue>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
        let mut seen = HashSet::new();
        let mut values = Vec::new();
        while let Some((key, value)) = entries.next_entry::<String, &RawValue>()? {
            values.push(value);
            if let Some(twice) = seen.replace(key) {
                return Err(A::Error::custom(twice_in_object(&twice)));
            }
        }
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn nested(depth: usize) -> String {
        format!(
            "{{\"a\":{}1{}}}",
            "[".repeat(depth - 1),
            "]".repeat(depth - 1)
        )
    }

    #[test]
    fn numbers_and_order_come_back_as_they_came() {
        let text = r#"{"z":12345678901234567890123,"a":1.0,"b":1,"c":-0,"d":-0.0,"e":1e400,
            "f":1E+2,"g":0.1000,"h":{"y":1,"x":[2.50,{"k":9007199254740993}]},"i":null}"#;
        let kept = Metadata::parse(text).unwrap();
        let one_line = text.replace("\n            ", "");
        assert_eq!(kept.as_str(), one_line);
        assert_eq!(serde_json::to_string(&kept).unwrap(), one_line);
        assert_eq!(Metadata::from_stored(one_line).unwrap(), kept);
    }

    #[test]
    fn a_key_that_occurs_twice_is_refused_at_any_depth_and_however_it_is_written() {
        for text in [
            r#"{"a":1,"a":2}"#,
            r#"{"a":1,"\u0061":2}"#,
            r#"{"a":{"b":1,"b":1}}"#,
            r#"{"a":[1,[{"b":{"c":1,"d":2,"c":3}}]]}"#,
            r#"{"":1,"":2}"#,
        ] {
            let error = Metadata::parse(text).unwrap_err().to_string();
            assert!(error.contains("twice"), "{text}: {error}");
        }
        Metadata::parse(r#"{"a":{"a":{"a":[{"a":1},{"a":1}]}}}"#).unwrap();
    }

    #[test]
    fn what_is_no_object_is_refused() {
        for text in [
            "",
            "7",
            "null",
            "[]",
            "\"{}\"",
            "{",
            "{}x",
            "{\"a\":}",
            "{\"a\":01}",
            "{\"a\":NaN}",
            "{\"a\":\"\\ud800\"}",
            "{\"a\":[\"\\ud800\"]}",
            "{\"a\":1,}",
            "{a:1}",
            "{\"a\":\"\n\"}",
        ] {
            assert!(Metadata::parse(text).is_err(), "{text}");
        }
        assert_eq!(Metadata::parse(" { } ").unwrap().as_str(), "{}");
        assert!(Metadata::from_stored("[1]".into()).is_err());
        assert!(Metadata::from_stored("{".into()).is_err());
    }

    #[test]
    fn nesting_is_bounded() {
        Metadata::parse(&nested(Metadata::DEEPEST)).unwrap();
        for depth in [Metadata::DEEPEST + 1, 100_000] {
            let error = Metadata::parse(&nested(depth)).unwrap_err().to_string();
            assert!(
                error.contains("nested") || error.contains("recursion"),
                "{error}"
            );
        }
        // An earlier release allowed twice as much, and what it stored can be read.
        Metadata::from_stored(nested(126)).unwrap();
    }

    proptest! {
        #[test]
        fn members_of_any_text_survive(
            members in prop::collection::btree_map(any::<String>(), any::<String>(), 0..8),
        ) {
            let text = serde_json::to_string(&members).unwrap();
            let kept = Metadata::parse(&text).unwrap();
            prop_assert_eq!(kept.as_str(), text);
        }
    }
}

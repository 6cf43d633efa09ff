//! Which maps a caller may name, see and change.

use placeformer_core::types::{InvalidValue, MapName};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// Stands at the end of a pattern for the rest of a name.
const ANY_REST: char = '*';

/// The name of a map, or the beginning of names with a `*` behind it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct MapPattern {
    /// The name, or its beginning.
    text: String,
    /// Whether anything may follow.
    is_prefix: bool,
}

impl MapPattern {
    /// Whether a map of this name fits.
    pub fn fits(&self, map: &MapName) -> bool {
        if self.is_prefix {
            map.as_str().starts_with(&self.text)
        } else {
            map.as_str() == self.text
        }
    }
}

impl TryFrom<String> for MapPattern {
    type Error = InvalidValue;

    fn try_from(given: String) -> Result<Self, Self::Error> {
        let (text, is_prefix) = match given.strip_suffix(ANY_REST) {
            Some(beginning) => (beginning, true),
            None => (given.as_str(), false),
        };
        // The beginning of a name is a name, too, unless it is empty.
        let is_every_map = is_prefix && text.is_empty();
        if !is_every_map {
            text.parse::<MapName>().map_err(|error| {
                let reason = format!("{error}; a * may stand at the end only");
                InvalidValue::new("auth.keys", reason)
            })?;
        }
        Ok(Self {
            text: text.to_owned(),
            is_prefix,
        })
    }
}

impl From<MapPattern> for String {
    fn from(pattern: MapPattern) -> Self {
        pattern.to_string()
    }
}

impl fmt::Display for MapPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)?;
        if self.is_prefix {
            write!(f, "{ANY_REST}")?;
        }
        Ok(())
    }
}

/// The maps that exist for a caller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MapScope {
    /// Every map.
    All,
    /// Those that fit one of the patterns.
    Only(Arc<[MapPattern]>),
}

impl MapScope {
    /// The scope of a key with these `maps` in its settings.
    pub fn of(maps: Option<&[MapPattern]>) -> Self {
        match maps {
            Some(patterns) => Self::Only(patterns.into()),
            None => Self::All,
        }
    }

    /// No map.
    pub fn none() -> Self {
        Self::Only([].into())
    }

    /// Whether a map of this name is one of them.
    pub fn allows(&self, map: &MapName) -> bool {
        match self {
            Self::All => true,
            Self::Only(patterns) => patterns.iter().any(|pattern| pattern.fits(map)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scope(patterns: &[&str]) -> MapScope {
        let parse = |text: &&str| MapPattern::try_from((*text).to_owned()).unwrap();
        let patterns: Vec<MapPattern> = patterns.iter().map(parse).collect();
        MapScope::of(Some(&patterns))
    }

    #[test]
    fn a_pattern_is_a_name_or_the_beginning_of_names() {
        let allows = |patterns: &[&str], map: &str| scope(patterns).allows(&map.parse().unwrap());
        for (patterns, map, expected) in [
            (&["city"][..], "city", true),
            (&["city"], "city-2", false),
            (&["city"], "cit", false),
            (&["city-*"], "city-2", true),
            (&["city-*"], "city-", true),
            (&["city-*"], "city", false),
            (&["city-*"], "my-city-2", false),
            (&["city-*"], "City-2", false),
            (&["*"], "anything", true),
            (&["a", "b*"], "bc", true),
            (&[], "a", false),
        ] {
            assert_eq!(allows(patterns, map), expected, "{patterns:?} {map}");
        }
        assert!(MapScope::All.allows(&"a".parse().unwrap()));
    }

    #[test]
    fn what_fits_no_map_is_refused_and_the_others_survive_text() {
        for wrong in [
            "",
            "a*b",
            "**",
            "*a",
            "a/b",
            "-a",
            "a b",
            "a?",
            &"x".repeat(65),
        ] {
            assert!(MapPattern::try_from(wrong.to_owned()).is_err(), "{wrong}");
        }
        for right in ["a", "a*", "*", "A.b_c-9*"] {
            assert_eq!(
                MapPattern::try_from(right.to_owned()).unwrap().to_string(),
                right
            );
        }
    }
}

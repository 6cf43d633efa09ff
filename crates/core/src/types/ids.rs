//! Identifiers, each checked where it enters.

use super::score::ScoreKind;
use crate::invalid::InvalidName;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt;
use std::str::FromStr;
use uuid::Uuid;

/// Identifies one reference for its whole life. Time-ordered (UUID version 7), so inserts append
/// to indexes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ReferenceId(Uuid);

impl ReferenceId {
    /// A fresh identifier, greater than those generated earlier.
    pub fn generate() -> Self {
        Self(Uuid::now_v7())
    }

    /// The 16 bytes the store keeps.
    pub fn as_bytes(&self) -> &[u8; 16] {
        self.0.as_bytes()
    }

    /// Rebuilds an identifier from the store's 16 bytes.
    pub fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(Uuid::from_bytes(bytes))
    }

    /// A value derived from the identifier, for seeding deterministic algorithms.
    pub fn seed(&self) -> u64 {
        let (high, low) = self.0.as_u64_pair();
        high ^ low
    }
}

impl fmt::Display for ReferenceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl FromStr for ReferenceId {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Uuid::parse_str(text)
            .map(Self)
            .map_err(|_| InvalidName::new("reference id", text, "it must be a UUID"))
    }
}

/// A map: a set of references searched together. 1 to 64 of `A-Z a-z 0-9 . _ -`, starting with a
/// letter or digit.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct MapName(String);

impl MapName {
    /// Longest name in bytes, which are as many characters.
    const LONGEST: usize = 64;
    const RULE: &'static str = "use 1 to 64 of A-Z a-z 0-9 . _ - and start with a letter or digit";

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl MapName {
    fn allows(character: char) -> bool {
        character.is_ascii_alphanumeric() || matches!(character, '.' | '_' | '-')
    }
}

impl FromStr for MapName {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let starts_well = text.starts_with(|c: char| c.is_ascii_alphanumeric());
        let all_allowed = text.chars().all(Self::allows);
        if starts_well && all_allowed && text.len() <= Self::LONGEST {
            Ok(Self(text.to_owned()))
        } else {
            Err(InvalidName::new("map", text, Self::RULE))
        }
    }
}

impl TryFrom<String> for MapName {
    type Error = InvalidName;
    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<MapName> for String {
    fn from(name: MapName) -> Self {
        name.0
    }
}

impl fmt::Display for MapName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The caller's own name for a reference, unique within a map. 1 to 256 characters, no control
/// characters.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ExternalId(String);

impl ExternalId {
    /// Longest name in characters, which is how the OpenAPI document counts.
    const LONGEST: usize = 256;
    const RULE: &'static str = "use 1 to 256 characters, none of them a control character";

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for ExternalId {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        // Counting stops behind the longest, so that a long text costs no more than a short one.
        let characters = text.chars().take(Self::LONGEST + 1).count();
        let has_valid_length = (1..=Self::LONGEST).contains(&characters);
        if has_valid_length && !text.chars().any(char::is_control) {
            Ok(Self(text.to_owned()))
        } else {
            Err(InvalidName::new("external_id", text, Self::RULE))
        }
    }
}

impl TryFrom<String> for ExternalId {
    type Error = InvalidName;
    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<ExternalId> for String {
    fn from(id: ExternalId) -> Self {
        id.0
    }
}

impl fmt::Display for ExternalId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What a descriptor depends on: architecture, weight hash, preprocessing and head hash, as one
/// printable string.
///
/// Two descriptors compare meaningfully only if their `ModelId`s are equal; a map is bound to one.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ModelId(String);

impl ModelId {
    /// Wraps the text that extraction composed or the store returned.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// The identity as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for ModelId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What the order of candidates depends on beyond the descriptors: the settings of re-ranking as
/// one printable string. It ends with the kind of score, if that is not the paper's.
///
/// Scores compare meaningfully only if their `RerankId`s are equal.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RerankId(String);

impl RerankId {
    /// Wraps the text that re-ranking composed or a calibration carries.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// The identity of `settings` with candidates ordered by `score`.
    pub fn with_score(settings: String, score: ScoreKind) -> Self {
        match score {
            ScoreKind::Paper => Self(settings),
            ScoreKind::Fused | ScoreKind::Learned => Self(settings + ":" + score.as_str()),
        }
    }

    /// What candidates are ordered by.
    pub fn score(&self) -> ScoreKind {
        let named = self.0.rsplit(':').next();
        let mut kinds = ScoreKind::ALL.into_iter();
        let kind = kinds.find(|kind| named == Some(kind.as_str()));
        kind.unwrap_or_default()
    }

    /// The identity as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for RerankId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// SHA-256 of an image's bytes as they were sent: decides whether a repeated `external_id` is the
/// same content.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ContentHash(pub [u8; 32]);

impl ContentHash {
    /// Hashes `bytes`.
    pub fn of(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).into())
    }
}

impl fmt::Display for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex::encode(self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn map_names_reject_paths_spaces_and_excess_length() {
        for good in ["a", "demo", "Paris_2026-08.v2", &"x".repeat(64)] {
            assert!(good.parse::<MapName>().is_ok(), "{good}");
        }
        for bad in ["", ".hidden", "-x", "a/b", "a b", "é", &"x".repeat(65)] {
            assert!(bad.parse::<MapName>().is_err(), "{bad}");
        }
    }

    #[test]
    fn external_ids_reject_control_characters_and_excess_length() {
        for good in [
            "a",
            "photos/1 é.jpg",
            &"x".repeat(256),
            &"é".repeat(256),
            &"🏠".repeat(256),
        ] {
            assert!(good.parse::<ExternalId>().is_ok(), "{good}");
        }
        for bad in ["", "a\nb", "\u{7f}", &"x".repeat(257), &"🏠".repeat(257)] {
            assert!(bad.parse::<ExternalId>().is_err(), "{bad:?}");
        }
    }

    #[test]
    fn a_content_hash_prints_as_hexadecimal() {
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(ContentHash::of(b"abc").to_string(), expected);
    }

    #[test]
    fn reference_ids_survive_text_and_bytes() {
        let id = ReferenceId::generate();
        assert_eq!(id.to_string().parse::<ReferenceId>().unwrap(), id);
        assert_eq!(ReferenceId::from_bytes(*id.as_bytes()), id);
    }
}

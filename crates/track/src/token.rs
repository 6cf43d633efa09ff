//! A track on its way: all that is known after a frame, as a text that the client sends along with
//! the next.
//!
//! The client keeps the state, so that any node answers the next frame. It must not be able to make
//! one up, so a token ends with an HMAC-SHA256 over all bytes before it, by a key that the nodes
//! share. It is not encrypted: it says nothing that the answers did not.
//!
//! ```text
//! version u8 | length u16 | issued_at i64 | clock u8, captured_at i64 | frames u32
//!   | map u8 + bytes | model u16 + bytes | elsewhere f32
//!   | places u16 x (id 16 bytes, f32) | tag 32 bytes
//! ```
//!
//! Numbers are little-endian and times are microseconds since 1970. The text is base64url without
//! padding, and at most [`LONGEST_TOKEN`] characters long: the least likely places are left out.

use crate::key::TrackKey;
use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{MapName, ModelId, ReferenceId, Timestamp};
use std::time::Duration;

/// Longest token in characters.
pub const LONGEST_TOKEN: usize = 8192;

/// Most places that a token carries.
pub const MOST_PLACES: usize = 256;

/// The version of the bytes that this release writes and reads.
const VERSION: u8 = 1;

/// Bytes of version and length.
const HEAD_BYTES: usize = 3;

/// Bytes of the HMAC.
const TAG_BYTES: usize = 32;

/// Bytes of one place.
const PLACE_BYTES: usize = 20;

/// Longest identity of a model that a token has room for.
const LONGEST_MODEL: usize = 512;

/// Why a token does not continue a track.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TokenError {
    /// It is not whole, or not of this release.
    #[error("track: it is not a whole token of this release ({0}); begin again with an empty one")]
    Malformed(&'static str),
    /// It was not made with this service's key.
    #[error("track: this service did not make the token; begin again with an empty one")]
    Forged,
    /// It is too old.
    #[error(
        "track: the token is {age_s} seconds old and was good for {lifetime_s}; begin again with \
         an empty one"
    )]
    Expired {
        /// Its age in seconds.
        age_s: u64,
        /// How many seconds a token is good for.
        lifetime_s: u64,
    },
    /// It is of another map.
    #[error("track: the token is of map {of}, and the query is for map {asked}")]
    OtherMap {
        /// The token's map.
        of: MapName,
        /// The query's map.
        asked: MapName,
    },
    /// Another model described the map when it was made.
    #[error("track: the token was made with model {of}, and the map now has {now}")]
    OtherModel {
        /// The token's model.
        of: ModelId,
        /// The map's model.
        now: ModelId,
    },
}

impl TokenError {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Malformed(_) => ErrorCode::TrackMalformed,
            Self::Forged => ErrorCode::TrackForged,
            Self::Expired { .. } => ErrorCode::TrackExpired,
            Self::OtherMap { .. } => ErrorCode::TrackOtherMap,
            Self::OtherModel { .. } => ErrorCode::TrackOtherModel,
        }
    }
}

/// A reference with the probability that the vehicle is there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Believed {
    /// The reference.
    pub id: ReferenceId,
    /// Its probability.
    pub probability: f64,
}

/// What a token carries: where a vehicle was thought to be after a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// The map.
    pub map: MapName,
    /// The map's model.
    pub model: ModelId,
    /// When the token was made, by the server's clock.
    pub issued_at: Timestamp,
    /// When the frame was taken.
    pub captured_at: Timestamp,
    /// Whether `captured_at` is by the client's clock and not by the server's.
    pub by_client_clock: bool,
    /// Frames so far.
    pub frames: u32,
    /// Probability of being at none of the places.
    pub elsewhere: f64,
    /// The likeliest places; [`Track::seal`] keeps the first of them if they are too many.
    pub places: Vec<Believed>,
}

impl Track {
    /// Writes the token. The places have to be in descending order; those that it has no room for
    /// are added to what is elsewhere.
    pub fn seal(&self, key: &TrackKey) -> String {
        let kept = self.places.len().min(self.room());
        let dropped = self.places[kept..].iter().map(|place| place.probability);
        let elsewhere = self.elsewhere + dropped.sum::<f64>();

        let mut bytes = vec![VERSION, 0, 0];
        bytes.extend(self.issued_at.unix_micros().to_le_bytes());
        bytes.push(u8::from(self.by_client_clock));
        bytes.extend(self.captured_at.unix_micros().to_le_bytes());
        bytes.extend(self.frames.to_le_bytes());
        let map = self.map.as_str().as_bytes();
        // A map's name has at most 64 bytes.
        bytes.push(map.len() as u8);
        bytes.extend(map);
        let model = shortened(self.model.as_str());
        bytes.extend((model.len() as u16).to_le_bytes());
        bytes.extend(model.as_bytes());
        bytes.extend((elsewhere as f32).to_le_bytes());
        bytes.extend((kept as u16).to_le_bytes());
        for place in &self.places[..kept] {
            bytes.extend(place.id.as_bytes());
            bytes.extend((place.probability as f32).to_le_bytes());
        }
        let length = (bytes.len() + TAG_BYTES) as u16;
        bytes[1..HEAD_BYTES].copy_from_slice(&length.to_le_bytes());
        let tag = key.sign(&bytes);
        bytes.extend(tag.as_ref());
        URL_SAFE_NO_PAD.encode(bytes)
    }

    /// How many places a token of this map and model has room for.
    fn room(&self) -> usize {
        let longest_bytes = LONGEST_TOKEN / 4 * 3;
        let names = self.map.as_str().len() + shortened(self.model.as_str()).len();
        // Version, length, two times, a clock, frames, two lengths, elsewhere, number of places.
        let fixed = HEAD_BYTES + 8 + 1 + 8 + 4 + 1 + 2 + 4 + 2 + TAG_BYTES;
        let left = longest_bytes.saturating_sub(fixed + names);
        (left / PLACE_BYTES).min(MOST_PLACES)
    }

    /// Reads a token that `key` made.
    ///
    /// # Errors
    /// It is malformed or forged.
    pub fn open(text: &str, key: &TrackKey) -> Result<Self, TokenError> {
        if text.len() > LONGEST_TOKEN {
            return Err(TokenError::Malformed("it is too long"));
        }
        let bytes = URL_SAFE_NO_PAD
            .decode(text)
            .map_err(|_| TokenError::Malformed("it is not base64url"))?;
        // A token that was cut off is told from a forged one by its length, so that the fault is
        // looked for in the right place. Nothing else is believed before the tag is right.
        let mut head = Reader(&bytes);
        if head.u8()? != VERSION {
            return Err(TokenError::Malformed("its version is not known"));
        }
        if usize::from(head.u16()?) != bytes.len() || bytes.len() < HEAD_BYTES + TAG_BYTES {
            return Err(TokenError::Malformed("it is not as long as it says"));
        }
        let (message, tag) = bytes.split_at(bytes.len() - TAG_BYTES);
        if !key.verifies(message, tag) {
            return Err(TokenError::Forged);
        }
        Self::parse(&message[HEAD_BYTES..])
    }

    fn parse(bytes: &[u8]) -> Result<Self, TokenError> {
        let mut reader = Reader(bytes);
        let issued_at = reader.time()?;
        let by_client_clock = reader.u8()? != 0;
        let captured_at = reader.time()?;
        let frames = u32::from_le_bytes(reader.array()?);
        let map_length = reader.u8()?;
        let map = reader.text(usize::from(map_length))?;
        let map = map.parse().map_err(|_| TokenError::Malformed("its map"))?;
        let model_length = reader.u16()?;
        let model = ModelId::new(reader.text(usize::from(model_length))?);
        let elsewhere = reader.probability()?;
        let count = usize::from(reader.u16()?);
        let mut places = Vec::with_capacity(count.min(MOST_PLACES));
        for _ in 0..count {
            places.push(Believed {
                id: ReferenceId::from_bytes(reader.array()?),
                probability: reader.probability()?,
            });
        }
        if !reader.0.is_empty() {
            return Err(TokenError::Malformed("it goes on behind its end"));
        }
        Ok(Self {
            map,
            model,
            issued_at,
            captured_at,
            by_client_clock,
            frames,
            elsewhere,
            places,
        })
    }

    /// Whether the track can be continued in this map of this model.
    ///
    /// # Errors
    /// It is of another map or model, or older than `lifetime`.
    pub fn check(
        &self,
        map: &MapName,
        model: &ModelId,
        now: Timestamp,
        lifetime: Duration,
    ) -> Result<(), TokenError> {
        if self.map != *map {
            return Err(TokenError::OtherMap {
                of: self.map.clone(),
                asked: map.clone(),
            });
        }
        if self.model.as_str() != shortened(model.as_str()) {
            return Err(TokenError::OtherModel {
                of: self.model.clone(),
                now: model.clone(),
            });
        }
        // A node whose clock is ahead may have made it.
        let age = now
            .unix_micros()
            .saturating_sub(self.issued_at.unix_micros());
        let age = Duration::from_micros(u64::try_from(age).unwrap_or(0));
        if age > lifetime {
            return Err(TokenError::Expired {
                age_s: age.as_secs(),
                lifetime_s: lifetime.as_secs(),
            });
        }
        Ok(())
    }
}

/// As much of a model's identity as a token has room for.
fn shortened(model: &str) -> &str {
    let end = model.floor_char_boundary(LONGEST_MODEL);
    &model[..end]
}

/// The bytes that are still to be read.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn bytes(&mut self, count: usize) -> Result<&'a [u8], TokenError> {
        let split = self.0.split_at_checked(count);
        let (taken, rest) = split.ok_or(TokenError::Malformed("it ends too early"))?;
        self.0 = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], TokenError> {
        let taken = self.bytes(N)?;
        taken
            .try_into()
            .map_err(|_| TokenError::Malformed("it ends too early"))
    }

    fn u8(&mut self) -> Result<u8, TokenError> {
        let [byte] = self.array()?;
        Ok(byte)
    }

    fn u16(&mut self) -> Result<u16, TokenError> {
        Ok(u16::from_le_bytes(self.array()?))
    }

    fn time(&mut self) -> Result<Timestamp, TokenError> {
        let micros = i64::from_le_bytes(self.array()?);
        Timestamp::from_unix_micros(micros).ok_or(TokenError::Malformed("its time"))
    }

    fn probability(&mut self) -> Result<f64, TokenError> {
        let value = f64::from(f32::from_le_bytes(self.array()?));
        if (0.0..=1.0).contains(&value) {
            Ok(value)
        } else {
            Err(TokenError::Malformed("a probability in it"))
        }
    }

    fn text(&mut self, length: usize) -> Result<&'a str, TokenError> {
        let bytes = self.bytes(length)?;
        std::str::from_utf8(bytes).map_err(|_| TokenError::Malformed("a name in it"))
    }
}

#[cfg(test)]
mod tests;

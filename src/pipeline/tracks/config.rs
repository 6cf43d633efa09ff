//! Settings of tracks.

use placeformer_core::types::InvalidValue;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use utoipa::ToSchema;

/// Longest life of a token in seconds: a week.
const LONGEST_LIFETIME_S: u64 = 7 * 24 * 3600;

/// Highest speed that a vehicle can have, in metres a second.
const HIGHEST_SPEED_MPS: f64 = 1000.0;

/// Settings of tracks: queries that continue one another. The comments of the fields are printed as
/// the manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrackConfig {
    /// File with the key that tokens of tracks are authenticated with: 64 hexadecimal digits
    /// (openssl rand -hex 32). Nodes that may be sent frames of one track need the same key. Left
    /// out: track.key in the data directory, which is made with a random key if it is not there.
    #[schema(value_type = Option<String>)]
    pub key_file: Option<PathBuf>,
    /// Time for which a token is good, in seconds. A vehicle that was silent for longer begins a
    /// new track.
    pub lifetime_s: u64,
    /// Highest speed in metres a second of a vehicle that sends neither odometry nor max_speed_mps.
    pub max_speed_mps: f64,
}

impl Default for TrackConfig {
    fn default() -> Self {
        Self {
            key_file: None,
            lifetime_s: 600,
            max_speed_mps: 40.0,
        }
    }
}

impl TrackConfig {
    /// Checks the rules that the types cannot express.
    ///
    /// # Errors
    /// A value is out of range.
    pub fn check(&self) -> Result<(), InvalidValue> {
        if !(1..=LONGEST_LIFETIME_S).contains(&self.lifetime_s) {
            let reason = format!("{} is outside 1 to {LONGEST_LIFETIME_S}", self.lifetime_s);
            return Err(InvalidValue::new("tracks.lifetime_s", reason));
        }
        check_speed("tracks.max_speed_mps", self.max_speed_mps)?;
        Ok(())
    }
}

/// Checks a speed in metres a second.
pub(super) fn check_speed(field: &'static str, speed: f64) -> Result<f64, InvalidValue> {
    // NaN is in no range.
    if speed > 0.0 && speed <= HIGHEST_SPEED_MPS {
        return Ok(speed);
    }
    let reason = format!("{speed} is not above 0 and at most {HIGHEST_SPEED_MPS}");
    Err(InvalidValue::new(field, reason))
}

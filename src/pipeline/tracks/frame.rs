//! A frame of a track before its photo is looked at: the token read, the motion checked.
//!
//! All of this comes before the photo is decoded, so that a frame with a token that is not good
//! costs nothing.

use super::config::{TrackConfig, check_speed};
use placeformer_core::types::{InvalidValue, MapName, ModelId, Timestamp};
use placeformer_track::{Motion, TokenError, Track, TrackKey, Travel, Turn};
use std::time::Duration;

/// Standard deviation of a distance by odometry that does not say its own: a share, and metres.
const ODOMETRY_SHARE: f64 = 0.1;
const ODOMETRY_FLOOR_M: f64 = 1.0;

/// Standard deviation in degrees of a turn that does not say its own.
const TURN_SIGMA_DEG: f64 = 5.0;

/// Farthest that a vehicle can have come, in metres: once around the Earth.
const FARTHEST_M: f64 = 4.0e7;

/// What a query says about its track, as it was sent.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrackOptions {
    /// The token of the previous answer; empty to begin.
    pub token: String,
    /// When the frame was taken, by the client's clock; absent: when it arrived.
    pub captured_at: Option<Timestamp>,
    /// Metres since the previous frame, by odometry.
    pub moved_m: Option<f64>,
    /// Standard deviation of `moved_m`.
    pub moved_sigma_m: Option<f64>,
    /// Degrees turned since the previous frame, clockwise positive.
    pub turned_deg: Option<f64>,
    /// Standard deviation of `turned_deg`.
    pub turned_sigma_deg: Option<f64>,
    /// Highest speed of the vehicle, in metres a second.
    pub max_speed_mps: Option<f64>,
}

/// Why a frame is refused before its photo is looked at.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// Its token does not continue a track.
    #[error(transparent)]
    Token(#[from] TokenError),
    /// An option is out of range.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
}

/// A frame whose options are good.
#[derive(Debug, Clone)]
pub(crate) struct Frame {
    /// The track so far; none for its first frame.
    pub(super) previous: Option<Track>,
    pub(super) motion: Motion,
    pub(super) captured_at: Timestamp,
    pub(super) by_client_clock: bool,
}

impl Frame {
    /// Reads the token and checks everything.
    ///
    /// # Errors
    /// The token is not good for this map of this model, a number is out of range, or the frame is
    /// from before the previous one.
    pub(crate) fn new(
        options: &TrackOptions,
        (map, model): (&MapName, &ModelId),
        config: &TrackConfig,
        key: &TrackKey,
        now: Timestamp,
    ) -> Result<Self, FrameError> {
        let previous = match options.token.as_str() {
            "" => None,
            token => {
                let track = Track::open(token, key)?;
                track.check(map, model, now, Duration::from_secs(config.lifetime_s))?;
                Some(track)
            }
        };
        let captured_at = options.captured_at.unwrap_or(now);
        let by_client_clock = options.captured_at.is_some();
        let elapsed = match &previous {
            Some(track) => elapsed(track, captured_at, by_client_clock)?,
            None => Duration::ZERO,
        };
        let motion = Motion::new(options.travel(elapsed, config)?, options.turn()?)?;
        Ok(Self {
            previous,
            motion,
            captured_at,
            by_client_clock,
        })
    }
}

impl Frame {
    /// Whether the vehicle was at no known place before, or the track begins.
    pub(crate) fn was_lost(&self) -> bool {
        self.previous
            .as_ref()
            .is_none_or(|track| track.elsewhere >= 0.5)
    }
}

/// Time between two frames of a track.
fn elapsed(
    previous: &Track,
    captured_at: Timestamp,
    by_client_clock: bool,
) -> Result<Duration, InvalidValue> {
    if previous.by_client_clock != by_client_clock {
        let reason = "send it with every frame of a track or with none: two clocks do not compare";
        return Err(InvalidValue::new("captured_at", reason));
    }
    let micros = captured_at
        .unix_micros()
        .saturating_sub(previous.captured_at.unix_micros());
    match u64::try_from(micros) {
        Ok(micros) => Ok(Duration::from_micros(micros)),
        // The previous frame may have been answered by a node whose clock is ahead.
        Err(_) if !by_client_clock => Ok(Duration::ZERO),
        Err(_) => {
            let reason = "it is before that of the track's previous frame";
            Err(InvalidValue::new("captured_at", reason))
        }
    }
}

impl TrackOptions {
    fn travel(&self, elapsed: Duration, config: &TrackConfig) -> Result<Travel, InvalidValue> {
        let speed = match self.max_speed_mps {
            Some(speed) => check_speed("max_speed_mps", speed)?,
            None => config.max_speed_mps,
        };
        match (self.moved_m, self.moved_sigma_m) {
            (Some(distance_m), sigma_m) => Ok(Travel::Measured {
                distance_m,
                sigma_m: sigma_m.unwrap_or(ODOMETRY_SHARE * distance_m + ODOMETRY_FLOOR_M),
            }),
            (None, Some(_)) => Err(InvalidValue::new("moved_sigma_m", "it needs moved_m")),
            (None, None) => Ok(Travel::Within {
                reach_m: (elapsed.as_secs_f64() * speed).min(FARTHEST_M),
            }),
        }
    }

    fn turn(&self) -> Result<Option<Turn>, InvalidValue> {
        match (self.turned_deg, self.turned_sigma_deg) {
            (Some(degrees), sigma_deg) => {
                Turn::new(degrees, sigma_deg.unwrap_or(TURN_SIGMA_DEG)).map(Some)
            }
            (None, Some(_)) => Err(InvalidValue::new("turned_sigma_deg", "it needs turned_deg")),
            (None, None) => Ok(None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: i64) -> Timestamp {
        Timestamp::from_unix_micros(seconds * 1_000_000).unwrap()
    }

    fn key() -> TrackKey {
        TrackKey::new(&[1; 32])
    }

    fn frame(options: &TrackOptions, now: i64) -> Result<Frame, String> {
        let map = "m".parse().unwrap();
        let model = ModelId::new("x");
        let config = TrackConfig::default();
        Frame::new(options, (&map, &model), &config, &key(), at(now))
            .map_err(|error| error.to_string())
    }

    fn token(by_client_clock: bool) -> String {
        let track = Track {
            map: "m".parse().unwrap(),
            model: ModelId::new("x"),
            issued_at: at(1000),
            captured_at: at(1000),
            by_client_clock,
            frames: 1,
            elsewhere: 1.0,
            places: Vec::new(),
        };
        track.seal(&key())
    }

    #[test]
    fn time_and_speed_bound_the_way_where_there_is_no_odometry() {
        let options = TrackOptions {
            token: token(false),
            max_speed_mps: Some(10.0),
            ..Default::default()
        };
        let near = frame(&options, 1003).unwrap().motion.reach_m();
        let far = frame(&options, 1010).unwrap().motion.reach_m();
        assert!((far - near - 70.0).abs() < 1e-9, "{near} {far}");
        // A node whose clock is behind.
        assert!(frame(&options, 900).unwrap().motion.reach_m() < 30.0);
    }

    #[test]
    fn two_clocks_are_not_mixed_and_time_does_not_run_backwards() {
        let by_client = |seconds| TrackOptions {
            token: token(true),
            captured_at: Some(at(seconds)),
            ..Default::default()
        };
        assert!(frame(&by_client(1000), 1000).is_ok());
        let backwards = frame(&by_client(999), 1000).unwrap_err();
        assert!(backwards.contains("before"), "{backwards}");
        let mixed = TrackOptions {
            captured_at: None,
            ..by_client(1000)
        };
        let refused = frame(&mixed, 1000).unwrap_err();
        assert!(refused.contains("two clocks"), "{refused}");
    }

    #[test]
    fn uncertainties_need_what_they_are_of() {
        for (options, named) in [
            (
                TrackOptions {
                    moved_sigma_m: Some(1.0),
                    ..Default::default()
                },
                "moved_sigma_m",
            ),
            (
                TrackOptions {
                    turned_sigma_deg: Some(1.0),
                    ..Default::default()
                },
                "turned_sigma_deg",
            ),
        ] {
            assert!(frame(&options, 0).unwrap_err().starts_with(named));
        }
    }
}

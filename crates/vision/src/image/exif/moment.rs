//! Which of several times to believe: the camera's clock or the receiver's.
//!
//! The receiver's time is UTC and right to the second, but only if it had a fix. Without one it
//! counts from an epoch: 1970, 1980, or the day on which its week number began again. That number
//! has ten bits, so an old receiver is wrong by multiples of 1024 weeks.

use placeformer_core::clock::{Clock, in_range};
use placeformer_core::types::Timestamp;
use time::macros::date;
use time::{Date, Duration, OffsetDateTime, PrimitiveDateTime};

/// No photo has a GPS position of before, so an earlier time is that of an unset clock.
const FIRST_YEAR: i32 = 1990;
/// Day 0 of week 0.
const GPS_EPOCH: Date = date!(1980 - 01 - 06);
/// Days after which the number of the week begins again.
const ROLLOVER_DAYS: i64 = 1024 * 7;
/// Longest that a right clock may differ from UTC, whose day begins up to 14 hours away.
const OFFSET_TOLERANCE: Duration = Duration::hours(26);

/// When a photo was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Moment {
    pub(super) at: Timestamp,
    /// What the camera's clock showed, if `at` is that, taken as UTC.
    pub(super) local: Option<PrimitiveDateTime>,
}

impl Moment {
    /// Chooses between the camera's clock and the receiver's.
    pub(super) fn of(clock: Option<Clock>, gps: Option<Timestamp>) -> Option<Self> {
        let sound_clock = clock.filter(|clock| clock.local.year() >= FIRST_YEAR);
        let gps = gps.filter(|gps| is_believable(gps.instant(), sound_clock));
        let exact = |at| Self { at, local: None };
        let of_sound_clock = sound_clock.and_then(Clock::instant).map(exact);
        let of_gps = gps.map(exact);
        of_sound_clock.or(of_gps).or_else(|| Self::of_clock(clock?))
    }

    fn of_clock(clock: Clock) -> Option<Self> {
        if clock.offset.is_some() {
            let at = clock.instant()?;
            return Some(Self { at, local: None });
        }
        Some(Self {
            at: in_range(clock.local.assume_utc())?,
            local: Some(clock.local),
        })
    }
}

/// Whether a receiver's time can be right, beside that of a camera's clock that is set.
fn is_believable(gps: OffsetDateTime, clock: Option<Clock>) -> bool {
    if gps.year() < FIRST_YEAR {
        return false;
    }
    let Some(clock) = clock else {
        return true;
    };
    let difference = (clock.local.assume_utc() - gps).abs();
    if difference <= OFFSET_TOLERANCE {
        return true;
    }
    let rollover = Duration::days(ROLLOVER_DAYS);
    let beyond = Duration::seconds(difference.whole_seconds() % rollover.whole_seconds());
    let is_rolled_over = beyond.min(rollover - beyond) <= OFFSET_TOLERANCE;
    let days_since_epoch = (gps.date() - GPS_EPOCH).whole_days();
    let counts_from_epoch = days_since_epoch % ROLLOVER_DAYS == 0;
    !is_rolled_over && !counts_from_epoch
}

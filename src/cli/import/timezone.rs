//! The time zone of clocks that do not say which one they show.

use jiff::civil;
use jiff::tz::TimeZone;
use placeformer_core::clock::{Clock, parse_utc_offset};
use placeformer_core::types::Timestamp;
use std::str::FromStr;
use time::{PrimitiveDateTime, UtcOffset};

/// A zone from the command line: `Europe/Paris` or `+02:00`.
#[derive(Debug, Clone)]
pub enum ClockZone {
    /// The same offset all year.
    Fixed(UtcOffset),
    /// A region of the world, with its summer times.
    Region(TimeZone),
}

/// The text names no zone.
#[derive(Debug, thiserror::Error)]
#[error("it is neither an offset such as +02:00 nor a time zone such as Europe/Paris")]
pub struct UnknownZone;

impl FromStr for ClockZone {
    type Err = UnknownZone;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if let Some(offset) = parse_utc_offset(text) {
            return Ok(Self::Fixed(offset));
        }
        let region = TimeZone::get(text).map_err(|_| UnknownZone)?;
        Ok(Self::Region(region))
    }
}

impl ClockZone {
    /// The moment at which a clock in this zone showed `local`. Of the two moments when clocks are
    /// set back, it is the first; a time that is left out when they are set forward counts with the
    /// offset from before.
    pub(super) fn instant(&self, local: PrimitiveDateTime) -> Option<Timestamp> {
        let offset = match self {
            Self::Fixed(offset) => *offset,
            Self::Region(zone) => region_offset(zone, local)?,
        };
        let clock = Clock {
            local,
            offset: Some(offset),
        };
        clock.instant()
    }
}

fn region_offset(zone: &TimeZone, local: PrimitiveDateTime) -> Option<UtcOffset> {
    let shown = civil::DateTime::new(
        i16::try_from(local.year()).ok()?,
        u8::from(local.month()).cast_signed(),
        local.day().cast_signed(),
        local.hour().cast_signed(),
        local.minute().cast_signed(),
        local.second().cast_signed(),
        0,
    );
    let ambiguous = zone.to_ambiguous_timestamp(shown.ok()?);
    let seconds = match ambiguous.offset() {
        jiff::tz::AmbiguousOffset::Unambiguous { offset } => offset,
        jiff::tz::AmbiguousOffset::Gap { before, .. } => before,
        jiff::tz::AmbiguousOffset::Fold { before, .. } => before,
    };
    UtcOffset::from_whole_seconds(seconds.seconds()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use time::OffsetDateTime;
    use time::macros::datetime;

    fn instant(zone: &str, local: PrimitiveDateTime) -> OffsetDateTime {
        let zone: ClockZone = zone.parse().unwrap();
        zone.instant(local).unwrap().instant()
    }

    #[test]
    fn regions_have_summers_and_offsets_have_none() {
        let winter = datetime!(2026-01-01 12:00);
        let summer = datetime!(2026-07-01 12:00:00.5);
        assert_eq!(
            instant("Europe/Paris", winter),
            datetime!(2026-01-01 11:00 UTC)
        );
        assert_eq!(
            instant("Europe/Paris", summer),
            datetime!(2026-07-01 10:00:00.5 UTC)
        );
        assert_eq!(instant("+02:00", winter), datetime!(2026-01-01 10:00 UTC));
        assert_eq!(instant("Z", winter), datetime!(2026-01-01 12:00 UTC));
        assert_eq!(
            instant("America/New_York", winter),
            datetime!(2026-01-01 17:00 UTC)
        );
    }

    #[test]
    fn hours_that_come_twice_or_never_have_one_meaning() {
        let twice = datetime!(2026-10-25 02:30);
        assert_eq!(
            instant("Europe/Paris", twice),
            datetime!(2026-10-25 00:30 UTC)
        );
        let never = datetime!(2026-03-29 02:30);
        assert_eq!(
            instant("Europe/Paris", never),
            datetime!(2026-03-29 01:30 UTC)
        );
    }

    #[test]
    fn what_is_no_zone_is_refused_and_no_year_runs_over() {
        for wrong in ["", "Europe/Nowhere", "+25:00", "2", "../../etc/passwd"] {
            assert!(wrong.parse::<ClockZone>().is_err(), "{wrong}");
        }
        let zone: ClockZone = "-12:00".parse().unwrap();
        assert_eq!(zone.instant(datetime!(9999-12-31 23:00)), None);
    }
}

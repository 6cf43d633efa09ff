//! Instants as everything here keeps and shows them.

use crate::invalid::InvalidName;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::str::FromStr;
use time::format_description::well_known::Rfc3339;
use time::macros::datetime;
use time::{Duration, OffsetDateTime, UtcOffset};

/// An instant in UTC, to the microsecond, that RFC 3339 can write: of the years 0000 to 9999.
///
/// A time with an offset may be within these years and its instant in UTC outside of them, as
/// `0000-01-01T00:00:00+01:00` is. So the range is that of the instant, and whatever is a
/// `Timestamp` can be stored and shown. Finer parts than microseconds are cut, towards the past.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Timestamp(OffsetDateTime);

impl Timestamp {
    /// The first instant.
    pub const EARLIEST: Self = Self(datetime!(0000-01-01 00:00 UTC));
    /// The last instant.
    pub const LATEST: Self = Self(datetime!(9999-12-31 23:59:59.999999 UTC));
    const RULE: &'static str = "write it as RFC 3339 does, such as 2026-05-17T09:30:00Z, within the years 0000 to 9999 \
         of UTC";

    /// The present, by the system's clock.
    pub fn now() -> Self {
        // The clock of a machine shows no year outside the range.
        Self::of(OffsetDateTime::now_utc()).unwrap_or(Self::EARLIEST)
    }

    /// The instant of a time with any offset; `None` if it is outside the range.
    pub fn of(time: OffsetDateTime) -> Option<Self> {
        let utc = time.checked_to_offset(UtcOffset::UTC)?;
        let whole_micros = utc.nanosecond() / 1000 * 1000;
        let cut = Self(utc.replace_nanosecond(whole_micros).ok()?);
        (Self::EARLIEST..=Self::LATEST)
            .contains(&cut)
            .then_some(cut)
    }

    /// Microseconds since 1970; negative before.
    pub fn unix_micros(self) -> i64 {
        // Lossless: ten thousand years are 3.2e17 microseconds.
        self.0.unix_timestamp_nanos().div_euclid(1000) as i64
    }

    /// The inverse of [`Timestamp::unix_micros`]; `None` outside the range.
    pub fn from_unix_micros(micros: i64) -> Option<Self> {
        OffsetDateTime::from_unix_timestamp_nanos(i128::from(micros) * 1000)
            .ok()
            .and_then(Self::of)
    }

    /// As [`Timestamp::from_unix_micros`], for what was stored. A release that checked the year
    /// before the offset stored instants up to a day outside the range. They are read as the first
    /// or the last instant of it, so that no reference is lost for a time that cannot be written.
    pub fn from_stored_micros(micros: i64) -> Option<Self> {
        let day = Duration::DAY.whole_microseconds() as i64;
        let first = Self::EARLIEST.unix_micros();
        let last = Self::LATEST.unix_micros();
        if !(first - day..=last + day).contains(&micros) {
            return None;
        }
        Self::from_unix_micros(micros.clamp(first, last))
    }

    /// The instant as the library of times knows it, in UTC.
    pub fn instant(self) -> OffsetDateTime {
        self.0
    }
}

impl FromStr for Timestamp {
    type Err = InvalidName;

    /// Parses a time of RFC 3339.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let parsed = OffsetDateTime::parse(text, &Rfc3339).ok();
        parsed
            .and_then(Self::of)
            .ok_or_else(|| InvalidName::new("time", text, Self::RULE))
    }
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // It cannot fail: the year has four digits, and the offset is whole minutes.
        f.write_str(&self.0.format(&Rfc3339).map_err(|_| fmt::Error)?)
    }
}

impl Serialize for Timestamp {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Timestamp {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_range_is_that_of_the_instant_in_utc() {
        for (text, expected) in [
            ("2026-05-17T09:30:00Z", Some("2026-05-17T09:30:00Z")),
            (
                "2026-05-17T09:30:00.1234567+02:00",
                Some("2026-05-17T07:30:00.123456Z"),
            ),
            ("0000-01-01T00:00:00Z", Some("0000-01-01T00:00:00Z")),
            ("0000-01-01T00:00:00-23:59", Some("0000-01-01T23:59:00Z")),
            ("0000-01-01T00:00:00+00:01", None),
            ("0000-01-01T00:00:00+23:59", None),
            (
                "9999-12-31T23:59:59.9999999Z",
                Some("9999-12-31T23:59:59.999999Z"),
            ),
            ("9999-12-31T23:59:59-00:01", None),
            ("9999-12-31T23:59:59-23:59", None),
            ("9999-12-31T23:59:59+23:59", Some("9999-12-31T00:00:59Z")),
            ("2016-12-31T23:59:60Z", Some("2016-12-31T23:59:59.999999Z")),
            ("-0001-01-01T00:00:00Z", None),
            ("10000-01-01T00:00:00Z", None),
            ("2026-02-30T00:00:00Z", None),
            ("2026-05-17T09:30:00+24:00", None),
            ("2026-05-17", None),
            ("yesterday", None),
            ("", None),
        ] {
            let parsed: Option<Timestamp> = text.parse().ok();
            let shown = parsed.map(|time| time.to_string());
            assert_eq!(shown.as_deref(), expected, "{text}");
        }
    }

    #[test]
    fn what_an_earlier_release_stored_beyond_the_range_is_read_as_its_end() {
        let hour = Duration::HOUR.whole_microseconds() as i64;
        let first = Timestamp::EARLIEST.unix_micros();
        let last = Timestamp::LATEST.unix_micros();
        assert_eq!(Timestamp::from_unix_micros(first - 1), None);
        for (micros, expected) in [
            (first, Some(Timestamp::EARLIEST)),
            (first - 23 * hour, Some(Timestamp::EARLIEST)),
            (first - 25 * hour, None),
            (last + 23 * hour, Some(Timestamp::LATEST)),
            (last + 25 * hour, None),
            (i64::MIN, None),
            (i64::MAX, None),
        ] {
            assert_eq!(Timestamp::from_stored_micros(micros), expected, "{micros}");
        }
    }

    proptest! {
        #[test]
        fn every_timestamp_survives_text_json_and_microseconds(
            micros in Timestamp::EARLIEST.unix_micros()..=Timestamp::LATEST.unix_micros(),
        ) {
            let time = Timestamp::from_unix_micros(micros).unwrap();
            prop_assert_eq!(time.unix_micros(), micros);
            prop_assert_eq!(Timestamp::from_stored_micros(micros), Some(time));
            prop_assert_eq!(time.to_string().parse::<Timestamp>().unwrap(), time);
            let json = serde_json::to_string(&time).unwrap();
            prop_assert_eq!(serde_json::from_str::<Timestamp>(&json).unwrap(), time);
        }

        /// Whatever the offset, a time is refused or can be shown.
        #[test]
        fn no_offset_makes_a_time_that_cannot_be_shown(
            year in prop_oneof![-1i32..2, 9998i32..10_000, 1900i32..2100],
            day in 1u16..366,
            seconds in 0u32..86_400,
            offset in -86_399i32..=86_399,
        ) {
            let Ok(date) = time::Date::from_ordinal_date(year, day) else {
                return Ok(());
            };
            let clock = time::Time::MIDNIGHT + Duration::seconds(i64::from(seconds));
            let offset = UtcOffset::from_whole_seconds(offset).unwrap();
            let time = time::PrimitiveDateTime::new(date, clock).assume_offset(offset);
            if let Some(time) = Timestamp::of(time) {
                prop_assert_eq!(time.to_string().parse::<Timestamp>().unwrap(), time);
            }
        }
    }
}

//! Times as people, cameras and tables write them.
//!
//! A camera shows the time on the wall, and only some cameras also note how far that is from UTC.
//! So what is read is a [`Clock`]: the time shown, and the offset if there is one.

use crate::types::Timestamp;
use time::{Date, Month, OffsetDateTime, PrimitiveDateTime, Time, UtcOffset};

/// No place on Earth is further from UTC: the extremes in use are -12 and +14 hours.
const MAX_OFFSET_HOURS: u8 = 14;

/// The time that a clock showed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Clock {
    /// What it showed.
    pub local: PrimitiveDateTime,
    /// How far ahead of UTC it was, where that is known.
    pub offset: Option<UtcOffset>,
}

impl Clock {
    /// Reads a date and a time of day, with a space or a `T` between them, and what may follow: a
    /// fraction of the second, and `Z` or an offset. EXIF's `2026:03:01 14:30:05` is read as well
    /// as RFC 3339. `None` if it is something else.
    pub fn parse(text: &str) -> Option<Self> {
        let mut scanner = Scanner(text.trim());
        let date = scanner.date()?;
        if !scanner.skips(['T', 't', ' ']) {
            return None;
        }
        scanner.skip_spaces();
        let time = scanner.time()?;
        scanner.skip_spaces();
        let offset = match scanner.0 {
            "" => None,
            rest => Some(parse_utc_offset(rest)?),
        };
        Some(Self {
            local: PrimitiveDateTime::new(date, time),
            offset,
        })
    }

    /// The moment, where the offset is known and the year is in range.
    pub fn instant(self) -> Option<Timestamp> {
        in_range(self.local.assume_offset(self.offset?))
    }
}

/// The instant of a time whose year is one of 1 to 9999, both as it stands and in UTC. The year 0,
/// which a [`Timestamp`] may have, is what unset clocks show.
pub fn in_range(time: OffsetDateTime) -> Option<Timestamp> {
    let is_sound = |time: OffsetDateTime| (1..=9999).contains(&time.year());
    Timestamp::of(time).filter(|utc| is_sound(time) && is_sound(utc.instant()))
}

/// Reads `YYYY:MM:DD`, with colons, dashes, slashes or dots, and nothing after it.
pub fn parse_date(text: &str) -> Option<Date> {
    let mut scanner = Scanner(text.trim());
    scanner.date().filter(|_| scanner.0.is_empty())
}

/// Reads `+HH:MM`, `+HHMM`, `+HH`, the same with a minus, or `Z`.
pub fn parse_utc_offset(text: &str) -> Option<UtcOffset> {
    let mut scanner = Scanner(text.trim());
    if scanner.0.eq_ignore_ascii_case("Z") {
        return Some(UtcOffset::UTC);
    }
    let sign = match (scanner.skips(['+']), scanner.skips(['-', '\u{2212}'])) {
        (true, false) => 1,
        (false, true) => -1,
        _ => return None,
    };
    let hours = scanner.number(1, 2)?;
    let has_colon = scanner.skips([':']);
    let minutes = match scanner.0 {
        "" if !has_colon => 0,
        _ => scanner.number(2, 2)?,
    };
    let is_sound = scanner.0.is_empty() && hours <= u32::from(MAX_OFFSET_HOURS) && minutes < 60;
    let seconds = i32::try_from(hours * 3600 + minutes * 60).ok()?;
    let offset = UtcOffset::from_whole_seconds(sign * seconds).ok()?;
    is_sound.then_some(offset)
}

/// Nanoseconds of the decimals of a second, such as `847` for 0.847 s. Digits beyond the ninth are
/// dropped.
pub fn parse_fraction(digits: &str) -> Option<u32> {
    let digits = digits.trim();
    let is_number = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    if !is_number {
        return None;
    }
    let padded = digits.bytes().chain(std::iter::repeat(b'0')).take(9);
    Some(padded.fold(0, |sum, digit| sum * 10 + u32::from(digit - b'0')))
}

/// What is left of a text.
struct Scanner<'a>(&'a str);

impl<'a> Scanner<'a> {
    /// Steps over one of `characters`, if it comes next.
    fn skips<const N: usize>(&mut self, characters: [char; N]) -> bool {
        let rest = self.0.strip_prefix(characters);
        self.0 = rest.unwrap_or(self.0);
        rest.is_some()
    }

    fn skip_spaces(&mut self) {
        self.0 = self.0.trim_start();
    }

    /// The digits that come next, at most `most`.
    fn digits(&mut self, most: usize) -> &'a str {
        let digits = self.0.bytes().take_while(u8::is_ascii_digit).take(most);
        let (digits, rest) = self.0.split_at(digits.count());
        self.0 = rest;
        digits
    }

    /// A number of `fewest` to `most` digits.
    fn number(&mut self, fewest: usize, most: usize) -> Option<u32> {
        let digits = self.digits(most);
        (digits.len() >= fewest).then(|| digits.parse().ok())?
    }

    fn date(&mut self) -> Option<Date> {
        let separators = [':', '-', '/', '.'];
        let year = self.number(4, 4)?;
        if !self.skips(separators) {
            return None;
        }
        let month = u8::try_from(self.number(1, 2)?).ok()?;
        if !self.skips(separators) {
            return None;
        }
        let day = u8::try_from(self.number(1, 2)?).ok()?;
        let year = i32::try_from(year).ok().filter(|year| *year >= 1)?;
        Date::from_calendar_date(year, Month::try_from(month).ok()?, day).ok()
    }

    /// Hours, minutes, and seconds with their fraction; the seconds may be absent.
    fn time(&mut self) -> Option<Time> {
        let hour = u8::try_from(self.number(1, 2)?).ok()?;
        if !self.skips([':']) {
            return None;
        }
        let minute = u8::try_from(self.number(1, 2)?).ok()?;
        if !self.skips([':']) {
            return Time::from_hms(hour, minute, 0).ok();
        }
        let second = u8::try_from(self.number(1, 2)?).ok()?;
        let nanosecond = match self.skips(['.', ',']) {
            true => parse_fraction(self.digits(usize::MAX))?,
            false => 0,
        };
        Time::from_hms_nano(hour, minute, second, nanosecond).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use time::macros::{date, datetime, offset};

    fn clock(text: &str) -> Option<(PrimitiveDateTime, Option<UtcOffset>)> {
        Clock::parse(text).map(|clock| (clock.local, clock.offset))
    }

    #[test]
    fn cameras_and_tables_are_read() {
        let noon = datetime!(2026-03-01 14:30:05);
        let with_fraction = datetime!(2026-03-01 14:30:05.847);
        for (text, local, offset) in [
            ("2026:03:01 14:30:05", noon, None),
            ("  2026-03-01T14:30:05 ", noon, None),
            ("2026/3/1 14:30:05", noon, None),
            ("2026:03:01 14:30:05.847", with_fraction, None),
            ("2026:03:01 14:30:05,847", with_fraction, None),
            ("2026:03:01 14:30:05Z", noon, Some(offset!(UTC))),
            ("2026:03:01 14:30:05+02:00", noon, Some(offset!(+2))),
            ("2026:03:01 14:30:05 -0330", noon, Some(offset!(-3:30))),
            (
                "2026-03-01t14:30:05.847z",
                with_fraction,
                Some(offset!(UTC)),
            ),
            ("2026-03-01T14:30:05+05", noon, Some(offset!(+5))),
            ("2026-03-01T14:30", datetime!(2026-03-01 14:30), None),
        ] {
            assert_eq!(clock(text), Some((local, offset)), "{text}");
        }
    }

    #[test]
    fn what_is_no_time_is_none() {
        for text in [
            "",
            "0000:00:00 00:00:00",
            "    :  :     :  :  ",
            "2026:03:01",
            "2026:13:01 00:00:00",
            "2026:02:30 00:00:00",
            "2026:03:01 24:00:00",
            "2026:03:01 14:30:05.",
            "2026:03:01 14:30:05+25:00",
            "2026:03:01 14:30:05+02:75",
            "2026:03:01 14:30:05 tomorrow",
            "+026:03:01 14:30:05",
            "yesterday",
        ] {
            assert_eq!(clock(text), None, "{text}");
        }
        assert_eq!(parse_date("2026:03:01"), Some(date!(2026 - 03 - 01)));
        assert_eq!(parse_date("2026:03:01 1"), None);
        assert_eq!(parse_utc_offset("+02:"), None);
        assert_eq!(parse_utc_offset("   :  "), None);
        assert_eq!(parse_fraction("8471234567"), Some(847_123_456));
        assert_eq!(parse_fraction("+8"), None);
    }

    #[test]
    fn an_offset_never_leads_out_of_the_years_that_text_can_hold() {
        let instant = |text: &str| Clock::parse(text).and_then(Clock::instant);
        assert!(instant("9999:12:31 23:00:00-02:00").is_none());
        assert!(instant("0001:01:01 01:00:00+02:00").is_none());
        assert!(instant("9999:12:31 23:00:00+02:00").is_some());
        assert!(instant("0001:01:01 01:00:00-02:00").is_some());
    }

    proptest! {
        #[test]
        fn any_text_is_read_or_refused(text in "\\PC{0,40}", digits in "[0-9:. TZ+-]{0,40}") {
            let _ = (Clock::parse(&text), Clock::parse(&digits));
            let _ = (parse_date(&digits), parse_utc_offset(&digits), parse_fraction(&digits));
        }
    }
}

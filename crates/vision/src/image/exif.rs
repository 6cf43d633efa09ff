//! The EXIF data of a photo: which side is up, and where, in which direction and when it was taken.
//!
//! EXIF data is often missing and often broken, so nothing here fails: a tag that is malformed or
//! out of range counts as missing.

use ::exif::{Exif, In, Rational, Reader, Tag, Value};
use ::image::metadata::Orientation;
use placeformer_core::types::{GeoPoint, Heading, Timestamp};
use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use time::{Date, Month, PrimitiveDateTime, Time, UtcOffset};

/// Where, in which direction and when a photo was taken, as far as its EXIF data says so.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExifInfo {
    /// GPS position, unless the receiver marked it as invalid.
    pub location: Option<GeoPoint>,
    /// Direction in which the camera looked, in degrees. A bearing from magnetic north is not
    /// corrected.
    pub heading: Option<Heading>,
    /// DateTimeOriginal with its UTC offset. Without an offset it is the GPS time, which is in UTC;
    /// without that too, DateTimeOriginal is taken as UTC.
    pub captured_at: Option<Timestamp>,
}

/// Reads position, direction and time from a JPEG, PNG or WebP.
pub fn read_exif(bytes: &[u8]) -> ExifInfo {
    let Some(exif) = parse(bytes) else {
        return ExifInfo::default();
    };
    ExifInfo {
        location: location(&exif),
        heading: heading(&exif),
        captured_at: captured_at(&exif),
    }
}

/// How the stored pixels must be turned.
pub(super) fn orientation(bytes: &[u8]) -> Orientation {
    stated_orientation(bytes).unwrap_or(Orientation::NoTransforms)
}

fn stated_orientation(bytes: &[u8]) -> Option<Orientation> {
    let exif = parse(bytes)?;
    let field = exif.get_field(Tag::Orientation, In::PRIMARY)?;
    let value = u8::try_from(field.value.get_uint(0)?).ok()?;
    Orientation::from_exif(value)
}

/// The EXIF data; of a damaged block the tags that can be read.
fn parse(bytes: &[u8]) -> Option<Exif> {
    let read = || {
        let mut reader = Reader::new();
        reader.continue_on_error(true);
        reader
            .read_from_container(&mut Cursor::new(bytes))
            .or_else(|error| error.distill_partial_result(|_| {}))
            .ok()
    };
    // If the parser panics, the photo itself may still be good.
    catch_unwind(AssertUnwindSafe(read)).ok().flatten()
}

fn location(exif: &Exif) -> Option<GeoPoint> {
    // V means void, A active.
    if ascii(exif, Tag::GPSStatus).is_some_and(|status| status.starts_with('V')) {
        return None;
    }
    let lat = angle(exif, Tag::GPSLatitude, Tag::GPSLatitudeRef, 'S')?;
    let lon = angle(exif, Tag::GPSLongitude, Tag::GPSLongitudeRef, 'W')?;
    GeoPoint::new(lat, lon).ok()
}

/// Degrees, minutes and seconds as signed degrees; `negative` is the letter of the negative
/// hemisphere.
fn angle(exif: &Exif, value: Tag, reference: Tag, negative: char) -> Option<f64> {
    let parts = rationals(exif, value)?;
    let part = |i: usize| match parts.get(i) {
        Some(part) => finite(part),
        None => Some(0.0),
    };
    let magnitude = part(0)? + part(1)? / 60.0 + part(2)? / 3600.0;
    let sign = if ascii(exif, reference)?.starts_with(negative) {
        -1.0
    } else {
        1.0
    };
    Some(sign * magnitude)
}

fn heading(exif: &Exif) -> Option<Heading> {
    let values = rationals(exif, Tag::GPSImgDirection)?;
    let degrees = finite(values.first()?)?;
    Heading::new(degrees).ok()
}

fn captured_at(exif: &Exif) -> Option<Timestamp> {
    let local = ascii(exif, Tag::DateTimeOriginal).and_then(|text| local_time(&text));
    let offset = ascii(exif, Tag::OffsetTimeOriginal).and_then(|text| utc_offset(&text));
    match (local, offset) {
        (Some(local), Some(offset)) => Timestamp::of(local.assume_offset(offset)),
        (local, _) => {
            let utc = gps_time(exif).or(local)?;
            Timestamp::of(utc.assume_utc())
        }
    }
}

/// `YYYY:MM:DD HH:MM:SS`.
fn local_time(text: &str) -> Option<PrimitiveDateTime> {
    let (day, clock) = text.trim().split_once(' ')?;
    let [hour, minute, second] = numbers(clock)?.map(|number| u8::try_from(number).ok());
    let time = Time::from_hms(hour?, minute?, second?).ok()?;
    Some(PrimitiveDateTime::new(date(day)?, time))
}

/// `YYYY:MM:DD`.
fn date(text: &str) -> Option<Date> {
    let [year, month, day] = numbers(text)?;
    let month = Month::try_from(u8::try_from(month).ok()?).ok()?;
    let day = u8::try_from(day).ok()?;
    Date::from_calendar_date(i32::from(year), month, day).ok()
}

/// Three numbers, separated by colons or, as some cameras write them, by dashes.
fn numbers(text: &str) -> Option<[u16; 3]> {
    let mut parts = text.trim().split([':', '-']);
    let mut next_number = || parts.next()?.parse().ok();
    Some([next_number()?, next_number()?, next_number()?])
}

/// `+HH:MM`, `-HH:MM` or `Z`.
fn utc_offset(text: &str) -> Option<UtcOffset> {
    let text = text.trim();
    if text == "Z" {
        return Some(UtcOffset::UTC);
    }
    let (sign, clock) = match text.split_at_checked(1)? {
        ("+", clock) => (1, clock),
        ("-", clock) => (-1, clock),
        _ => return None,
    };
    let (hours, minutes) = clock.split_once(':')?;
    let hours: i8 = hours.parse().ok()?;
    let minutes: i8 = minutes.parse().ok()?;
    UtcOffset::from_hms(sign * hours, sign * minutes, 0).ok()
}

/// The time of the receiver, which is in UTC.
fn gps_time(exif: &Exif) -> Option<PrimitiveDateTime> {
    let day = date(&ascii(exif, Tag::GPSDateStamp)?)?;
    let clock = rationals(exif, Tag::GPSTimeStamp)?;
    let part = |i: usize| {
        let value = finite(clock.get(i)?)?;
        (0.0..60.0).contains(&value).then_some(value as u8)
    };
    let time = Time::from_hms(part(0)?, part(1)?, part(2)?).ok()?;
    Some(PrimitiveDateTime::new(day, time))
}

/// The values of a tag of rational numbers, of which there is at least one.
fn rationals(exif: &Exif, tag: Tag) -> Option<&[Rational]> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(values) if !values.is_empty() => Some(values),
        _ => None,
    }
}

fn finite(value: &Rational) -> Option<f64> {
    Some(value.to_f64()).filter(|value| value.is_finite())
}

/// The first line of a text tag.
fn ascii(exif: &Exif, tag: Tag) -> Option<String> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(lines) => Some(String::from_utf8_lossy(lines.first()?).into_owned()),
        _ => None,
    }
}

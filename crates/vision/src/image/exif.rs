//! What a camera wrote beside the pixels: which way is up, and where, whither and when the photo
//! was taken.
//!
//! EXIF is often missing and often broken, so nothing here fails: a tag that is absent, malformed
//! or out of range is simply not there.

use ::exif::{Exif, In, Rational, Reader, Tag, Value};
use ::image::metadata::Orientation;
use placeformer_core::types::{GeoPoint, Heading};
use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use time::{Date, Month, OffsetDateTime, PrimitiveDateTime, Time, UtcOffset};

/// Where, whither and when a photo was taken, as far as its EXIF says so.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExifInfo {
    /// GPS position; none where the receiver marked it void.
    pub location: Option<GeoPoint>,
    /// Direction the camera faced. A bearing from magnetic north is passed on uncorrected.
    pub heading: Option<Heading>,
    /// DateTimeOriginal with its UTC offset; without an offset, the GPS clock (which is UTC);
    /// without that, DateTimeOriginal taken as UTC.
    pub captured_at: Option<OffsetDateTime>,
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
    parse(bytes)
        .and_then(|exif| {
            exif.get_field(Tag::Orientation, In::PRIMARY)?
                .value
                .get_uint(0)
        })
        .and_then(|value| Orientation::from_exif(u8::try_from(value).ok()?))
        .unwrap_or(Orientation::NoTransforms)
}

/// The EXIF block, keeping the tags before and after a broken one.
fn parse(bytes: &[u8]) -> Option<Exif> {
    let read = || {
        let mut reader = Reader::new();
        reader.continue_on_error(true);
        reader
            .read_from_container(&mut Cursor::new(bytes))
            .or_else(|error| error.distill_partial_result(|_| {}))
            .ok()
    };
    // A photo whose EXIF defeats the parser is still a photo.
    catch_unwind(AssertUnwindSafe(read)).ok().flatten()
}

fn location(exif: &Exif) -> Option<GeoPoint> {
    if ascii(exif, Tag::GPSStatus).is_some_and(|status| status.starts_with('V')) {
        return None;
    }
    let lat = angle(exif, Tag::GPSLatitude, Tag::GPSLatitudeRef, 'S')?;
    let lon = angle(exif, Tag::GPSLongitude, Tag::GPSLongitudeRef, 'W')?;
    GeoPoint::new(lat, lon).ok()
}

/// Degrees, minutes and seconds as signed degrees.
fn angle(exif: &Exif, value: Tag, reference: Tag, negative: char) -> Option<f64> {
    let parts = rationals(exif, value)?;
    let [degrees, minutes, seconds] =
        std::array::from_fn(|i| parts.get(i).map_or(Some(0.0), finite));
    let magnitude = degrees? + minutes? / 60.0 + seconds? / 3600.0;
    let sign = if ascii(exif, reference)?.starts_with(negative) {
        -1.0
    } else {
        1.0
    };
    Some(sign * magnitude)
}

fn heading(exif: &Exif) -> Option<Heading> {
    Heading::new(finite(rationals(exif, Tag::GPSImgDirection)?.first()?)?).ok()
}

fn captured_at(exif: &Exif) -> Option<OffsetDateTime> {
    let local = ascii(exif, Tag::DateTimeOriginal).and_then(|text| local_time(&text));
    let offset = ascii(exif, Tag::OffsetTimeOriginal).and_then(|text| utc_offset(&text));
    match (local, offset) {
        (Some(local), Some(offset)) => Some(local.assume_offset(offset)),
        (local, _) => gps_time(exif).or(local.map(PrimitiveDateTime::assume_utc)),
    }
}

/// `YYYY:MM:DD HH:MM:SS`.
fn local_time(text: &str) -> Option<PrimitiveDateTime> {
    let (day, clock) = text.trim().split_once(' ')?;
    let [hour, minute, second] = numbers(clock)?.map(|number| u8::try_from(number).ok());
    Some(PrimitiveDateTime::new(
        date(day)?,
        Time::from_hms(hour?, minute?, second?).ok()?,
    ))
}

/// `YYYY:MM:DD`.
fn date(text: &str) -> Option<Date> {
    let [year, month, day] = numbers(text)?;
    let month = Month::try_from(u8::try_from(month).ok()?).ok()?;
    Date::from_calendar_date(i32::from(year), month, u8::try_from(day).ok()?).ok()
}

/// Three numbers parted by colons (some cameras write dashes).
fn numbers(text: &str) -> Option<[u16; 3]> {
    let mut parts = text.trim().split([':', '-']).map(|part| part.parse().ok());
    Some([parts.next()??, parts.next()??, parts.next()??])
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
    UtcOffset::from_hms(
        sign * hours.parse::<i8>().ok()?,
        sign * minutes.parse::<i8>().ok()?,
        0,
    )
    .ok()
}

fn gps_time(exif: &Exif) -> Option<OffsetDateTime> {
    let day = date(&ascii(exif, Tag::GPSDateStamp)?)?;
    let clock = rationals(exif, Tag::GPSTimeStamp)?;
    let part = |i: usize| finite(clock.get(i)?).filter(|value| (0.0..60.0).contains(value));
    let time = Time::from_hms(part(0)? as u8, part(1)? as u8, part(2)? as u8).ok()?;
    Some(PrimitiveDateTime::new(day, time).assume_utc())
}

fn rationals(exif: &Exif, tag: Tag) -> Option<&[Rational]> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(values) if !values.is_empty() => Some(values),
        _ => None,
    }
}

fn finite(value: &Rational) -> Option<f64> {
    Some(value.to_f64()).filter(|value| value.is_finite())
}

fn ascii(exif: &Exif, tag: Tag) -> Option<String> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(lines) => Some(String::from_utf8_lossy(lines.first()?).into_owned()),
        _ => None,
    }
}

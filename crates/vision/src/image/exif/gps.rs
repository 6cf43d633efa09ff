//! What the GPS directory says: position, heading and time.
//!
//! Signs are the reference's, as `exiftool` reads them: with `S` or `W` a position is negative,
//! with `N` or `E` it is not, whatever its own sign. Some writers give no reference and signed
//! numbers instead. So where a reference is missing, empty or unknown, the numbers' own signs count
//! if one of the two is negative; otherwise the hemisphere is unknown, and so is the position.

use super::tiff::{Directory, Field};
use placeformer_core::clock::{in_range, parse_date};
use placeformer_core::types::{Altitude, GeoPoint, Heading, Timestamp};
use time::{Duration, PrimitiveDateTime, Time};

const LATITUDE_REF: u16 = 1;
const LATITUDE: u16 = 2;
const LONGITUDE_REF: u16 = 3;
const LONGITUDE: u16 = 4;
const ALTITUDE_REF: u16 = 5;
const ALTITUDE: u16 = 6;
const TIME_STAMP: u16 = 7;
const SATELLITES: u16 = 8;
const STATUS: u16 = 9;
const MEASURE_MODE: u16 = 10;
const PRECISION: u16 = 11;
const IMAGE_DIRECTION: u16 = 17;
const DATE_STAMP: u16 = 29;

/// The tags that are used.
pub(super) const TAGS: [u16; 13] = [
    LATITUDE_REF,
    LATITUDE,
    LONGITUDE_REF,
    LONGITUDE,
    ALTITUDE_REF,
    ALTITUDE,
    TIME_STAMP,
    SATELLITES,
    STATUS,
    MEASURE_MODE,
    PRECISION,
    IMAGE_DIRECTION,
    DATE_STAMP,
];

/// What the receiver and the compass noted.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Gps {
    /// The receiver says that it had no fix, so that its position and time are not to be used.
    pub(super) is_void: bool,
    pub(super) location: Option<GeoPoint>,
    pub(super) alt: Option<Altitude>,
    pub(super) heading: Option<Heading>,
    /// In UTC.
    pub(super) time: Option<Timestamp>,
}

impl Gps {
    pub(super) fn read(gps: &Directory<'_>) -> Self {
        let status = first_letter(gps, STATUS);
        let heading = gps.field(IMAGE_DIRECTION).and_then(|field| field.number(0));
        let heading = heading.and_then(|degrees| Heading::new(degrees).ok());
        // V means void, A active.
        if status == Some('V') {
            return Self {
                is_void: true,
                heading,
                ..Self::default()
            };
        }
        Self {
            is_void: false,
            location: location(gps),
            alt: altitude(gps),
            heading,
            time: gps_time(gps),
        }
    }

    /// Each fact of this directory, or that of `other` where this one has none.
    pub(super) fn or(self, other: Self) -> Self {
        let location = self.location.or(other.location);
        Self {
            is_void: location.is_none() && (self.is_void || other.is_void),
            location,
            alt: self.alt.or(other.alt),
            heading: self.heading.or(other.heading),
            time: self.time.or(other.time),
        }
    }
}

/// The first letter of a text, in upper case.
fn first_letter(gps: &Directory<'_>, tag: u16) -> Option<char> {
    let letter = gps.field(tag)?.text()?.chars().next()?;
    Some(letter.to_ascii_uppercase())
}

/// An angle as it stands, and whether a reference says that it is negative.
#[derive(Debug, Clone, Copy)]
pub(super) struct Angle {
    /// Degrees with the sign that they are written with.
    pub(super) degrees: f64,
    /// `Some(true)` for south and west, `None` if the reference is missing or unknown.
    pub(super) is_negative: Option<bool>,
}

/// A position from its two angles, if the hemispheres are known.
pub(super) fn position(lat: Angle, lon: Angle) -> Option<GeoPoint> {
    let is_signed = |angle: Angle| angle.is_negative.is_none() && angle.degrees < 0.0;
    let any_is_signed = is_signed(lat) || is_signed(lon);
    let signed = |angle: Angle| match angle.is_negative {
        Some(true) => Some(-angle.degrees.abs()),
        Some(false) => Some(angle.degrees.abs()),
        // Zero is the same on both sides.
        None => (any_is_signed || angle.degrees == 0.0).then_some(angle.degrees),
    };
    GeoPoint::new(signed(lat)?, signed(lon)?).ok()
}

/// Whether a position is the one that receivers and software write when they have none.
pub(super) fn is_null(point: GeoPoint) -> bool {
    point.lat() == 0.0 && point.lon() == 0.0
}

fn location(gps: &Directory<'_>) -> Option<GeoPoint> {
    let lat = angle(gps, LATITUDE, LATITUDE_REF, ['N', 'S'])?;
    let lon = angle(gps, LONGITUDE, LONGITUDE_REF, ['E', 'W'])?;
    let point = position(lat, lon)?;
    (!is_null(point) || had_fix(gps)).then_some(point)
}

/// Whether the receiver says that its position was measured.
fn had_fix(gps: &Directory<'_>) -> bool {
    let precision = gps.field(PRECISION).and_then(|field| field.number(0));
    let satellites = gps.field(SATELLITES).and_then(|field| field.text());
    first_letter(gps, STATUS) == Some('A')
        || matches!(first_letter(gps, MEASURE_MODE), Some('2' | '3'))
        || precision.is_some_and(|precision| precision.is_finite() && precision > 0.0)
        // A count or a list of their numbers.
        || satellites.is_some_and(|satellites| satellites.contains(|c| ('1'..='9').contains(&c)))
}

fn angle(
    gps: &Directory<'_>,
    value: u16,
    reference: u16,
    [positive, negative]: [char; 2],
) -> Option<Angle> {
    let is_negative = match first_letter(gps, reference) {
        Some(letter) if letter == positive => Some(false),
        Some(letter) if letter == negative => Some(true),
        _ => None,
    };
    Some(Angle {
        degrees: degrees(gps.field(value)?)?,
        is_negative,
    })
}

/// Degrees, minutes and seconds as degrees. The last two may be absent or 0/0, and any may carry
/// the sign of all.
fn degrees(field: Field<'_>) -> Option<f64> {
    let part = |index: usize| match field.number(index) {
        Some(value) if value.is_nan() && index > 0 => Some(0.0),
        Some(value) => Some(value).filter(|value| value.is_finite()),
        None => (index > 0).then_some(0.0),
    };
    let parts = [part(0)?, part(1)?, part(2)?];
    let magnitude = parts[0].abs() + parts[1].abs() / 60.0 + parts[2].abs() / 3600.0;
    let is_negative = parts.iter().any(|part| *part < 0.0);
    Some(if is_negative { -magnitude } else { magnitude })
}

/// The height in metres, as it stands: of the four references, 1 and 3 are below sea level and
/// below the ellipsoid. Where there is none, the number's own sign counts.
fn altitude(gps: &Directory<'_>) -> Option<Altitude> {
    let metres = gps.field(ALTITUDE)?.number(0)?;
    let reference = gps.field(ALTITUDE_REF).and_then(|field| field.number(0));
    let is_below = reference == Some(1.0) || reference == Some(3.0);
    Altitude::new(if is_below { -metres.abs() } else { metres }).ok()
}

fn gps_time(gps: &Directory<'_>) -> Option<Timestamp> {
    let date = parse_date(&gps.field(DATE_STAMP)?.text()?)?;
    let clock = gps.field(TIME_STAMP)?;
    let part = |index: usize, end: f64| {
        let value = clock.number(index)?;
        (0.0..end).contains(&value).then_some(value)
    };
    let (hours, minutes, seconds) = (part(0, 24.0)?, part(1, 60.0)?, part(2, 60.0)?);
    let since_midnight = hours * 3600.0 + minutes * 60.0 + seconds;
    // Microseconds are finer than any receiver, and coarser than the error of the sum.
    let micros = (since_midnight * 1e6).round() as i64;
    let midnight = PrimitiveDateTime::new(date, Time::MIDNIGHT);
    let time = midnight.checked_add(Duration::microseconds(micros))?;
    in_range(time.assume_utc())
}

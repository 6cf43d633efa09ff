//! Image names that carry their own metadata, the convention of the common visual place
//! recognition benchmarks:
//!
//! ```text
//! @utm_east@utm_north@zone@band@lat@lon@pano@tile@heading@pitch@roll@height@time@note@.jpg
//! ```
//!
//! Only the first two fields must be there; the rest may be empty or absent.

use super::position::{GeoPoint, Heading};
use super::utm_zone::{MetricPoint, UtmZone};
use crate::clock::in_range;
use crate::invalid::InvalidValue;
use crate::types::Timestamp;
use time::{Date, Month, PrimitiveDateTime, Time};

/// What a name says.
#[derive(Debug, Clone, PartialEq)]
pub struct UtmName {
    /// Grid coordinates in metres.
    pub point: MetricPoint,
    /// The zone they refer to.
    pub zone: Option<UtmZone>,
    /// Zone and band as the name gives them, where it gives both and there is no such zone.
    pub unknown_zone: Option<String>,
    /// Latitude and longitude, where the name spells them out.
    pub geo: Option<GeoPoint>,
    /// How far each of these two may be from the truth in degrees, because they have only so many
    /// decimals.
    pub(super) geo_tolerance: [f64; 2],
    /// Identifier of the panorama or frame; empty if absent.
    pub pano_id: String,
    /// Where the camera looked.
    pub heading: Option<Heading>,
    /// When it was taken; such names give no zone of time, so UTC is assumed.
    pub captured_at: Option<Timestamp>,
}

impl UtmName {
    /// Reads the last component of `name`; the error says what is wrong with it.
    pub fn parse(name: &str) -> Result<Self, InvalidValue> {
        let file = name.rsplit('/').next().unwrap_or(name);
        let wrong = |what: &str| InvalidValue::new("name", format!("{file:?} {what}"));
        let Some(fields) = Fields::of(file) else {
            return Err(wrong("does not start with @"));
        };
        let east = fields.number(0).filter(|metres| metres.is_finite());
        let north = fields.number(1).filter(|metres| metres.is_finite());
        let (Some(east), Some(north)) = (east, north) else {
            return Err(wrong("does not begin with @utm_east@utm_north@"));
        };
        let lat = fields.number(4);
        let lon = fields.number(5);
        let (number, band) = (fields.text(2), fields.text(3));
        let zone = UtmZone::new(number, band);
        let names_both = !number.is_empty() && !band.is_empty();
        Ok(Self {
            point: MetricPoint { east, north },
            zone,
            unknown_zone: (zone.is_none() && names_both).then(|| format!("{number}{band}")),
            geo_tolerance: [4, 5].map(|index| last_decimal(fields.text(index))),
            geo: lat
                .zip(lon)
                .and_then(|(lat, lon)| GeoPoint::new(lat, lon).ok()),
            pano_id: fields.text(6).to_owned(),
            heading: fields
                .number(8)
                .and_then(|degrees| Heading::new(degrees).ok()),
            captured_at: parse_time(fields.text(12)),
        })
    }
}

/// One unit of the last decimal of a number.
fn last_decimal(number: &str) -> f64 {
    let decimals = number
        .split_once('.')
        .map_or(0, |(_, decimals)| decimals.len());
    10f64.powi(-(decimals.min(15) as i32))
}

/// The parts between the `@` of a file name, without its extension.
struct Fields<'a>(Vec<&'a str>);

impl<'a> Fields<'a> {
    /// Splits a file name; `None` if it does not start with `@`.
    fn of(file: &'a str) -> Option<Self> {
        let stem = match file.rsplit_once('.') {
            Some((stem, end)) if is_extension(end) => stem,
            _ => file,
        };
        let fields = stem.strip_prefix('@')?.split('@');
        Some(Self(fields.map(str::trim).collect()))
    }

    /// A field as text, counted from 0; empty if the name ends before it.
    fn text(&self, index: usize) -> &'a str {
        self.0.get(index).copied().unwrap_or("")
    }

    /// A field as a number; none if it is absent or something else.
    fn number(&self, index: usize) -> Option<f64> {
        self.text(index).parse().ok()
    }
}

/// Whether what follows the last dot of a name is an extension, rather than the decimals of a
/// coordinate.
fn is_extension(text: &str) -> bool {
    !text.is_empty()
        && text.chars().all(|c| c.is_ascii_alphanumeric())
        && text.chars().any(|c| c.is_ascii_alphabetic())
}

/// `YYYYMMDD_hhmmss`, everything from the right optional; what is missing counts as the beginning.
fn parse_time(text: &str) -> Option<Timestamp> {
    let (day_part, time_part) = text.split_once('_').unwrap_or((text, ""));
    let digits = |text: &str, range: std::ops::Range<usize>, default: u8| match text.get(range) {
        Some(part) => part.parse().ok(),
        None => Some(default),
    };
    let year = day_part.get(..4).filter(|year| !year.starts_with('+'))?;
    let year = year.parse().ok()?;
    let month = Month::try_from(digits(day_part, 4..6, 1)?).ok()?;
    let date = Date::from_calendar_date(year, month, digits(day_part, 6..8, 1)?).ok()?;
    let time = Time::from_hms(
        digits(time_part, 0..2, 0)?,
        digits(time_part, 2..4, 0)?,
        digits(time_part, 4..6, 0)?,
    );
    in_range(PrimitiveDateTime::new(date, time.ok()?).assume_utc())
}

#[cfg(test)]
mod tests {
    use super::*;
    use time::macros::datetime;

    #[test]
    fn a_full_name_gives_every_field() {
        let name =
            "db/@0584300.51@4475420.32@17@T@040.42412@-080.00610@pano-1@03@090@@@@201311@note@.jpg";
        let parsed = UtmName::parse(name).unwrap();
        assert_eq!(
            parsed.point,
            MetricPoint {
                east: 584_300.51,
                north: 4_475_420.32
            }
        );
        assert_eq!(
            parsed.zone,
            Some(UtmZone {
                number: 17,
                band: 'T'
            })
        );
        assert_eq!(
            (parsed.pano_id.as_str(), parsed.heading.unwrap().degrees()),
            ("pano-1", 90.0)
        );
        assert_eq!(
            parsed.captured_at,
            Timestamp::of(datetime!(2013-11-01 0:00 UTC))
        );
        let found = parsed.position(None);
        let geo = found.location.unwrap();
        assert!(
            geo.distance_m(GeoPoint::new(40.42412, -80.00610).unwrap()) < 2_000.0,
            "{geo:?}"
        );
        assert_eq!(found.doubt, None);
    }

    #[test]
    fn short_names_do_and_others_are_refused() {
        let parsed = UtmName::parse("@12.5@-3@.jpg").unwrap();
        assert_eq!(
            (parsed.point, parsed.zone),
            (
                MetricPoint {
                    east: 12.5,
                    north: -3.0
                },
                None
            )
        );
        assert_eq!(UtmName::parse("@1@2.5.jpg").unwrap().point.north, 2.5);
        assert_eq!(UtmName::parse("@1@2.5").unwrap().point.north, 2.5);
        for bad in [
            "",
            "img.jpg",
            "@.jpg",
            "@a@b@.jpg",
            "@1@@.jpg",
            "@NaN@1@.jpg",
            "x@1@2@.jpg",
        ] {
            assert!(UtmName::parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn times_may_stop_anywhere() {
        assert_eq!(
            parse_time("20190102_030405"),
            Timestamp::of(datetime!(2019-01-02 3:04:05 UTC))
        );
        let new_year = Timestamp::of(datetime!(2019-01-01 0:00 UTC));
        assert_eq!(parse_time("2019"), new_year);
        assert_eq!(parse_time("201913"), None);
        assert_eq!(parse_time("0000"), None);
        assert_eq!(parse_time(""), None);
    }
}

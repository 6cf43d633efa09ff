//! Names that carry their own metadata:
//! `@utm_east@utm_north@zone@band@lat@lon@pano@tile@heading@pitch@roll@height@ time@note@.jpg`, the
//! convention of the common visual place recognition benchmarks.
//!
//! Only the first two fields must be there; the rest may be empty or absent.

use super::{GeoPoint, Heading, MetricPoint, UtmZone};
use crate::types::InvalidValue;
use time::{Date, Month, OffsetDateTime, PrimitiveDateTime, Time};

/// What a name says.
#[derive(Debug, Clone, PartialEq)]
pub struct UtmName {
    /// Grid coordinates in metres.
    pub point: MetricPoint,
    /// The zone they refer to.
    pub zone: Option<UtmZone>,
    /// Latitude and longitude, where the name spells them out.
    pub geo: Option<GeoPoint>,
    /// Identifier of the panorama or frame; empty if absent.
    pub pano_id: String,
    /// Where the camera looked.
    pub heading: Option<Heading>,
    /// When it was taken; such names give no zone of time, so UTC is assumed.
    pub captured_at: Option<OffsetDateTime>,
}

impl UtmName {
    /// Reads the last component of `name`; the error says what is wrong with it.
    pub fn parse(name: &str) -> Result<Self, InvalidValue> {
        let file = name.rsplit('/').next().unwrap_or(name);
        let wrong = |what: &str| InvalidValue::new("name", format!("{file:?} {what}"));
        let stem = file
            .rsplit_once('.')
            .filter(|(_, end)| is_extension(end))
            .map_or(file, |(stem, _)| stem);
        let mut fields = stem.split('@');
        if fields.next() != Some("") {
            return Err(wrong("does not start with @"));
        }
        let fields: Vec<&str> = fields.map(str::trim).collect();
        let field = |index: usize| fields.get(index).copied().unwrap_or("");
        let metres = |index: usize| {
            field(index)
                .parse::<f64>()
                .ok()
                .filter(|value| value.is_finite())
        };
        let (Some(east), Some(north)) = (metres(0), metres(1)) else {
            return Err(wrong("does not begin with @utm_east@utm_north@"));
        };
        let degrees = |index: usize| field(index).parse::<f64>().ok();
        Ok(Self {
            point: MetricPoint { east, north },
            zone: UtmZone::new(field(2), field(3)),
            geo: degrees(4)
                .zip(degrees(5))
                .and_then(|(lat, lon)| GeoPoint::new(lat, lon).ok()),
            pano_id: field(6).to_owned(),
            heading: degrees(8).and_then(|angle| Heading::new(angle).ok()),
            captured_at: parse_time(field(12)),
        })
    }

    /// The position on the Earth: from the grid coordinates and the zone in the name, else in
    /// `fallback`, else from the latitude and longitude in the name (which carry fewer digits).
    pub fn location(&self, fallback: Option<UtmZone>) -> Option<GeoPoint> {
        self.zone
            .or(fallback)
            .and_then(|zone| zone.to_geo(self.point))
            .or(self.geo)
    }
}

fn is_extension(text: &str) -> bool {
    !text.is_empty()
        && text.chars().all(|c| c.is_ascii_alphanumeric())
        && text.chars().any(|c| c.is_ascii_alphabetic())
}

/// `YYYYMMDD_hhmmss`, everything from the right optional; what is missing counts as the beginning.
fn parse_time(text: &str) -> Option<OffsetDateTime> {
    let (day_part, time_part) = text.split_once('_').unwrap_or((text, ""));
    let digits = |text: &str, range: std::ops::Range<usize>, default: u8| match text.get(range) {
        Some(part) => part.parse().ok(),
        None => Some(default),
    };
    let year = day_part.get(..4)?.parse().ok()?;
    let month = Month::try_from(digits(day_part, 4..6, 1)?).ok()?;
    let date = Date::from_calendar_date(year, month, digits(day_part, 6..8, 1)?).ok()?;
    let time = Time::from_hms(
        digits(time_part, 0..2, 0)?,
        digits(time_part, 2..4, 0)?,
        digits(time_part, 4..6, 0)?,
    );
    Some(PrimitiveDateTime::new(date, time.ok()?).assume_utc())
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
        assert_eq!(parsed.captured_at, Some(datetime!(2013-11-01 0:00 UTC)));
        let geo = parsed.location(None).unwrap();
        assert!(
            geo.distance_m(GeoPoint::new(40.42412, -80.00610).unwrap()) < 2_000.0,
            "{geo:?}"
        );
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
            Some(datetime!(2019-01-02 3:04:05 UTC))
        );
        assert_eq!(parse_time("2019"), Some(datetime!(2019-01-01 0:00 UTC)));
        assert_eq!(parse_time("201913"), None);
        assert_eq!(parse_time(""), None);
    }
}

//! Positions on the Earth.

use crate::invalid::InvalidValue;
use serde::{Deserialize, Serialize};

/// Mean Earth radius in metres (IUGG R1).
const EARTH_RADIUS_M: f64 = 6_371_008.8;

/// A WGS84 position in degrees; finite and in range by construction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "RawGeoPoint")]
pub struct GeoPoint {
    lat: f64,
    lon: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawGeoPoint {
    lat: f64,
    lon: f64,
}

impl TryFrom<RawGeoPoint> for GeoPoint {
    type Error = InvalidValue;
    fn try_from(raw: RawGeoPoint) -> Result<Self, Self::Error> {
        Self::new(raw.lat, raw.lon)
    }
}

impl GeoPoint {
    /// Checks latitude in [-90, 90] and longitude in [-180, 180] degrees.
    pub fn new(lat: f64, lon: f64) -> Result<Self, InvalidValue> {
        // NaN fails `contains`, so it is refused here too.
        if !(-90.0..=90.0).contains(&lat) {
            return Err(InvalidValue::new(
                "lat",
                format!("{lat} is outside -90 to 90 degrees"),
            ));
        }
        if !(-180.0..=180.0).contains(&lon) {
            return Err(InvalidValue::new(
                "lon",
                format!("{lon} is outside -180 to 180 degrees"),
            ));
        }
        // Minus zero is the same place, but not the same bits, and a database may keep it as zero.
        Ok(Self {
            lat: lat + 0.0,
            lon: lon + 0.0,
        })
    }

    /// Latitude in degrees.
    pub fn lat(self) -> f64 {
        self.lat
    }

    /// Longitude in degrees.
    pub fn lon(self) -> f64 {
        self.lon
    }

    /// Great-circle distance in metres (haversine).
    pub fn distance_m(self, other: Self) -> f64 {
        let lat_a = self.lat.to_radians();
        let lat_b = other.lat.to_radians();
        let half_lat = ((lat_b - lat_a) / 2.0).sin();
        let half_lon = ((other.lon - self.lon).to_radians() / 2.0).sin();
        let chord = half_lat * half_lat + lat_a.cos() * lat_b.cos() * half_lon * half_lon;
        2.0 * EARTH_RADIUS_M * chord.min(1.0).sqrt().asin()
    }
}

/// A disc on the Earth: the geographic filter of a query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeoCircle {
    /// Centre.
    pub centre: GeoPoint,
    /// Radius in metres, finite and positive.
    pub radius_m: f64,
}

impl GeoCircle {
    /// Checks the radius.
    pub fn new(centre: GeoPoint, radius_m: f64) -> Result<Self, InvalidValue> {
        if radius_m.is_finite() && radius_m > 0.0 {
            Ok(Self { centre, radius_m })
        } else {
            Err(InvalidValue::new(
                "radius_m",
                format!("{radius_m} is not a positive number of metres"),
            ))
        }
    }

    /// Whether `point` lies inside or on the edge.
    pub fn contains(&self, point: GeoPoint) -> bool {
        self.centre.distance_m(point) <= self.radius_m
    }
}

/// A compass direction in degrees clockwise from north, in [0, 360).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Heading(f64);

impl Heading {
    /// Accepts any finite angle in [-360, 360] and folds it into [0, 360).
    pub fn new(degrees: f64) -> Result<Self, InvalidValue> {
        if !(-360.0..=360.0).contains(&degrees) {
            return Err(InvalidValue::new(
                "heading",
                format!("{degrees} is outside -360 to 360 degrees"),
            ));
        }
        let folded = degrees.rem_euclid(360.0);
        // A tiny negative angle rounds up to 360 itself.
        Ok(Self(if folded >= 360.0 { 0.0 } else { folded + 0.0 }))
    }

    /// Degrees clockwise from north.
    pub fn degrees(self) -> f64 {
        self.0
    }
}

impl TryFrom<f64> for Heading {
    type Error = InvalidValue;
    fn try_from(degrees: f64) -> Result<Self, Self::Error> {
        Self::new(degrees)
    }
}

impl From<Heading> for f64 {
    fn from(heading: Heading) -> Self {
        heading.0
    }
}

/// A height in metres, above the WGS84 ellipsoid or above whatever else a map's builder measures
/// from; finite and in range by construction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Altitude(f64);

impl Altitude {
    /// Below the deepest sea, and above whatever flies.
    const RANGE: std::ops::RangeInclusive<f64> = -12_000.0..=100_000.0;

    /// Accepts -12,000 to 100,000 metres.
    pub fn new(metres: f64) -> Result<Self, InvalidValue> {
        // NaN is in no range.
        if Self::RANGE.contains(&metres) {
            // There is no minus zero, as in a position.
            return Ok(Self(metres + 0.0));
        }
        let (lowest, highest) = (Self::RANGE.start(), Self::RANGE.end());
        Err(InvalidValue::new(
            "alt",
            format!("{metres} is outside {lowest} to {highest} metres"),
        ))
    }

    /// Metres.
    pub fn metres(self) -> f64 {
        self.0
    }
}

impl TryFrom<f64> for Altitude {
    type Error = InvalidValue;
    fn try_from(metres: f64) -> Result<Self, Self::Error> {
        Self::new(metres)
    }
}

impl From<Altitude> for f64 {
    fn from(altitude: Altitude) -> Self {
        altitude.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_is_no_minus_zero() {
        let point = GeoPoint::new(-0.0, -0.0).unwrap();
        let heading = Heading::new(-0.0).unwrap();
        assert!(
            [point.lat(), point.lon(), heading.degrees()]
                .iter()
                .all(|value| value.is_sign_positive())
        );
    }

    #[test]
    fn positions_out_of_range_or_not_finite_are_refused() {
        for (lat, lon) in [
            (95.0, 0.0),
            (0.0, 181.0),
            (f64::NAN, 0.0),
            (0.0, f64::INFINITY),
        ] {
            assert!(GeoPoint::new(lat, lon).is_err(), "{lat} {lon}");
        }
    }

    #[test]
    fn one_degree_of_latitude_is_111_km() {
        let south = GeoPoint::new(51.0, 7.0).unwrap();
        let north = GeoPoint::new(52.0, 7.0).unwrap();
        assert!((south.distance_m(north) - 111_195.0).abs() < 10.0);
    }

    #[test]
    fn distance_crosses_the_date_line() {
        let west = GeoPoint::new(0.0, 179.9995).unwrap();
        let east = GeoPoint::new(0.0, -179.9995).unwrap();
        assert!((west.distance_m(east) - 111.195).abs() < 0.1);
    }

    #[test]
    fn altitudes_out_of_range_or_not_finite_are_refused() {
        for metres in [-12_001.0, 1e6, f64::NAN, f64::INFINITY] {
            assert!(Altitude::new(metres).is_err(), "{metres}");
        }
        assert!(Altitude::new(-0.0).unwrap().metres().is_sign_positive());
    }

    #[test]
    fn headings_fold() {
        assert_eq!(Heading::new(-90.0).unwrap().degrees(), 270.0);
        assert_eq!(Heading::new(360.0).unwrap().degrees(), 0.0);
        assert!(Heading::new(f64::NAN).is_err());
    }
}

//! Zones of the Universal Transverse Mercator grid, and points on it.

use super::position::GeoPoint;
use crate::invalid::InvalidValue;
use std::fmt;

/// A point on a plane, in metres east and north of the plane's origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MetricPoint {
    /// Metres east.
    pub east: f64,
    /// Metres north.
    pub north: f64,
}

/// Letters of the latitude bands, south to north.
const BANDS: &str = "CDEFGHJKLMNPQRSTUVWX";

/// A zone and latitude band of the Universal Transverse Mercator grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct UtmZone {
    /// 1 to 60.
    pub number: u8,
    /// Latitude band, C to X without I and O; N and above lie north of the equator.
    pub band: char,
}

impl fmt::Display for UtmZone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.number, self.band)
    }
}

impl std::str::FromStr for UtmZone {
    type Err = InvalidValue;

    /// Parses `33T`.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = || {
            InvalidValue::new(
                "utm_zone",
                format!("{text:?} is not a zone and band such as 33T"),
            )
        };
        let (band_start, _) = text.char_indices().next_back().ok_or_else(wrong)?;
        let (number, band) = text.split_at(band_start);
        Self::new(number, band).ok_or_else(wrong)
    }
}

impl UtmZone {
    /// The zone of a number and a band given as text; none if either is not one.
    pub(super) fn new(number: &str, band: &str) -> Option<Self> {
        let number = number.parse().ok()?;
        let band = band.chars().next()?.to_ascii_uppercase();
        let is_zone = (1..=60).contains(&number) && BANDS.contains(band);
        is_zone.then_some(Self { number, band })
    }

    /// The southernmost and the northernmost latitude of the band, in degrees.
    pub(super) fn latitudes(self) -> (f64, f64) {
        let index = BANDS.find(self.band).unwrap_or_default();
        let south = 8.0 * index as f64 - 80.0;
        // The northernmost band is longer, so that it reaches the north of Greenland.
        let north = if self.band == 'X' { 84.0 } else { south + 8.0 };
        (south, north)
    }

    /// The zone a position lies in; none beyond 80 degrees south and 84 north.
    pub fn of(position: GeoPoint) -> Option<Self> {
        let band = utm::lat_to_zone_letter(position.lat())?;
        Some(Self {
            number: utm::lat_lon_to_zone_number(position.lat(), position.lon()),
            band,
        })
    }

    /// The position of grid coordinates in this zone.
    pub fn to_geo(self, point: MetricPoint) -> Option<GeoPoint> {
        let approximate = self.approximate_geo(point)?;
        // The library's inverse is off by up to 0.6 m at the edge of a zone, while its forward
        // direction is exact. So the forward direction measures the error of the first answer, and
        // a second inverse of the point moved by that error is right to less than a millimetre.
        let reached = self.from_geo(approximate);
        let corrected = MetricPoint {
            east: 2.0 * point.east - reached.east,
            north: 2.0 * point.north - reached.north,
        };
        Some(self.approximate_geo(corrected).unwrap_or(approximate))
    }

    /// The position of grid coordinates as the library's inverse projection gives it.
    fn approximate_geo(self, point: MetricPoint) -> Option<GeoPoint> {
        let (lat, lon) =
            utm::wsg84_utm_to_lat_lon(point.east, point.north, self.number, self.band).ok()?;
        GeoPoint::new(lat, lon).ok()
    }

    /// The grid coordinates of a position, continued into this zone wherever it lies.
    pub fn from_geo(self, position: GeoPoint) -> MetricPoint {
        // Longitude is counted from the zone's own meridian. Otherwise two neighbours on either
        // side of the date line would lie 360 degrees apart.
        let meridian = f64::from(self.number) * 6.0 - 183.0;
        let lon = meridian + (position.lon() - meridian + 180.0).rem_euclid(360.0) - 180.0;
        let (north, east, _) = utm::to_utm_wgs84(position.lat(), lon, self.number);
        MetricPoint { east, north }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_lie_on_top_of_each_other() {
        let latitudes = |text: &str| text.parse::<UtmZone>().unwrap().latitudes();
        assert_eq!(latitudes("1C"), (-80.0, -72.0));
        assert_eq!(
            (latitudes("1M"), latitudes("1N")),
            ((-8.0, 0.0), (0.0, 8.0))
        );
        assert_eq!(
            (latitudes("1S"), latitudes("1X")),
            ((32.0, 40.0), (72.0, 84.0))
        );
    }

    #[test]
    fn grid_and_globe_agree_both_ways() {
        let zone: UtmZone = "54S".parse().unwrap();
        let tokyo = GeoPoint::new(35.6586, 139.7454).unwrap();
        let there = zone.from_geo(tokyo);
        assert!(zone.to_geo(there).unwrap().distance_m(tokyo) < 0.01);
        // At the edge of a zone too.
        let edge = GeoPoint::new(36.0, 143.9999).unwrap();
        assert!(zone.to_geo(zone.from_geo(edge)).unwrap().distance_m(edge) < 0.01);
        assert_eq!(zone.to_string(), "54S");
        for bad in ["", "T", "61T", "33I", "0N", "33"] {
            assert!(bad.parse::<UtmZone>().is_err(), "{bad}");
        }
    }
}

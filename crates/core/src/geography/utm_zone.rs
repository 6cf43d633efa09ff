//! Zones of the Universal Transverse Mercator grid, and points on it.

use super::GeoPoint;
use crate::types::InvalidValue;

/// A point on a plane, in metres east and north of the plane's origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MetricPoint {
    /// Metres east.
    pub east: f64,
    /// Metres north.
    pub north: f64,
}

/// A zone and latitude band of the Universal Transverse Mercator grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct UtmZone {
    /// 1 to 60.
    pub number: u8,
    /// Latitude band, C to X without I and O; N and above lie north of the equator.
    pub band: char,
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
        let (split, band) = text.char_indices().next_back().ok_or_else(wrong)?;
        Self::new(&text[..split], &band.to_string()).ok_or_else(wrong)
    }
}

impl UtmZone {
    pub(super) fn new(number: &str, band: &str) -> Option<Self> {
        let number = number.parse().ok().filter(|n| (1..=60).contains(n))?;
        let band = band.chars().next()?.to_ascii_uppercase();
        ("CDEFGHJKLMNPQRSTUVWX".contains(band)).then_some(Self { number, band })
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
        let inverse = |east, north| {
            let (lat, lon) = utm::wsg84_utm_to_lat_lon(east, north, self.number, self.band).ok()?;
            GeoPoint::new(lat, lon).ok()
        };
        let near = inverse(point.east, point.north)?;
        // The library's inverse is off by up to 0.6 m at the edge of a zone, where neighbours of
        // two zones meet. Its forward direction is exact, so one step back from where that lands
        // leaves less than a millimetre.
        let landed = self.from_geo(near);
        let (east, north) = (
            2.0 * point.east - landed.east,
            2.0 * point.north - landed.north,
        );
        Some(inverse(east, north).unwrap_or(near))
    }

    /// The grid coordinates of a position, continued into this zone wherever it lies.
    pub fn from_geo(self, position: GeoPoint) -> MetricPoint {
        // Measured from the zone's own meridian, so that the date line does not tear neighbours
        // apart.
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
    fn grid_and_globe_agree_both_ways() {
        let zone: UtmZone = "54S".parse().unwrap();
        let tokyo = GeoPoint::new(35.6586, 139.7454).unwrap();
        let there = zone.from_geo(tokyo);
        assert!(zone.to_geo(there).unwrap().distance_m(tokyo) < 0.01);
        // At the edge of a zone too.
        let edge = GeoPoint::new(36.0, 143.9999).unwrap();
        assert!(zone.to_geo(zone.from_geo(edge)).unwrap().distance_m(edge) < 0.01);
        for bad in ["", "T", "61T", "33I", "0N", "33"] {
            assert!(bad.parse::<UtmZone>().is_err(), "{bad}");
        }
    }
}

//! Positions in metres, between which distances cost a few multiplications.
//!
//! A filter compares hundreds of places with hundreds of others. So a position is a point of space:
//! of the sphere for degrees, which has no date line and no poles to mind, and of a plane for
//! positions that are metres already. The straight line between two points is shorter than the way
//! over the ground by less than a millimetre a kilometre.

use placeformer_core::types::{GeoPoint, Heading};

/// Mean Earth radius in metres (IUGG R1), as for distances elsewhere.
const EARTH_RADIUS_M: f64 = 6_371_008.8;

/// A position in metres, in a frame shared by all that are compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point([f64; 3]);

impl Point {
    /// A position in a plane, in metres.
    pub fn planar(x: f64, y: f64) -> Self {
        Self([x, y, 0.0])
    }

    /// Distance in metres.
    pub fn distance_m(self, other: Self) -> f64 {
        self.squared_distance(other).sqrt()
    }

    /// Squared distance in square metres.
    pub(crate) fn squared_distance(self, other: Self) -> f64 {
        let mut sum = 0.0;
        for (a, b) in self.0.iter().zip(other.0) {
            let difference = a - b;
            sum += difference * difference;
        }
        sum
    }
}

impl From<GeoPoint> for Point {
    fn from(point: GeoPoint) -> Self {
        let (sin_lat, cos_lat) = point.lat().to_radians().sin_cos();
        let (sin_lon, cos_lon) = point.lon().to_radians().sin_cos();
        let unit = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat];
        Self(unit.map(|axis| axis * EARTH_RADIUS_M))
    }
}

/// A place where the vehicle can be: the spot of one reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Where it is.
    pub point: Point,
    /// Where the reference's camera looked, if that is known.
    pub heading: Option<Heading>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn distances_are_those_over_the_ground(
            lat in -89.9..89.9f64, lon in -180.0..180.0f64,
            north in -0.01..0.01f64, east in -0.01..0.01f64,
        ) {
            let here = GeoPoint::new(lat, lon).unwrap();
            let wrapped = (lon + east + 180.0).rem_euclid(360.0) - 180.0;
            let there = GeoPoint::new((lat + north).clamp(-90.0, 90.0), wrapped).unwrap();
            let over_ground = here.distance_m(there);
            let straight = Point::from(here).distance_m(there.into());
            prop_assert!((straight - over_ground).abs() < 1e-3, "{straight} {over_ground}");
        }
    }
}

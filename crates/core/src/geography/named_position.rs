//! The position that an image's name gives, and whether to believe it.
//!
//! Names are written by many tools, and some of their positions cannot be: degrees where metres
//! belong, `S` for "south" where the band `S` lies north of the equator, a zone that does not
//! exist. A position that cannot be is not used, and what is wrong with it is said.

use super::position::GeoPoint;
use super::utm_name::UtmName;
use super::utm_zone::{MetricPoint, UtmZone};

/// A position from a name.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct NamedPosition {
    /// The position, where the name gives one that can be.
    pub location: Option<GeoPoint>,
    /// What is wrong with the name's coordinates.
    pub doubt: Option<String>,
}

/// Nearest that the two positions of a name are said to disagree, in metres.
const DISAGREEMENT_M: f64 = 500.0;
/// How far the latitude may lie outside the band that a name gives, in degrees: bands end where
/// cities do not.
const BAND_TOLERANCE: f64 = 0.5;
/// The same for a band that is given for all names at once, which may cover several.
const COMMON_BAND_TOLERANCE: f64 = 8.5;

/// A position on the grid, or why there is none.
type GridPosition = Result<(Option<GeoPoint>, Option<String>), String>;

impl UtmName {
    /// The position on the Earth: from the grid coordinates and the zone in the name, else in
    /// `fallback`, else from the latitude and longitude in the name (which carry fewer digits).
    pub fn position(&self, fallback: Option<UtmZone>) -> NamedPosition {
        match (self.on_grid(fallback), self.geo) {
            (Ok((Some(grid), doubt)), geo) => NamedPosition {
                location: Some(grid),
                doubt: doubt.or_else(|| self.disagreement(grid, geo?)),
            },
            (Ok((None, doubt)), geo) => NamedPosition {
                location: geo,
                doubt,
            },
            (Err(doubt), geo) => NamedPosition {
                location: geo,
                doubt: Some(doubt),
            },
        }
    }

    fn on_grid(&self, fallback: Option<UtmZone>) -> GridPosition {
        let MetricPoint { east, north } = self.point;
        if let Some(unknown) = &self.unknown_zone {
            return Err(format!("there is no UTM zone {unknown}"));
        }
        let Some(zone) = self.zone.or(fallback) else {
            return self.without_zone();
        };
        let off_grid = || format!("{east}, {north} are no coordinates of UTM zone {zone}");
        let point = zone.to_geo(self.point).ok_or_else(off_grid)?;
        let (south, top) = zone.latitudes();
        let tolerance = match self.zone {
            Some(_) => BAND_TOLERANCE,
            None => COMMON_BAND_TOLERANCE,
        };
        if (south - tolerance..=top + tolerance).contains(&point.lat()) {
            return Ok((Some(point), None));
        }
        let lat = point.lat();
        let wrong = format!("north {north} is at latitude {lat:.1}, which is not in band {zone}");
        match zone.band {
            // Whether the letter is the band or means "north", the position is the same.
            'N' => Ok((Some(point), Some(wrong))),
            'S' => Err(format!(
                "{wrong}; if S means south, the band is another letter"
            )),
            _ => Err(wrong),
        }
    }

    /// Without a zone, grid coordinates are metres on some plane, which may be a building's.
    fn without_zone(&self) -> GridPosition {
        let MetricPoint { east, north } = self.point;
        if self.geo.is_some() {
            return Ok((None, None));
        }
        if east.abs() <= 90.0 && north.abs() <= 180.0 {
            return Err(format!(
                "{east}, {north} are no UTM coordinates; degrees belong into the fifth and sixth \
                 field, or into a positions file"
            ));
        }
        Err("the name gives no UTM zone, and none is given for all".to_owned())
    }

    fn disagreement(&self, grid: GeoPoint, geo: GeoPoint) -> Option<String> {
        let [lat_tolerance, lon_tolerance] = self.geo_tolerance;
        // As near to the grid's position as the decimals allow.
        let nearest = |geo: f64, grid: f64, tolerance: f64| {
            let limit = 2.0 * tolerance;
            grid.clamp(geo - limit, geo + limit)
        };
        let lat = nearest(geo.lat(), grid.lat(), lat_tolerance);
        let lon = nearest(geo.lon(), grid.lon(), lon_tolerance);
        let nearest = GeoPoint::new(lat, lon).unwrap_or(geo);
        let is_far = grid.distance_m(nearest) > DISAGREEMENT_M;
        let distance = grid.distance_m(geo);
        is_far.then(|| {
            format!(
                "the name's UTM coordinates and its latitude and longitude are {distance:.0} m \
                 apart; the UTM coordinates are used"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn position(name: &str, zone: Option<&str>) -> NamedPosition {
        let zone = zone.map(|zone| zone.parse().unwrap());
        UtmName::parse(name).unwrap().position(zone)
    }

    #[track_caller]
    fn assert_near(found: &NamedPosition, lat: f64, lon: f64) {
        let expected = GeoPoint::new(lat, lon).unwrap();
        let location = found.location.expect("no position");
        assert!(location.distance_m(expected) < 50.0, "{location:?}");
    }

    #[test]
    fn the_zone_in_the_name_comes_before_the_common_one() {
        let found = position("@500000@5000000@33@T@.jpg", Some("10S"));
        assert_near(&found, 45.153_48, 15.0);
        assert_eq!(found.doubt, None);
        assert_near(
            &position("@500000@5000000@.jpg", Some("33T")),
            45.153_48,
            15.0,
        );
        // A common zone is right for the band beside it, too.
        assert_near(
            &position("@500000@5400000@.jpg", Some("33T")),
            48.753_01,
            15.0,
        );
    }

    #[test]
    fn coordinates_that_cannot_be_are_refused_with_the_reason() {
        for (name, zone, reason) in [
            ("@48.85@2.29@.jpg", None, "no UTM coordinates"),
            (
                "@48.85@2.29@.jpg",
                Some("31U"),
                "no coordinates of UTM zone 31U",
            ),
            ("@0261878@6243186@34@S@.jpg", None, "if S means south"),
            ("@0261878@6243186@34@T@.jpg", None, "not in band 34T"),
            ("@500000@5000000@.jpg", None, "no UTM zone"),
            ("@500000@5000000@61@T@.jpg", Some("33T"), "no UTM zone 61T"),
            ("@500000@6000000@.jpg", Some("33S"), "not in band 33S"),
            ("@500000@-5@33@T@.jpg", None, "no coordinates"),
        ] {
            let found = position(name, zone);
            assert_eq!(found.location, None, "{name}");
            assert!(found.doubt.unwrap().contains(reason), "{name}");
        }
        // Cape Town, with the band that it lies in.
        assert_near(
            &position("@0261878@6243186@34@H@.jpg", None),
            -33.924_87,
            18.424_06,
        );
    }

    #[test]
    fn a_letter_for_north_is_told_and_harmless() {
        let found = position("@500000@5000000@33@N@.jpg", None);
        assert_near(&found, 45.153_48, 15.0);
        assert!(found.doubt.unwrap().contains("band 33N"));
    }

    #[test]
    fn two_positions_that_disagree_are_told() {
        let found = position("@500000@5000000@33@T@45.1534@15.0@.jpg", None);
        assert_eq!(found.doubt, None);
        // One decimal is good for 11 km.
        assert_eq!(
            position("@500000@5000000@33@T@45.2@15.1@.jpg", None).doubt,
            None
        );
        let found = position("@500000@5000000@33@T@45.2534@15.0@.jpg", None);
        assert_near(&found, 45.153_48, 15.0);
        assert!(found.doubt.unwrap().contains("apart"));
        // What cannot be leaves the other one.
        let found = position("@0261878@6243186@34@S@-33.92@18.42@.jpg", None);
        assert_eq!(found.location, GeoPoint::new(-33.92, 18.42).ok());
        assert!(found.doubt.is_some());
        assert_eq!(position("@1@2@@@45.5@15.5@.jpg", None).doubt, None);
    }
}

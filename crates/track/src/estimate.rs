//! Position and heading from weighted places, with an accuracy that holds.
//!
//! A vehicle is between references, and several of them see what it sees. So its position is the
//! mean of the places around the best, each weighed by its probability. How far they spread says
//! something about the error, but not all: even where one reference takes all the weight, the
//! vehicle stands some metres from it. The two parts were fitted to the errors of drives that had
//! no say in anything else, so that two thirds of all errors are within the accuracy (the curve is
//! in the report of `eval --sequences`).

use crate::filter::PLACE_RADIUS_M;
use crate::ground::Point;
use placeformer_core::types::{Altitude, GeoPoint, Heading};

/// Standard deviation in metres, on each axis, of a vehicle around the one reference it is at.
const SPOT_SIGMA_M: f64 = 5.0;

/// How much of the places' spread is error of their mean, in variance.
const SPREAD_SHARE: f64 = 1.0;

/// Standard deviation in degrees of a vehicle's heading around that of its reference.
const HEADING_SIGMA_DEG: f64 = 8.0;

/// The squared radius that holds 68 % of a two-dimensional normal distribution, by the sum of both
/// variances.
const SQUARED_RADIUS_SHARE: f64 = 1.14;

/// Metres of one degree of latitude.
const METRES_PER_DEGREE: f64 = 111_195.08;

/// A place that takes part in an estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Where its reference was taken.
    pub point: GeoPoint,
    /// Where that reference's camera looked, if it is known.
    pub heading: Option<Heading>,
    /// How high it was taken, if that is known.
    pub alt: Option<Altitude>,
    /// Its probability.
    pub weight: f64,
}

/// Where a vehicle is, and how sure that is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Where it is.
    pub point: GeoPoint,
    /// How high it is, if the references say how high they are.
    pub alt: Option<Altitude>,
    /// Where its camera looks, if the references say where theirs did.
    pub heading: Option<Heading>,
    /// Radius in metres that holds the true position with a probability of 68 %.
    pub accuracy_m: f64,
    /// Degrees to each side that hold the true heading with a probability of 68 %; present with
    /// `heading`.
    pub accuracy_deg: Option<f64>,
    /// Covariance of the position in square metres: east-east, east-north, north-east, north-north.
    pub covariance: [f64; 4],
}

/// Fuses the places within [`PLACE_RADIUS_M`] of `best`; `None` if none of them has any weight.
pub fn estimate(best: GeoPoint, sights: &[Sight]) -> Option<Estimate> {
    let centre = Point::from(best);
    let is_near = |sight: &&Sight| centre.distance_m(sight.point.into()) <= PLACE_RADIUS_M;
    let near: Vec<&Sight> = sights.iter().filter(is_near).collect();
    let total: f64 = near.iter().map(|sight| sight.weight).sum();
    if !(total > 0.0 && total.is_finite()) {
        return None;
    }
    let (mean, covariance) = spread(best, &near, total);
    let (heading, accuracy_deg) = mean_heading(&near).unzip();
    let [east, _, _, north] = covariance;
    Some(Estimate {
        point: moved(best, mean)?,
        alt: mean_altitude(&near),
        heading,
        accuracy_m: (SQUARED_RADIUS_SHARE * (east + north)).sqrt(),
        accuracy_deg,
        covariance,
    })
}

/// Mean of the places in metres east and north of `centre`, and the covariance of its error.
fn spread(centre: GeoPoint, near: &[&Sight], total: f64) -> ([f64; 2], [f64; 4]) {
    let offsets = || {
        near.iter()
            .map(|sight| (offset(centre, sight.point), sight.weight / total))
    };
    let mut mean = [0.0; 2];
    for ([east, north], weight) in offsets() {
        mean[0] += weight * east;
        mean[1] += weight * north;
    }
    let floor = SPOT_SIGMA_M * SPOT_SIGMA_M;
    let mut covariance = [floor, 0.0, 0.0, floor];
    for ([east, north], weight) in offsets() {
        let error = [east - mean[0], north - mean[1]];
        let share = SPREAD_SHARE * weight;
        covariance[0] += share * error[0] * error[0];
        covariance[1] += share * error[0] * error[1];
        covariance[3] += share * error[1] * error[1];
    }
    covariance[2] = covariance[1];
    (mean, covariance)
}

/// The mean height of the places that say theirs.
fn mean_altitude(near: &[&Sight]) -> Option<Altitude> {
    let (mut sum, mut total) = (0.0, 0.0);
    for sight in near {
        if let Some(alt) = sight.alt {
            sum += sight.weight * alt.metres();
            total += sight.weight;
        }
    }
    Altitude::new(sum / total).ok()
}

/// The mean direction of the headings, and degrees to each side that hold 68 %.
fn mean_heading(near: &[&Sight]) -> Option<(Heading, f64)> {
    let known = || {
        near.iter()
            .filter_map(|sight| Some((sight.heading?, sight.weight)))
    };
    let total: f64 = known().map(|(_, weight)| weight).sum();
    if total <= 0.0 {
        return None;
    }
    let (mut sine, mut cosine) = (0.0, 0.0);
    for (heading, weight) in known() {
        let (s, c) = heading.degrees().to_radians().sin_cos();
        sine += weight / total * s;
        cosine += weight / total * c;
    }
    let heading = Heading::new(sine.atan2(cosine).to_degrees()).ok()?;
    // Circular standard deviation; the length is at most one but for rounding.
    let length = sine.hypot(cosine).clamp(1e-9, 1.0);
    let deviation = (-2.0 * length.ln()).sqrt().to_degrees();
    let accuracy_deg = deviation.hypot(HEADING_SIGMA_DEG).min(180.0);
    Some((heading, accuracy_deg))
}

/// Metres east and north from one point to another nearby.
fn offset(from: GeoPoint, to: GeoPoint) -> [f64; 2] {
    let east = (to.lon() - from.lon() + 540.0).rem_euclid(360.0) - 180.0;
    [
        east * METRES_PER_DEGREE * from.lat().to_radians().cos(),
        (to.lat() - from.lat()) * METRES_PER_DEGREE,
    ]
}

/// The point so many metres east and north.
fn moved(from: GeoPoint, [east, north]: [f64; 2]) -> Option<GeoPoint> {
    let lat = (from.lat() + north / METRES_PER_DEGREE).clamp(-90.0, 90.0);
    // At the poles east is nowhere.
    let circle = from.lat().to_radians().cos().max(1e-9);
    let lon = from.lon() + east / (METRES_PER_DEGREE * circle);
    GeoPoint::new(lat, (lon + 180.0).rem_euclid(360.0) - 180.0).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sight(lat: f64, lon: f64, heading: Option<f64>, weight: f64) -> Sight {
        Sight {
            point: GeoPoint::new(lat, lon).unwrap(),
            heading: heading.map(|degrees| Heading::new(degrees).unwrap()),
            alt: None,
            weight,
        }
    }

    #[test]
    fn a_vehicle_between_two_references_is_between_them() {
        let sights = [
            sight(51.0, 7.0, Some(350.0), 0.5),
            sight(51.0001, 7.0, Some(10.0), 0.5),
            // A place far away takes no part.
            sight(51.01, 7.0, Some(180.0), 0.9),
        ];
        let found = estimate(sights[0].point, &sights).unwrap();
        assert!((found.point.lat() - 51.00005).abs() < 1e-9, "{found:?}");
        let heading = found.heading.unwrap().degrees();
        assert!(heading.min(360.0 - heading) < 1e-6, "{heading}");
        let [east, cross, _, north] = found.covariance;
        assert!(north > east && cross.abs() < 1e-6, "{found:?}");
    }

    #[test]
    fn one_reference_alone_leaves_the_accuracy_of_its_spot() {
        let alone = [sight(51.0, 7.0, None, 0.3)];
        let found = estimate(alone[0].point, &alone).unwrap();
        let expected = (SQUARED_RADIUS_SHARE * 2.0).sqrt() * SPOT_SIGMA_M;
        assert!((found.accuracy_m - expected).abs() < 1e-9);
        assert_eq!((found.heading, found.accuracy_deg), (None, None));
        assert_eq!(estimate(alone[0].point, &[]), None);
        assert_eq!(
            estimate(alone[0].point, &[sight(51.0, 7.0, None, 0.0)]),
            None
        );
    }

    #[test]
    fn heights_are_averaged_over_the_places_that_say_theirs() {
        let at = |alt: Option<f64>, weight| Sight {
            alt: alt.map(|metres| Altitude::new(metres).unwrap()),
            ..sight(51.0, 7.0, None, weight)
        };
        let sights = [at(Some(100.0), 0.6), at(Some(110.0), 0.2), at(None, 0.2)];
        let found = estimate(sights[0].point, &sights).unwrap();
        assert!((found.alt.unwrap().metres() - 102.5).abs() < 1e-9);
        let silent = [at(None, 1.0)];
        assert_eq!(estimate(silent[0].point, &silent).unwrap().alt, None);
    }

    #[test]
    fn the_date_line_is_no_border() {
        let sights = [
            sight(0.0, 179.99995, None, 1.0),
            sight(0.0, -179.99995, None, 1.0),
        ];
        let found = estimate(sights[0].point, &sights).unwrap();
        assert!(found.point.lon().abs() > 179.9999, "{found:?}");
        assert!(found.accuracy_m < 20.0);
    }

    proptest! {
        #[test]
        fn estimates_are_finite_and_among_their_places(
            lat in -90.0..90.0f64, lon in -180.0..180.0f64,
            raw in prop::collection::vec(
                (-2e-4..2e-4f64, -2e-4..2e-4f64, 0.0..360.0f64, 1e-9..1.0f64), 1..20),
        ) {
            let best = GeoPoint::new(lat, lon).unwrap();
            let mut sights = vec![Sight { point: best, heading: None, alt: None, weight: 1e-3 }];
            for (north, east, heading, weight) in raw {
                let lon = (lon + east + 180.0).rem_euclid(360.0) - 180.0;
                sights.push(sight((lat + north).clamp(-90.0, 90.0), lon, Some(heading), weight));
            }
            let found = estimate(best, &sights).unwrap();
            prop_assert!(found.accuracy_m.is_finite() && found.accuracy_m >= SPOT_SIGMA_M);
            prop_assert!(Point::from(found.point).distance_m(best.into()) <= PLACE_RADIUS_M + 1.0);
            let [east, cross, mirrored, north] = found.covariance;
            prop_assert!(cross == mirrored && east * north >= cross * cross - 1e-6);
        }
    }
}

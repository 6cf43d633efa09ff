//! A query's filter, prepared so that most references are decided by a few comparisons.
//!
//! The exact test of a circle costs a dozen trigonometric calls. A circle lies inside a box of
//! latitudes and longitudes that is known beforehand; whatever is outside the box is outside the
//! circle, and so is a whole block of references whose own extent misses the box.

use placeformer_core::types::{GeoCircle, GeoPoint, ReferenceFilter};
use time::OffsetDateTime;

/// Smaller than any radius of the Earth in use, so that boxes come out too large rather than too
/// small.
const SMALL_EARTH_RADIUS_M: f64 = 6_350_000.0;

/// Degrees added on every side of a box against rounding: about 10 cm.
const MARGIN_DEGREES: f64 = 1e-6;

/// Where and when one reference was taken, in 32 bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PlaceAndTime {
    // Not a number where there is no location: fails every comparison as it should.
    lat: f64,
    lon: f64,
    captured_at: Option<OffsetDateTime>,
}

impl PlaceAndTime {
    pub(super) fn new(location: Option<GeoPoint>, captured_at: Option<OffsetDateTime>) -> Self {
        let (lat, lon) = location.map_or((f64::NAN, f64::NAN), |point| (point.lat(), point.lon()));
        Self {
            lat,
            lon,
            captured_at,
        }
    }

    fn location(&self) -> Option<GeoPoint> {
        GeoPoint::new(self.lat, self.lon).ok()
    }
}

/// The ranges that the references of a block span; empty ranges where none has a value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Extent {
    lat: (f64, f64),
    lon: (f64, f64),
    captured_at: Option<(OffsetDateTime, OffsetDateTime)>,
}

impl Default for Extent {
    fn default() -> Self {
        let nothing = (f64::INFINITY, f64::NEG_INFINITY);
        Self {
            lat: nothing,
            lon: nothing,
            captured_at: None,
        }
    }
}

impl Extent {
    /// Grows to hold one more.
    pub(super) fn add(&mut self, entry: &PlaceAndTime) {
        // `min` and `max` ignore what is not a number.
        self.lat = (self.lat.0.min(entry.lat), self.lat.1.max(entry.lat));
        self.lon = (self.lon.0.min(entry.lon), self.lon.1.max(entry.lon));
        if let Some(time) = entry.captured_at {
            let (first, last) = self.captured_at.unwrap_or((time, time));
            self.captured_at = Some((first.min(time), last.max(time)));
        }
    }
}

/// The box around a circle.
#[derive(Debug, Clone, Copy)]
struct Box2 {
    lat: (f64, f64),
    centre_lon: f64,
    /// Half the width; 180 where the circle holds a pole.
    half_lon: f64,
}

impl Box2 {
    fn around(circle: &GeoCircle) -> Self {
        let (lat, centre_lon) = (circle.centre.lat(), circle.centre.lon());
        let angle = circle.radius_m / SMALL_EARTH_RADIUS_M;
        let half_lat = angle.to_degrees() + MARGIN_DEGREES;
        let (south, north) = (lat - half_lat, lat + half_lat);
        let half_lon = if south <= -90.0 || north >= 90.0 {
            180.0
        } else {
            // The meridian that touches the circle; a circle clear of both poles spans less than a
            // quarter turn.
            (angle.sin() / lat.to_radians().cos())
                .min(1.0)
                .asin()
                .to_degrees()
                + MARGIN_DEGREES
        };
        Self {
            lat: (south, north),
            centre_lon,
            half_lon,
        }
    }

    fn contains(&self, lat: f64, lon: f64) -> bool {
        let apart = (lon - self.centre_lon).abs();
        lat >= self.lat.0 && lat <= self.lat.1 && apart.min(360.0 - apart) <= self.half_lon
    }

    fn may_meet(&self, extent: &Extent) -> bool {
        let (west, east) = (
            self.centre_lon - self.half_lon,
            self.centre_lon + self.half_lon,
        );
        let crosses_date_line = west < -180.0 || east > 180.0;
        let apart = extent.lon.1 < west || extent.lon.0 > east;
        extent.lat.1 >= self.lat.0 && extent.lat.0 <= self.lat.1 && (crosses_date_line || !apart)
    }
}

/// A prepared filter.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sieve {
    filter: ReferenceFilter,
    around: Option<Box2>,
}

impl Sieve {
    pub(super) fn new(filter: &ReferenceFilter) -> Self {
        Self {
            filter: *filter,
            around: filter.near.as_ref().map(Box2::around),
        }
    }

    /// Whether everything passes.
    pub(super) fn is_open(&self) -> bool {
        self.filter.is_empty()
    }

    /// Whether something within `extent` may pass.
    pub(super) fn may_pass(&self, extent: &Extent) -> bool {
        let time = &self.filter;
        let timed = time.captured_after.is_none() && time.captured_before.is_none()
            || extent.captured_at.is_some_and(|(first, last)| {
                time.captured_after.is_none_or(|start| last >= start)
                    && time.captured_before.is_none_or(|end| first < end)
            });
        timed && self.around.is_none_or(|around| around.may_meet(extent))
    }

    /// Exactly [`ReferenceFilter::accepts`].
    pub(super) fn passes(&self, entry: &PlaceAndTime) -> bool {
        self.around
            .is_none_or(|around| around.contains(entry.lat, entry.lon))
            && self.filter.accepts(entry.location(), entry.captured_at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn point() -> impl Strategy<Value = GeoPoint> {
        let near_a_pole = prop_oneof![-90.0..=90.0, 89.9..=90.0, -90.0..=-89.9];
        let near_the_date_line = prop_oneof![-180.0..=180.0, 179.9..=180.0, -180.0..=-179.9];
        (near_a_pole, near_the_date_line).prop_map(|(lat, lon)| GeoPoint::new(lat, lon).unwrap())
    }

    fn instant() -> impl Strategy<Value = OffsetDateTime> {
        (0i64..100).prop_map(|seconds| OffsetDateTime::from_unix_timestamp(seconds).unwrap())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn the_sieve_decides_as_the_filter_does(
            centre in point(),
            radius in prop_oneof![0.001..10.0, 10.0..1e5, 1e5..3e7],
            // Half of the points lie close to the circle's edge.
            offsets in prop::collection::vec((0.9..1.1f64, 0.0..6.3f64), 1..20),
            others in prop::collection::vec(prop::option::of(point()), 0..20),
            times in prop::collection::vec(prop::option::of(instant()), 40),
            has_circle in any::<bool>(), after in prop::option::of(instant()), before in prop::option::of(instant()),
        ) {
            let near = has_circle.then(|| GeoCircle::new(centre, radius).unwrap());
            let filter = ReferenceFilter { near, captured_after: after, captured_before: before };
            let sieve = Sieve::new(&filter);
            let edge = offsets.iter().map(|(share, bearing)| {
                let degrees = share * radius / 111_195.0;
                let lat = (centre.lat() + degrees * bearing.cos()).clamp(-90.0, 90.0);
                let stretch = lat.to_radians().cos().max(1e-6);
                let lon = (centre.lon() + degrees * bearing.sin() / stretch + 180.0).rem_euclid(360.0) - 180.0;
                GeoPoint::new(lat, lon).ok()
            });
            let mut extent = Extent::default();
            let mut any = false;
            for (location, time) in edge.chain(others.iter().copied()).zip(times) {
                let entry = PlaceAndTime::new(location, time);
                extent.add(&entry);
                let expected = filter.accepts(location, time);
                any |= expected;
                prop_assert_eq!(sieve.passes(&entry), expected);
            }
            prop_assert!(!any || sieve.may_pass(&extent));
        }
    }

    #[test]
    fn far_blocks_are_skipped() {
        let circle = GeoCircle::new(GeoPoint::new(51.0, 7.0).unwrap(), 500.0).unwrap();
        let sieve = Sieve::new(&ReferenceFilter {
            near: Some(circle),
            ..ReferenceFilter::default()
        });
        let mut extent = Extent::default();
        assert!(!sieve.may_pass(&extent));
        extent.add(&PlaceAndTime::new(GeoPoint::new(51.0, 7.1).ok(), None));
        assert!(!sieve.may_pass(&extent));
        extent.add(&PlaceAndTime::new(GeoPoint::new(51.0, 6.9).ok(), None));
        assert!(sieve.may_pass(&extent));
    }
}

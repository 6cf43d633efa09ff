//! A query's filter, prepared so that a few comparisons are enough for most references.
//!
//! The exact test whether a point is inside a circle costs a dozen trigonometric calls. But a
//! circle lies inside a box of latitudes and longitudes, which is computed once. What is outside
//! the box is outside the circle; and if the ranges of a whole block of references do not overlap
//! the box, none of its rows has to be looked at.

use super::entry::{IndexEntry, LocatedReference};
use placeformer_core::types::{
    Altitude, GeoCircle, GeoPoint, Heading, ReferenceFilter, ReferenceId, Timestamp,
};

/// Smaller than any radius of the Earth that is in use, so that boxes are never too small.
const SMALL_EARTH_RADIUS_M: f64 = 6_350_000.0;

/// Degrees by which a box is widened on every side against rounding: about 10 cm.
const MARGIN_DEGREES: f64 = 1e-6;

/// Where, in which direction and when one reference was taken, in 40 bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PlaceAndTime {
    /// Degrees; NaN if there is no location. Comparisons with NaN are false, so such a reference is
    /// outside every box.
    pub(super) lat: f64,
    lon: f64,
    /// Metres; NaN if there is no height.
    alt: f32,
    /// Degrees; NaN if there is no heading.
    heading: f32,
    captured_at: Option<Timestamp>,
}

impl PlaceAndTime {
    pub(super) fn new(location: Option<GeoPoint>, captured_at: Option<Timestamp>) -> Self {
        let (lat, lon) = location.map_or((f64::NAN, f64::NAN), |point| (point.lat(), point.lon()));
        Self {
            lat,
            lon,
            alt: f32::NAN,
            heading: f32::NAN,
            captured_at,
        }
    }

    /// The place of an entry of the index.
    pub(super) fn of(entry: &IndexEntry) -> Self {
        Self {
            alt: entry.alt.map_or(f32::NAN, |alt| alt.metres() as f32),
            heading: entry
                .heading
                .map_or(f32::NAN, |heading| heading.degrees() as f32),
            ..Self::new(entry.location, entry.captured_at)
        }
    }

    /// The reference `id`, which was taken here; `None` if there is no location.
    pub(super) fn located(&self, id: ReferenceId) -> Option<LocatedReference> {
        Some(LocatedReference {
            id,
            location: self.location()?,
            alt: Altitude::new(f64::from(self.alt)).ok(),
            heading: Heading::new(f64::from(self.heading)).ok(),
        })
    }

    fn location(&self) -> Option<GeoPoint> {
        GeoPoint::new(self.lat, self.lon).ok()
    }
}

/// The ranges of latitude, longitude and time that the references of a block cover. A range is
/// empty if no reference has a value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Extent {
    lat: (f64, f64),
    lon: (f64, f64),
    captured_at: Option<(Timestamp, Timestamp)>,
}

impl Default for Extent {
    fn default() -> Self {
        let empty = (f64::INFINITY, f64::NEG_INFINITY);
        Self {
            lat: empty,
            lon: empty,
            captured_at: None,
        }
    }
}

impl Extent {
    /// Extends the ranges to contain one more reference.
    pub(super) fn add(&mut self, entry: &PlaceAndTime) {
        // `min` and `max` ignore NaN.
        self.lat = (self.lat.0.min(entry.lat), self.lat.1.max(entry.lat));
        self.lon = (self.lon.0.min(entry.lon), self.lon.1.max(entry.lon));
        if let Some(time) = entry.captured_at {
            let (first, last) = self.captured_at.unwrap_or((time, time));
            self.captured_at = Some((first.min(time), last.max(time)));
        }
    }
}

/// A box of latitudes and longitudes around a circle, in degrees.
#[derive(Debug, Clone, Copy)]
pub(super) struct BoundingBox {
    /// South and north.
    pub(super) lat: (f64, f64),
    centre_lon: f64,
    /// Half the width; 180 if the circle contains a pole.
    half_lon: f64,
}

impl BoundingBox {
    pub(super) fn around(circle: &GeoCircle) -> Self {
        let lat = circle.centre.lat();
        let angle = circle.radius_m / SMALL_EARTH_RADIUS_M;
        let half_lat = angle.to_degrees() + MARGIN_DEGREES;
        let south = lat - half_lat;
        let north = lat + half_lat;
        let half_lon = if south <= -90.0 || north >= 90.0 {
            180.0
        } else {
            // The longitude at which a meridian touches the circle. A circle without a pole covers
            // less than a quarter turn to each side.
            let sine = angle.sin() / lat.to_radians().cos();
            sine.min(1.0).asin().to_degrees() + MARGIN_DEGREES
        };
        Self {
            lat: (south, north),
            centre_lon: circle.centre.lon(),
            half_lon,
        }
    }

    pub(super) fn contains(&self, lat: f64, lon: f64) -> bool {
        let (south, north) = self.lat;
        let difference = (lon - self.centre_lon).abs();
        // The shorter way around the Earth.
        let difference = difference.min(360.0 - difference);
        lat >= south && lat <= north && difference <= self.half_lon
    }

    /// Whether some point within `extent` may be in the box.
    pub(super) fn may_overlap(&self, extent: &Extent) -> bool {
        let (south, north) = self.lat;
        let overlaps_lat = extent.lat.1 >= south && extent.lat.0 <= north;
        let west = self.centre_lon - self.half_lon;
        let east = self.centre_lon + self.half_lon;
        let crosses_date_line = west < -180.0 || east > 180.0;
        let is_outside_lon = extent.lon.1 < west || extent.lon.0 > east;
        // A box across the date line has a second part, which is not computed. It is rare, so it
        // counts as overlapping.
        overlaps_lat && (crosses_date_line || !is_outside_lon)
    }
}

/// A filter, with the box around its circle.
#[derive(Debug, Clone, Copy)]
pub(super) struct PreparedFilter {
    filter: ReferenceFilter,
    bounding_box: Option<BoundingBox>,
}

impl PreparedFilter {
    pub(super) fn new(filter: &ReferenceFilter) -> Self {
        Self {
            filter: *filter,
            bounding_box: filter.near.as_ref().map(BoundingBox::around),
        }
    }

    /// Whether every reference passes.
    pub(super) fn accepts_all(&self) -> bool {
        self.filter.is_empty()
    }

    /// Whether some reference within `extent` may pass.
    pub(super) fn may_accept(&self, extent: &Extent) -> bool {
        let may_be_near = match &self.bounding_box {
            Some(bounding_box) => bounding_box.may_overlap(extent),
            None => true,
        };
        may_be_near && self.may_accept_time(extent)
    }

    fn may_accept_time(&self, extent: &Extent) -> bool {
        let after = self.filter.captured_after;
        let before = self.filter.captured_before;
        if after.is_none() && before.is_none() {
            return true;
        }
        let Some((first, last)) = extent.captured_at else {
            return false;
        };
        after.is_none_or(|start| last >= start) && before.is_none_or(|end| first < end)
    }

    /// Whether a reference passes; exactly [`ReferenceFilter::accepts`].
    pub(super) fn accepts(&self, entry: &PlaceAndTime) -> bool {
        if let Some(bounding_box) = &self.bounding_box
            && !bounding_box.contains(entry.lat, entry.lon)
        {
            return false;
        }
        self.filter.accepts(entry.location(), entry.captured_at)
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

    fn instant() -> impl Strategy<Value = Timestamp> {
        (0i64..100).prop_map(|seconds| Timestamp::from_unix_micros(seconds * 1_000_000).unwrap())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn the_prepared_filter_decides_as_the_filter_does(
            centre in point(),
            radius in prop_oneof![0.001..10.0, 10.0..1e5, 1e5..3e7],
            // Half of the points lie close to the circle's edge.
            offsets in prop::collection::vec((0.9..1.1f64, 0.0..6.3f64), 1..20),
            others in prop::collection::vec(prop::option::of(point()), 0..20),
            times in prop::collection::vec(prop::option::of(instant()), 40),
            has_circle in any::<bool>(),
            after in prop::option::of(instant()),
            before in prop::option::of(instant()),
        ) {
            let near = has_circle.then(|| GeoCircle::new(centre, radius).unwrap());
            let filter = ReferenceFilter {
                near,
                captured_after: after,
                captured_before: before,
            };
            let prepared = PreparedFilter::new(&filter);
            let edge = offsets.iter().map(|(share, bearing)| {
                let degrees = share * radius / 111_195.0;
                let lat = (centre.lat() + degrees * bearing.cos()).clamp(-90.0, 90.0);
                let stretch = lat.to_radians().cos().max(1e-6);
                let lon = centre.lon() + degrees * bearing.sin() / stretch;
                GeoPoint::new(lat, (lon + 180.0).rem_euclid(360.0) - 180.0).ok()
            });
            let mut extent = Extent::default();
            let mut any = false;
            for (location, time) in edge.chain(others.iter().copied()).zip(times) {
                let entry = PlaceAndTime::new(location, time);
                extent.add(&entry);
                let expected = filter.accepts(location, time);
                any |= expected;
                prop_assert_eq!(prepared.accepts(&entry), expected);
            }
            prop_assert!(!any || prepared.may_accept(&extent));
        }
    }

    #[test]
    fn far_blocks_are_skipped() {
        let circle = GeoCircle::new(GeoPoint::new(51.0, 7.0).unwrap(), 500.0).unwrap();
        let filter = PreparedFilter::new(&ReferenceFilter {
            near: Some(circle),
            ..ReferenceFilter::default()
        });
        let mut extent = Extent::default();
        assert!(!filter.may_accept(&extent));
        extent.add(&PlaceAndTime::new(GeoPoint::new(51.0, 7.1).ok(), None));
        assert!(!filter.may_accept(&extent));
        extent.add(&PlaceAndTime::new(GeoPoint::new(51.0, 6.9).ok(), None));
        assert!(filter.may_accept(&extent));
    }
}

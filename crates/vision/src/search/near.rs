//! The references around a few hundred points: where a vehicle may be by now.
//!
//! A map may have millions of references and a query only milliseconds, so most references must
//! cost no more than a comparison. A block whose extent no circle touches is skipped. In the others
//! a row is first compared with the box around all circles, then with the boxes of the few circles
//! in its band of latitude, and only what is left costs trigonometry.

use super::block::Block;
use super::entry::LocatedReference;
use super::filter::{BoundingBox, PreparedFilter};
use placeformer_core::types::{GeoCircle, GeoPoint};
use std::collections::HashMap;

/// Height in degrees of the lowest bands: about a metre.
const LOWEST_BAND_DEGREES: f64 = 1e-5;

/// Circles of one radius, prepared to be compared with many references.
pub(super) struct Circles {
    circles: Vec<(GeoCircle, BoundingBox)>,
    /// South and north of all of them.
    lat: (f64, f64),
    band_degrees: f64,
    /// By number of the band, the circles that reach into it.
    bands: HashMap<i64, Vec<u32>>,
}

impl Circles {
    pub(super) fn new(circles: &[GeoCircle]) -> Self {
        let circles: Vec<(GeoCircle, BoundingBox)> = circles
            .iter()
            .map(|circle| (*circle, BoundingBox::around(circle)))
            .collect();
        // Bands as high as a circle: each circle reaches into two or three.
        let height = |bounds: &BoundingBox| bounds.lat.1 - bounds.lat.0;
        let tallest = circles.iter().map(|(_, bounds)| height(bounds));
        let band_degrees = tallest.fold(LOWEST_BAND_DEGREES, f64::max);
        let mut prepared = Self {
            circles,
            lat: (f64::INFINITY, f64::NEG_INFINITY),
            band_degrees,
            bands: HashMap::new(),
        };
        for (number, (_, bounds)) in (0..).zip(&prepared.circles) {
            let (south, north) = bounds.lat;
            prepared.lat = (prepared.lat.0.min(south), prepared.lat.1.max(north));
            for band in band(south, band_degrees)..=band(north, band_degrees) {
                prepared.bands.entry(band).or_default().push(number);
            }
        }
        prepared
    }

    /// Adds the rows of a block that are live, pass the filter and lie in a circle; at most `limit`
    /// of them.
    pub(super) fn collect(
        &self,
        block: &Block,
        filter: &PreparedFilter,
        is_live: impl Fn(usize) -> bool,
        limit: usize,
    ) -> Vec<LocatedReference> {
        let mut found = Vec::new();
        let touches = |(_, bounds): &(GeoCircle, BoundingBox)| bounds.may_overlap(&block.extent);
        if !filter.may_accept(&block.extent) || !self.circles.iter().any(touches) {
            return found;
        }
        let (south, north) = self.lat;
        for (row, place) in block.places.iter().enumerate() {
            // A latitude that is not a number is in no range.
            let is_in_band = (south..=north).contains(&place.lat);
            if !is_in_band || !is_live(row) {
                continue;
            }
            let Some(located) = place.located(block.ids[row]) else {
                continue;
            };
            if self.contain(located.location) && filter.accepts(place) {
                found.push(located);
                if found.len() == limit {
                    break;
                }
            }
        }
        found
    }

    fn contain(&self, point: GeoPoint) -> bool {
        let band = band(point.lat(), self.band_degrees);
        let Some(numbers) = self.bands.get(&band) else {
            return false;
        };
        numbers.iter().any(|&number| {
            let (circle, bounds) = &self.circles[number as usize];
            bounds.contains(point.lat(), point.lon()) && circle.contains(point)
        })
    }
}

/// The number of the band that a latitude lies in.
fn band(lat: f64, band_degrees: f64) -> i64 {
    (lat / band_degrees).floor() as i64
}

/// At most `limit` of the references, spread evenly over the order of their ids, in which a map was
/// mostly driven.
pub(super) fn thinned(mut found: Vec<LocatedReference>, limit: usize) -> Vec<LocatedReference> {
    found.sort_unstable_by_key(|located| located.id);
    let count = found.len();
    if count <= limit {
        return found;
    }
    (0..limit).map(|i| found[i * count / limit]).collect()
}

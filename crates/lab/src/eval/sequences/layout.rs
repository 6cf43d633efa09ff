//! Where the images of a data set are, in metres.
//!
//! Frames of one drive follow each other along a street. Where a data set gives no positions, its
//! references are therefore put on a straight line in the order of their names, at an assumed
//! distance from each other: the filter knows then which are neighbours, and nothing else.

use super::SequenceOptions;
use crate::datasets::{Dataset, Item};
use placeformer_core::geography::MetricPoint;
use placeformer_core::types::{GeoPoint, Heading};
use placeformer_track::{Place, Point};

/// Metres of one degree on the equator, by the radius that the estimate uses.
const METRES_PER_DEGREE: f64 = 111_195.08;

/// Positions of the database and, where they are known, of the queries.
pub(super) struct Layout {
    database: Vec<Place>,
    /// `None` where they are not known.
    queries: Option<Vec<MetricPoint>>,
    /// The database on a plane; `None` where positions are assumed.
    plane: Option<Vec<MetricPoint>>,
    headings: Vec<Option<Heading>>,
}

impl Layout {
    pub(super) fn of(dataset: &Dataset, options: &SequenceOptions) -> Self {
        let plane = positions(&dataset.database);
        let headings: Vec<Option<Heading>> = dataset.database.iter().map(heading).collect();
        let points: Vec<Point> = match &plane {
            Some(plane) => plane
                .iter()
                .map(|at| Point::planar(at.east, at.north))
                .collect(),
            None => on_a_line(&dataset.database, options.spacing_m),
        };
        let place = |(point, heading): (Point, &Option<Heading>)| Place {
            point,
            heading: *heading,
        };
        Self {
            database: points.into_iter().zip(&headings).map(place).collect(),
            queries: plane.as_ref().and_then(|_| positions(&dataset.queries)),
            plane,
            headings,
        }
    }

    /// Whether the positions of the references are assumed.
    pub(super) fn is_assumed(&self) -> bool {
        self.plane.is_none()
    }

    /// Every reference of the database.
    pub(super) fn places(&self) -> &[Place] {
        &self.database
    }

    /// Metres between two queries, if their positions are known.
    pub(super) fn way_m(&self, from: usize, to: usize) -> Option<f64> {
        let queries = self.queries.as_ref()?;
        Some(distance(queries[from], queries[to]))
    }

    /// Where a reference is on the Earth, if the plane touched it at `origin`; `None` where
    /// positions are assumed.
    pub(super) fn on_earth(&self, reference: usize, origin: MetricPoint) -> Option<GeoPoint> {
        let at = self.plane.as_ref()?[reference];
        // At the equator a degree is as long in both directions, for some kilometres at least.
        let lat = (at.north - origin.north) / METRES_PER_DEGREE;
        let lon = (at.east - origin.east) / METRES_PER_DEGREE;
        GeoPoint::new(lat, lon).ok()
    }

    pub(super) fn heading(&self, reference: usize) -> Option<Heading> {
        self.headings[reference]
    }

    /// Where a query was taken, if that is known.
    pub(super) fn query(&self, query: usize) -> Option<MetricPoint> {
        self.queries.as_ref().map(|queries| queries[query])
    }

    /// Metres between a query and a reference, if both are known.
    pub(super) fn error_m(&self, query: usize, reference: usize) -> Option<f64> {
        let reference = self.plane.as_ref()?[reference];
        Some(distance(self.query(query)?, reference))
    }
}

fn distance(a: MetricPoint, b: MetricPoint) -> f64 {
    (a.east - b.east).hypot(a.north - b.north)
}

fn positions(items: &[Item]) -> Option<Vec<MetricPoint>> {
    items.iter().map(|item| item.position).collect()
}

fn heading(item: &Item) -> Option<Heading> {
    Heading::new(item.heading?).ok()
}

/// One after the other, in the order of their names.
fn on_a_line(items: &[Item], spacing_m: f64) -> Vec<Point> {
    let mut points = vec![Point::planar(0.0, 0.0); items.len()];
    for (number, index) in by_name(items).into_iter().enumerate() {
        points[index] = Point::planar(number as f64 * spacing_m, 0.0);
    }
    points
}

/// Indices in the order of the names.
pub(super) fn by_name(items: &[Item]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..items.len()).collect();
    order.sort_by(|&a, &b| items[a].name.cmp(&items[b].name));
    order
}

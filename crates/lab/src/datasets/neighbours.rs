//! Which database images lie within a radius of a query, without comparing all pairs.
//!
//! Points are hashed into square cells as wide as the radius, so that all neighbours of a point lie
//! in the 3x3 cells around it: a million images join in seconds.

use super::dataset::{Item, Truth};
use placeformer_core::geography::MetricPoint;
use std::collections::HashMap;

/// A grid over the positions of one side of a data set.
pub struct NeighbourGrid {
    radius_m: f64,
    cells: HashMap<(i64, i64), Vec<(usize, MetricPoint)>>,
}

impl NeighbourGrid {
    /// Hashes `points`, each with the index it is known by.
    pub fn new(radius_m: f64, points: impl IntoIterator<Item = (usize, MetricPoint)>) -> Self {
        let mut cells: HashMap<_, Vec<_>> = HashMap::new();
        for (index, point) in points {
            cells
                .entry(cell(point, radius_m))
                .or_default()
                .push((index, point));
        }
        Self { radius_m, cells }
    }

    /// The points at most the radius away, in no particular order.
    pub fn within(&self, centre: MetricPoint) -> impl Iterator<Item = usize> + '_ {
        let (column, row) = cell(centre, self.radius_m);
        let around = (-1..=1).flat_map(move |dx| (-1..=1).map(move |dy| (column + dx, row + dy)));
        around
            .filter_map(|key| self.cells.get(&key))
            .flatten()
            .filter(move |(_, point)| {
                let east = point.east - centre.east;
                let north = point.north - centre.north;
                // Compared as squares, inclusive: an image exactly at the radius is a positive.
                east * east + north * north <= self.radius_m * self.radius_m
            })
            .map(|&(index, _)| index)
    }
}

fn cell(point: MetricPoint, width: f64) -> (i64, i64) {
    (
        (point.east / width).floor() as i64,
        (point.north / width).floor() as i64,
    )
}

/// Smallest difference of two directions, 0 to 180 degrees.
pub fn angle_between(a: f64, b: f64) -> f64 {
    let difference = (a - b).rem_euclid(360.0);
    difference.min(360.0 - difference)
}

/// What the radius, and where both headings are known the view angle, say about every query.
///
/// A query without a position gets [`Truth::Unknown`]. Images whose group differs are never
/// positives: the metric coordinates of two cities may coincide.
pub(super) fn truth_by_distance(
    database: &[Item],
    queries: &[Item],
    radius_m: f64,
    max_angle_deg: Option<f64>,
) -> Vec<Truth> {
    let located = database
        .iter()
        .enumerate()
        .filter_map(|(index, item)| Some((index, item.position?)));
    let grid = NeighbourGrid::new(radius_m, located);
    let same_view =
        |query: &Item, reference: &Item| match (max_angle_deg, query.heading, reference.heading) {
            (Some(limit), Some(a), Some(b)) => angle_between(a, b) <= limit,
            _ => true,
        };
    let truth_of = |query: &Item| match query.position {
        None => Truth::Unknown,
        Some(position) => Truth::from_positives(
            grid.within(position)
                .filter(|&index| {
                    database[index].group == query.group && same_view(query, &database[index])
                })
                .collect(),
        ),
    };
    queries.iter().map(truth_of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn point(east: f64, north: f64) -> MetricPoint {
        MetricPoint { east, north }
    }

    #[test]
    fn the_radius_is_inclusive_and_angles_wrap() {
        let grid = NeighbourGrid::new(
            25.0,
            [
                (0, point(0.0, 0.0)),
                (1, point(25.0, 0.0)),
                (2, point(25.01, 0.0)),
            ],
        );
        let mut found: Vec<_> = grid.within(point(0.0, 0.0)).collect();
        found.sort_unstable();
        assert_eq!(found, [0, 1]);
        assert_eq!(angle_between(350.0, 30.0), 40.0);
        assert_eq!(angle_between(-10.0, 350.0), 0.0);
    }

    #[test]
    fn the_view_angle_counts_only_where_both_are_known() {
        let at = |heading| Item {
            position: Some(point(1.0, 1.0)),
            heading,
            ..Item::new("x", "x")
        };
        let database = [at(Some(0.0)), at(Some(90.0)), at(None)];
        let queries = [at(Some(320.0)), at(None), Item::new("lost", "lost")];
        let truth = truth_by_distance(&database, &queries, 25.0, Some(40.0));
        assert_eq!(truth[0], Truth::Positives(vec![0, 2]));
        assert_eq!(truth[1], Truth::Positives(vec![0, 1, 2]));
        assert_eq!(truth[2], Truth::Unknown);
    }

    proptest! {
        #[test]
        fn the_grid_finds_what_comparing_all_pairs_finds(
            points in prop::collection::vec((-200.0..200.0f64, -200.0..200.0f64), 0..60),
            centre in (-200.0..200.0f64, -200.0..200.0f64),
            radius in 0.5..80.0f64,
        ) {
            let grid = NeighbourGrid::new(radius, points.iter().enumerate().map(|(i, &(e, n))| (i, point(e, n))));
            let mut found: Vec<usize> = grid.within(point(centre.0, centre.1)).collect();
            found.sort_unstable();
            let expected: Vec<usize> = (0..points.len())
                .filter(|&i| {
                    let e = points[i].0 - centre.0;
                    let n = points[i].1 - centre.1;
                    e * e + n * n <= radius * radius
                })
                .collect();
            prop_assert_eq!(found, expected);
        }
    }
}

//! Which UTM zones can share one plane.
//!
//! Coordinates of different zones are not comparable, and a zone cannot be continued across the
//! globe: seen from San Francisco's zone, 20 m in Copenhagen become 80 to 100 m. So only zones that
//! touch are projected into one, in clusters of at most three, so that a point is never carried
//! farther than into the neighbouring zone. Clusters are told apart by the group of their images;
//! images of different groups are never compared.

use placeformer_core::geography::{MetricPoint, UtmZone};
use placeformer_core::types::GeoPoint;
use std::collections::BTreeSet;

/// Zones of a cluster: into the middle one, a neighbour on either side can be continued (at most
/// 1.3% too long).
const WIDTH: usize = 3;
const ZONES: u8 = 60;

/// The zones of a data set, in clusters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Zones(Vec<Cluster>);

/// Neighbouring zones of one hemisphere, from west to east.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Cluster {
    north: bool,
    numbers: Vec<u8>,
}

impl Zones {
    /// Clusters of all zones that occur.
    pub(super) fn of(zones: impl IntoIterator<Item = UtmZone>) -> Self {
        let grids: BTreeSet<(bool, u8)> = zones
            .into_iter()
            .map(|zone| (is_north(zone), zone.number))
            .collect();
        let clusters = [false, true].into_iter().flat_map(|north| {
            let numbers: Vec<u8> = grids
                .iter()
                .filter(|grid| grid.0 == north)
                .map(|grid| grid.1)
                .collect();
            runs(numbers).into_iter().flat_map(move |run| {
                run.chunks(WIDTH)
                    .map(|numbers| Cluster {
                        north,
                        numbers: numbers.to_vec(),
                    })
                    .collect::<Vec<_>>()
            })
        });
        Self(clusters.collect())
    }

    /// Where a point of `zone` lies in its cluster's plane; none where the point is outside its own
    /// grid.
    pub(super) fn project(&self, zone: UtmZone, point: MetricPoint) -> Option<MetricPoint> {
        let target = self.cluster(zone)?.target();
        // What needs no projection keeps every digit it was given with.
        if target.number == zone.number {
            Some(point)
        } else {
            Some(target.from_geo(zone.to_geo(point)?))
        }
    }

    /// The group of an image of `zone`: its cluster, if there is more than one.
    pub(super) fn group(&self, zone: UtmZone) -> Option<String> {
        if self.0.len() > 1 {
            Some(self.cluster(zone)?.name())
        } else {
            None
        }
    }

    /// The plane coordinates of a position of `zone` in its cluster.
    pub(super) fn locate(&self, zone: UtmZone, position: GeoPoint) -> Option<MetricPoint> {
        Some(self.cluster(zone)?.target().from_geo(position))
    }

    /// Whether there are several planes.
    pub(super) fn are_apart(&self) -> bool {
        self.0.len() > 1
    }

    /// What was done, for a reader of the results.
    pub(super) fn notes(&self) -> Vec<String> {
        let mut notes: Vec<String> = self
            .0
            .iter()
            .filter(|cluster| cluster.numbers.len() > 1)
            .map(|cluster| {
                let name = cluster.name();
                let target = cluster.target().number;
                format!("positions in {name} are projected into zone {target}")
            })
            .collect();
        if self.are_apart() {
            let names: Vec<String> = self.0.iter().map(Cluster::name).collect();
            notes.push(format!(
                "images of different regions are never positives: {}",
                names.join(", ")
            ));
        }
        notes
    }

    fn cluster(&self, zone: UtmZone) -> Option<&Cluster> {
        self.0.iter().find(|cluster| {
            cluster.north == is_north(zone) && cluster.numbers.contains(&zone.number)
        })
    }
}

impl Cluster {
    fn target(&self) -> UtmZone {
        let band = if self.north { 'N' } else { 'M' };
        UtmZone {
            number: self.numbers[self.numbers.len() / 2],
            band,
        }
    }

    fn name(&self) -> String {
        let side = if self.north { "north" } else { "south" };
        match self.numbers.as_slice() {
            [only] => format!("zone {only} {side}"),
            all => format!("zones {}-{} {side}", all[0], all[all.len() - 1]),
        }
    }
}

fn is_north(zone: UtmZone) -> bool {
    zone.band >= 'N'
}

/// Ascending numbers as runs of neighbours; 60 and 1 are neighbours.
fn runs(mut numbers: Vec<u8>) -> Vec<Vec<u8>> {
    let after = |number: u8| number % ZONES + 1;
    let starts_a_run = |number: &u8| !numbers.iter().any(|&other| after(other) == *number);
    if let Some(start) = numbers.iter().position(starts_a_run) {
        numbers.rotate_left(start);
    }
    numbers
        .chunk_by(|&west, &east| after(west) == east)
        .map(<[u8]>::to_vec)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn zone(text: &str) -> UtmZone {
        text.parse().unwrap()
    }

    #[test]
    fn runs_wrap_around_the_globe() {
        assert_eq!(runs(vec![1, 2, 10, 59, 60]), [vec![10], vec![59, 60, 1, 2]]);
        assert_eq!(runs((1..=60).collect()), [(1..=60).collect::<Vec<u8>>()]);
        assert!(runs(vec![]).is_empty());
    }

    #[test]
    fn far_zones_and_hemispheres_stay_apart() {
        let zones = Zones::of([zone("33U"), zone("10S"), zone("33V"), zone("33H")]);
        let group = |text: &str| zones.group(zone(text));
        assert_eq!(group("33U"), group("33V"));
        assert_eq!(group("33U").as_deref(), Some("zone 33 north"));
        assert_eq!(group("33H").as_deref(), Some("zone 33 south"));
        assert_eq!(group("10S").as_deref(), Some("zone 10 north"));
        assert!(zones.are_apart() && zones.notes().len() == 1);
    }

    #[test]
    fn one_cluster_needs_no_group_and_a_long_run_is_cut() {
        let one = Zones::of([zone("31U"), zone("32U")]);
        assert_eq!((one.group(zone("31U")), one.notes().len()), (None, 1));
        let long = Zones::of(["29T", "30T", "31T", "32T"].map(zone));
        assert_eq!(
            long.group(zone("30T")).as_deref(),
            Some("zones 29-31 north")
        );
        assert_eq!(long.group(zone("32T")).as_deref(), Some("zone 32 north"));
    }

    #[test]
    fn the_date_line_is_no_border() {
        let zones = Zones::of([zone("60K"), zone("1K")]);
        let place = |text: &str, lon: f64| {
            let zone = zone(text);
            zones
                .project(zone, zone.from_geo(GeoPoint::new(-18.0, lon).unwrap()))
                .unwrap()
        };
        let west = place("60K", 179.9999);
        let east = place("1K", -179.9999);
        let metres = (west.east - east.east).hypot(west.north - east.north);
        // 0.0002 degrees of longitude at 18 degrees south.
        assert!((metres - 21.2).abs() < 0.5, "{metres}");
    }

    proptest! {
        #[test]
        fn distances_survive_the_projection(
            lat in -79.0f64..79.0, lon in -179.0f64..179.0, north in -40.0f64..40.0, east in -40.0f64..40.0,
            neighbours in prop::collection::btree_set(0u8..3, 1..3),
        ) {
            let point = GeoPoint::new(lat, lon).unwrap();
            let own = UtmZone::of(point).unwrap();
            let next = |by: u8| UtmZone { number: (own.number + 58 + by) % 60 + 1, band: own.band };
            let zones = Zones::of(neighbours.into_iter().map(next).chain([own]));
            let a = own.from_geo(point);
            let b = MetricPoint { east: a.east + east, north: a.north + north };
            let p = zones.project(own, a).unwrap();
            let q = zones.project(own, b).unwrap();
            let projected = (p.east - q.east).hypot(p.north - q.north);
            prop_assert!((projected - east.hypot(north)).abs() <= 0.02 * east.hypot(north) + 0.05, "{projected}");
        }
    }
}

//! Which images show a query's place, and which may serve as its negatives (paper III-F: 10 m and
//! 25 m).

use super::error::TrainError;
use super::spots::{Reach, Relation, Spot, Spots};
use crate::datasets::{Dataset, Item, NeighbourGrid};
use placeformer_core::geography::MetricPoint;
use placeformer_core::types::ContentHash;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// One side of a triplet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Side {
    /// A query image.
    Query,
    /// A database image: a positive or a negative.
    Database,
}

/// The images to learn from and their relations, computed once.
#[derive(Debug, Clone, PartialEq)]
pub struct TripletSet {
    /// Query images.
    pub queries: Vec<PathBuf>,
    /// Database images.
    pub database: Vec<PathBuf>,
    /// For each query, the database images that show its place, ascending.
    pub positives: Vec<Vec<u32>>,
    /// For each query, the database images too near to serve as negatives, ascending; includes the
    /// positives.
    pub near: Vec<Vec<u32>>,
    /// Where all images were taken, from which any two can be related.
    pub spots: Spots,
}

impl TripletSet {
    /// Relations by position: positives within `reach.positive` metres that look the same way,
    /// negatives beyond `reach.negative`.
    ///
    /// Images without a position are left out.
    ///
    /// # Errors
    /// The distances are out of order, or no query has both a positive and a negative.
    pub fn by_position(dataset: &Dataset, reach: Reach) -> Result<Self, TrainError> {
        let Reach {
            positive, negative, ..
        } = reach;
        if !(positive > 0.0 && positive <= negative && negative.is_finite()) {
            return Err(TrainError::Setting(format!(
                "positives within {positive} m and negatives beyond {negative} m \
                 leave no order between them"
            )));
        }
        let areas = Areas::of(dataset);
        let queries = areas.located(&dataset.queries);
        let database = areas.located(&dataset.database);
        let points = database.iter().map(|(_, spot)| MetricPoint {
            east: spot.east,
            north: spot.north,
        });
        let grid = NeighbourGrid::new(negative, points.enumerate());
        let around = |query: &Spot, least: Relation| -> Vec<u32> {
            let point = MetricPoint {
                east: query.east,
                north: query.north,
            };
            let is_related = |&index: &usize| {
                let other = &database[index].1;
                // Coordinates of two cities may coincide.
                let relation = reach.relation(query, other);
                let is_near = relation == Relation::Positive || relation == least;
                other.area == query.area && is_near
            };
            let mut found: Vec<u32> = grid
                .within(point)
                .filter(is_related)
                .map(|index| index as u32)
                .collect();
            found.sort_unstable();
            found
        };
        let rows = |least: Relation| -> Vec<Vec<u32>> {
            let of_query = |(_, spot): &(&Item, Spot)| around(spot, least);
            queries.iter().map(of_query).collect()
        };
        let positives = rows(Relation::Positive);
        let near = rows(Relation::Ignored);
        let paths =
            |items: &[(&Item, Spot)]| items.iter().map(|item| item.0.path.clone()).collect();
        let spots = |items: &[(&Item, Spot)]| items.iter().map(|item| item.1).collect();
        Self {
            queries: paths(&queries),
            database: paths(&database),
            positives,
            near,
            spots: Spots {
                queries: spots(&queries),
                database: spots(&database),
                areas: vec![reach; areas.count()],
            },
        }
        .checked()
    }

    /// Relations by order, for drives whose frames carry no position: a frame's neighbours up to
    /// `positive_frames` away show its place, frames of its drive more than `negative_frames` away
    /// or of another drive do not.
    ///
    /// # Errors
    /// The distances are out of order, or no query has both a positive and a negative.
    pub fn by_order(
        drives: &[Vec<PathBuf>],
        positive_frames: usize,
        negative_frames: usize,
    ) -> Result<Self, TrainError> {
        if positive_frames == 0 || positive_frames > negative_frames {
            return Err(TrainError::Setting(format!(
                "positives within {positive_frames} frames and negatives beyond \
                 {negative_frames} leave no order between them"
            )));
        }
        let images: Vec<PathBuf> = drives.iter().flatten().cloned().collect();
        let mut positives = Vec::new();
        let mut near = Vec::new();
        let mut spots = Vec::new();
        let mut first = 0;
        for (area, drive) in drives.iter().enumerate() {
            for frame in 0..drive.len() {
                let around = |reach: usize| {
                    let range = frame.saturating_sub(reach)..(frame + reach + 1).min(drive.len());
                    range.map(move |other| (first + other) as u32)
                };
                // A frame is not its own positive, but it is too near to be a negative.
                positives.push(
                    around(positive_frames)
                        .filter(|&other| other as usize != first + frame)
                        .collect(),
                );
                near.push(around(negative_frames).collect());
                spots.push(Spot {
                    area: area as u32,
                    east: frame as f64,
                    north: 0.0,
                    heading: None,
                });
            }
            first += drive.len();
        }
        let reach = Reach {
            positive: positive_frames as f64,
            degrees: None,
            negative: negative_frames as f64,
        };
        Self {
            queries: images.clone(),
            database: images,
            positives,
            near,
            spots: Spots {
                queries: spots.clone(),
                database: spots,
                areas: vec![reach; drives.len()],
            },
        }
        .checked()
    }

    /// All `sets` as one. Images of different sets are taken to show different places, so sets of
    /// one area must be read as one instead.
    ///
    /// # Errors
    /// There is no set.
    pub fn merge(sets: Vec<Self>) -> Result<Self, TrainError> {
        let mut all = Self {
            queries: vec![],
            database: vec![],
            positives: vec![],
            near: vec![],
            spots: Spots::default(),
        };
        for set in sets {
            let first = all.database.len() as u32;
            let shift = |rows: Vec<Vec<u32>>| {
                rows.into_iter()
                    .map(move |row| row.iter().map(|i| first + i).collect())
            };
            all.positives.extend(shift(set.positives));
            all.near.extend(shift(set.near));
            all.queries.extend(set.queries);
            all.database.extend(set.database);
            all.spots.append(set.spots);
        }
        all.checked()
    }

    /// SHA-256 over images and relations, hexadecimal: two runs with the same one learn from the
    /// same data.
    pub fn fingerprint(&self) -> String {
        let mut bytes = Vec::new();
        for paths in [&self.queries, &self.database] {
            bytes.extend((paths.len() as u64).to_le_bytes());
            for path in paths {
                bytes.extend(path.as_os_str().as_encoded_bytes());
                bytes.push(0);
            }
        }
        for row in self.positives.iter().chain(&self.near) {
            bytes.extend((row.len() as u32).to_le_bytes());
            for index in row {
                bytes.extend(index.to_le_bytes());
            }
        }
        self.spots.write_to(&mut bytes);
        ContentHash::of(&bytes).to_string()
    }

    /// The queries that have a positive and at least one possible negative.
    pub fn usable(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.queries.len()).filter(|&query| {
            !self.positives[query].is_empty() && self.near[query].len() < self.database.len()
        })
    }

    /// The images of one side.
    pub fn images(&self, side: Side) -> &[PathBuf] {
        match side {
            Side::Query => &self.queries,
            Side::Database => &self.database,
        }
    }

    fn checked(self) -> Result<Self, TrainError> {
        if self.usable().next().is_none() {
            return Err(TrainError::NoTriplets(format!(
                "of {} queries and {} database images, no query has both a positive and a negative",
                self.queries.len(),
                self.database.len()
            )));
        }
        Ok(self)
    }
}

/// The cities of a data set, whose coordinates may coincide.
struct Areas<'a>(BTreeMap<Option<&'a str>, u32>);

impl<'a> Areas<'a> {
    fn of(dataset: &'a Dataset) -> Self {
        let both_sides = dataset.queries.iter().chain(&dataset.database);
        let groups: BTreeSet<Option<&str>> = both_sides.map(|item| item.group.as_deref()).collect();
        Self(groups.into_iter().zip(0..).collect())
    }

    fn count(&self) -> usize {
        self.0.len()
    }

    /// The items with a position, each with its spot.
    fn located<'i>(&self, items: &'i [Item]) -> Vec<(&'i Item, Spot)> {
        let locate = |item: &'i Item| {
            let point = item.position?;
            let spot = Spot {
                area: *self.0.get(&item.group.as_deref())?,
                east: point.east,
                north: point.north,
                heading: item.heading,
            };
            Some((item, spot))
        };
        items.iter().filter_map(locate).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::datasets::Truth;

    const PAPER: Reach = Reach {
        positive: 10.0,
        degrees: None,
        negative: 25.0,
    };

    fn at(name: &str, east: f64) -> Item {
        Item {
            position: Some(MetricPoint { east, north: 0.0 }),
            ..Item::new(name, name)
        }
    }

    fn dataset(database: Vec<Item>, queries: Vec<Item>) -> Dataset {
        let truth = vec![Truth::Unknown; queries.len()];
        Dataset {
            name: "line".into(),
            database,
            queries,
            truth,
            skipped: vec![],
            notes: vec![],
        }
    }

    #[test]
    fn between_ten_and_twenty_five_metres_an_image_is_neither() {
        let database = vec![
            at("d0", 0.0),
            at("d10", 10.0),
            at("d11", 11.0),
            at("d25", 25.0),
            at("d26", 26.0),
        ];
        let set = TripletSet::by_position(&dataset(database, vec![at("q", 0.0)]), PAPER).unwrap();
        assert_eq!(set.positives, [[0, 1]]);
        assert_eq!(set.near, [[0, 1, 2, 3]]);
    }

    #[test]
    fn an_image_that_looks_elsewhere_is_no_positive_and_no_negative() {
        let looking = |item: Item, heading: f64| Item {
            heading: Some(heading),
            ..item
        };
        let database = vec![
            looking(at("same", 5.0), 20.0),
            looking(at("back", 5.0), 180.0),
            at("unknown", 5.0),
            looking(at("far", 26.0), 0.0),
        ];
        let reach = Reach {
            degrees: Some(40.0),
            ..PAPER
        };
        let queries = vec![looking(at("q", 0.0), 350.0)];
        let set = TripletSet::by_position(&dataset(database, queries), reach).unwrap();
        assert_eq!(set.positives, [[0, 2]]);
        assert_eq!(set.near, [[0, 1, 2]]);
        for index in 0..4 {
            let relation = set
                .spots
                .relation((Side::Query, 0), (Side::Database, index));
            assert_eq!(
                set.positives[0].contains(&index),
                relation == Relation::Positive
            );
            assert_eq!(set.near[0].contains(&index), relation != Relation::Negative);
        }
    }

    #[test]
    fn images_without_a_position_are_left_out_and_nothing_to_learn_is_an_error() {
        let database = vec![Item::new("lost", "lost"), at("far", 1000.0)];
        let error =
            TripletSet::by_position(&dataset(database, vec![at("q", 0.0)]), PAPER).unwrap_err();
        assert!(matches!(error, TrainError::NoTriplets(_)), "{error}");
    }

    #[test]
    fn another_city_is_never_near_whatever_its_coordinates() {
        let city = |item: Item, name: &str| Item {
            group: Some(name.into()),
            ..item
        };
        let database = vec![city(at("a", 0.0), "x"), city(at("b", 0.0), "y")];
        let set = TripletSet::by_position(&dataset(database, vec![city(at("q", 1.0), "y")]), PAPER)
            .unwrap();
        assert_eq!(
            (&set.positives, &set.near),
            (&vec![vec![1]], &vec![vec![1]])
        );
    }

    #[test]
    fn merged_sets_keep_their_relations_and_are_negatives_of_each_other() {
        let drive = |name: &str| {
            (0..5)
                .map(|i| PathBuf::from(format!("{name}/{i}")))
                .collect::<Vec<_>>()
        };
        let set = |name: &str| TripletSet::by_order(&[drive(name)], 1, 2).unwrap();
        let merged = TripletSet::merge(vec![set("a"), set("b")]).unwrap();
        assert_eq!(
            merged,
            TripletSet::by_order(&[drive("a"), drive("b")], 1, 2).unwrap()
        );
        assert_eq!(merged.fingerprint(), merged.clone().fingerprint());
        assert_ne!(merged.fingerprint(), set("a").fingerprint());
        assert!(TripletSet::merge(vec![]).is_err());
    }

    #[test]
    fn frames_of_another_drive_are_negatives() {
        let drive = |name: &str| {
            (0..5)
                .map(|i| PathBuf::from(format!("{name}/{i}")))
                .collect::<Vec<_>>()
        };
        let set = TripletSet::by_order(&[drive("a"), drive("b")], 1, 2).unwrap();
        assert_eq!(set.positives[5], [6]);
        assert_eq!(set.positives[2], [1, 3]);
        assert_eq!(set.near[4], [2, 3, 4]);
        assert_eq!(set.usable().count(), 10);
        for query in 0..10 {
            for other in 0..10 {
                let relation = set
                    .spots
                    .relation((Side::Query, query), (Side::Database, other));
                let is_near = set.near[query as usize].contains(&other);
                assert_eq!(is_near, relation != Relation::Negative);
            }
        }
    }
}

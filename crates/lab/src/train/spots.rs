//! Where images were taken, and so which two of them show one place.
//!
//! Triplets relate a query to database images. A loss over a whole batch asks the same of any two
//! images: do they show one place, do they not, or is that unsure? Images of one place that look in
//! different directions share nothing to see, and those a little farther apart may or may not; both
//! kinds are left out of the loss.

use super::triplets::Side;
use crate::datasets::angle_between;

/// What two images are to each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Relation {
    /// They show one place.
    Positive,
    /// Too near to be a negative, and no positive.
    Ignored,
    /// They show different places.
    Negative,
}

/// How near images of an area must be to show one place. The unit is metres, or frames of a drive
/// without positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    /// Greatest distance of a positive.
    pub positive: f64,
    /// Greatest difference of headings of a positive in degrees, where both are known; `None` is no
    /// rule.
    pub degrees: Option<f64>,
    /// Distance beyond which an image is a negative.
    pub negative: f64,
}

/// Where an image was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// Index of its area. Images of different areas show different places: the coordinates of two
    /// cities may coincide.
    pub area: u32,
    /// Position along the first axis of the area.
    pub east: f64,
    /// Position along the second axis.
    pub north: f64,
    /// Where the camera looked, in degrees, if known.
    pub heading: Option<f64>,
}

impl Reach {
    /// What two images of one area are to each other.
    pub fn relation(&self, a: &Spot, b: &Spot) -> Relation {
        let distance = (a.east - b.east).hypot(a.north - b.north);
        let same_view = match (self.degrees, a.heading, b.heading) {
            (Some(limit), Some(a), Some(b)) => angle_between(a, b) <= limit,
            _ => true,
        };
        if distance <= self.positive && same_view {
            Relation::Positive
        } else if distance <= self.negative {
            Relation::Ignored
        } else {
            Relation::Negative
        }
    }
}

/// The spots of all images of a set.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Spots {
    /// Of the queries.
    pub queries: Vec<Spot>,
    /// Of the database.
    pub database: Vec<Spot>,
    /// The reach within each area.
    pub areas: Vec<Reach>,
}

impl Spots {
    /// What two images are to each other.
    ///
    /// # Panics
    /// If the set has no such image.
    pub fn relation(&self, a: (Side, u32), b: (Side, u32)) -> Relation {
        let a = self.of(a);
        let b = self.of(b);
        if a.area == b.area {
            self.areas[a.area as usize].relation(a, b)
        } else {
            Relation::Negative
        }
    }

    fn of(&self, (side, index): (Side, u32)) -> &Spot {
        let spots = match side {
            Side::Query => &self.queries,
            Side::Database => &self.database,
        };
        &spots[index as usize]
    }

    /// Adds the spots of another set, whose areas are others.
    pub(super) fn append(&mut self, other: Self) {
        let first = self.areas.len() as u32;
        let shift = |spot: Spot| Spot {
            area: first + spot.area,
            ..spot
        };
        self.queries.extend(other.queries.into_iter().map(shift));
        self.database.extend(other.database.into_iter().map(shift));
        self.areas.extend(other.areas);
    }

    /// Adds everything that relations follow from, for a fingerprint.
    pub(super) fn write_to(&self, bytes: &mut Vec<u8>) {
        let number = |bytes: &mut Vec<u8>, value: f64| bytes.extend(value.to_le_bytes());
        for reach in &self.areas {
            number(bytes, reach.positive);
            number(bytes, reach.degrees.unwrap_or(-1.0));
            number(bytes, reach.negative);
        }
        for spot in self.queries.iter().chain(&self.database) {
            bytes.extend(spot.area.to_le_bytes());
            number(bytes, spot.east);
            number(bytes, spot.north);
            number(bytes, spot.heading.unwrap_or(-1.0));
        }
    }
}

/// Spots of images on both sides, of which `size` that follow each other show one place.
#[cfg(test)]
pub(super) fn in_groups(count: usize, size: usize) -> Spots {
    let spots: Vec<Spot> = (0..count)
        .map(|image| Spot {
            area: 0,
            east: 1000.0 * (image / size) as f64,
            north: 0.0,
            heading: None,
        })
        .collect();
    Spots {
        queries: spots.clone(),
        database: spots,
        areas: vec![Reach {
            positive: 1.0,
            degrees: None,
            negative: 100.0,
        }],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spot(area: u32, east: f64, heading: Option<f64>) -> Spot {
        Spot {
            area,
            east,
            north: 0.0,
            heading,
        }
    }

    #[test]
    fn distance_and_heading_decide_and_areas_are_apart() {
        let reach = Reach {
            positive: 15.0,
            degrees: Some(40.0),
            negative: 40.0,
        };
        let mut spots = Spots {
            queries: vec![spot(0, 0.0, Some(350.0))],
            database: vec![
                spot(0, 15.0, Some(30.0)),
                spot(0, 15.0, Some(31.0)),
                spot(0, 15.0, None),
                spot(0, 15.1, Some(350.0)),
                spot(0, 40.1, Some(350.0)),
            ],
            areas: vec![reach],
        };
        let relation =
            |spots: &Spots, index| spots.relation((Side::Query, 0), (Side::Database, index));
        let relations: Vec<Relation> = (0..5).map(|index| relation(&spots, index)).collect();
        assert_eq!(
            relations,
            [
                Relation::Positive,
                Relation::Ignored,
                Relation::Positive,
                Relation::Ignored,
                Relation::Negative
            ]
        );
        spots.append(spots.clone());
        assert_eq!(relation(&spots, 5), Relation::Negative);
        assert_eq!(
            spots.relation((Side::Query, 1), (Side::Database, 5)),
            Relation::Positive
        );
    }
}

//! What every reader answers with: the images of both sides, and the truth about each query.

use super::error::DatasetError;
use super::pose::Pose;
use placeformer_core::geography::MetricPoint;
use std::path::{Path, PathBuf};

/// One image of a data set.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// Unique on its side of the data set: the path below the image folder, with `/`, or the data
    /// set's own key.
    pub name: String,
    /// The file.
    pub path: PathBuf,
    /// Where it was taken, if known.
    pub position: Option<MetricPoint>,
    /// Where the camera looked, in degrees clockwise from north, if known.
    pub heading: Option<f64>,
    /// Camera pose, where the data set gives it (RobotCar Seasons).
    pub pose: Option<Pose>,
    /// The part of the data set it belongs to: a city, a condition.
    pub group: Option<String>,
}

impl Item {
    /// An image of which only the file is known.
    pub fn new(name: impl Into<String>, path: impl Into<PathBuf>) -> Self {
        Self {
            name: name.into(),
            path: path.into(),
            position: None,
            heading: None,
            pose: None,
            group: None,
        }
    }
}

/// What is known about the right answer to a query.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Truth {
    /// Indices into the database, ascending, at least one.
    Positives(Vec<usize>),
    /// The database does not show this place.
    NoMatch,
    /// The data set withholds the answer, or nobody labelled this query.
    Unknown,
}

impl Truth {
    /// Positives if there are any, else the knowledge that none exists.
    pub fn from_positives(mut positives: Vec<usize>) -> Self {
        positives.sort_unstable();
        positives.dedup();
        if positives.is_empty() {
            Self::NoMatch
        } else {
            Self::Positives(positives)
        }
    }

    /// The positives; empty unless a match exists and is known.
    pub fn positives(&self) -> &[usize] {
        match self {
            Self::Positives(positives) => positives,
            Self::NoMatch | Self::Unknown => &[],
        }
    }
}

/// An image a reader left out.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Skipped {
    /// Its name.
    pub name: String,
    /// Why.
    pub reason: String,
}

/// A data set ready to be evaluated.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// What to call it in reports.
    pub name: String,
    /// The images searched.
    pub database: Vec<Item>,
    /// The images asked.
    pub queries: Vec<Item>,
    /// One for each query.
    pub truth: Vec<Truth>,
    /// Images left out, and why.
    pub skipped: Vec<Skipped>,
    /// What a reader of the results should know about how the data was read.
    pub notes: Vec<String>,
}

impl Dataset {
    /// Refuses a data set with an empty side; checks that every query has its truth.
    pub(super) fn checked(self, root: &Path) -> Result<Self, DatasetError> {
        debug_assert_eq!(self.queries.len(), self.truth.len());
        for (side, items) in [("database", &self.database), ("query", &self.queries)] {
            if items.is_empty() {
                let detail = match self.skipped.first() {
                    Some(first) => {
                        format!(
                            "; {} were skipped, first {}: {}",
                            self.skipped.len(),
                            first.name,
                            first.reason
                        )
                    }
                    None => String::new(),
                };
                return Err(DatasetError::Empty {
                    dataset: self.name,
                    side,
                    path: root.to_owned(),
                    detail,
                });
            }
        }
        Ok(self)
    }

    /// How many queries have at least one known positive.
    pub fn queries_with_match(&self) -> usize {
        self.truth
            .iter()
            .filter(|truth| matches!(truth, Truth::Positives(_)))
            .count()
    }
}

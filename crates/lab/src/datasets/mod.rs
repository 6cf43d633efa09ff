//! Reads the data sets of the field in the layouts in which people have them.
//!
//! Every reader answers with the same [`Dataset`]: the images of both sides, and for each query its
//! [`Truth`]. What a reader leaves out (panoramas, rows without a position) it lists in `skipped`;
//! what it had to decide it says in `notes`; nothing is dropped in silence.

mod error;
mod layout;
mod msls;
mod neighbours;
mod nordland;
mod pairs;
mod positions;
mod robotcar;
mod table;
mod utm;
mod zones;

pub use error::DatasetError;
pub use neighbours::NeighbourGrid;
pub use pairs::load_pairs;
pub use robotcar::Pose;

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
    fn checked(self, root: &Path) -> Result<Self, DatasetError> {
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

/// The data sets that can be read by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum DatasetKind {
    /// Mapillary Street-Level Sequences, validation cities.
    MslsVal,
    /// Mapillary Street-Level Sequences, test cities: answers are withheld.
    MslsTest,
    /// Pittsburgh 30k as the common downloader formats it.
    #[value(name = "pitts30k")]
    Pitts30k,
    /// Nordland: summer as the database, winter as the queries, matched by frame.
    Nordland,
    /// Tokyo 24/7 as the common downloader formats it.
    #[value(name = "tokyo247")]
    Tokyo247,
    /// RobotCar Seasons v2: poses of the best match.
    RobotcarSeasonsV2,
    /// Any set with `@utm_east@utm_north@...` names.
    Utm,
    /// `database/`, `queries/` and `ground_truth.csv` below the root; positions from
    /// `positions.csv` if it is there.
    Csv,
}

/// The part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Split {
    /// Training images.
    Train,
    /// Validation images.
    Val,
    /// Test images.
    Test,
}

impl Split {
    /// The folder's name.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Val => "val",
            Self::Test => "test",
        }
    }
}

/// How a data set is to be read. `None` is the data set's own default.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetOptions {
    /// Which part; the default is `test`, except `val` for MSLS and `train` for RobotCar, whose
    /// poses there are public.
    pub split: Option<Split>,
    /// Greatest distance of a positive in metres (paper IV: 25).
    pub radius_m: f64,
    /// Greatest difference of view angles of a positive in degrees; the default is 40 for MSLS,
    /// else no rule.
    pub max_angle_deg: Option<f64>,
    /// Greatest frame distance of a positive (Nordland).
    pub frame_tolerance: u64,
    /// Only these cities (MSLS); empty means the split's own.
    pub cities: Vec<String>,
    /// Exchange the two seasons: winter as the database, summer as the queries (Nordland).
    pub swap: bool,
    /// The column of `subtask_index.csv` (MSLS): all, s2w, w2s, o2n, n2o, d2n, n2d.
    pub subtask: String,
}

impl Default for DatasetOptions {
    fn default() -> Self {
        Self {
            split: None,
            radius_m: 25.0,
            max_angle_deg: None,
            frame_tolerance: 10,
            swap: false,
            cities: Vec::new(),
            subtask: "all".into(),
        }
    }
}

impl DatasetOptions {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The radius or the view angle is.
    pub fn check(&self) -> Result<(), DatasetError> {
        if !(self.radius_m.is_finite() && self.radius_m > 0.0) {
            return Err(DatasetError::Setting(format!(
                "the radius must be a positive number of metres, not {}",
                self.radius_m
            )));
        }
        match self.max_angle_deg {
            Some(angle) if !(0.0..=180.0).contains(&angle) => Err(DatasetError::Setting(format!(
                "the view angle must be 0 to 180 degrees, not {angle}"
            ))),
            _ => Ok(()),
        }
    }
}

/// Reads a data set.
pub fn load(
    kind: DatasetKind,
    root: &Path,
    options: &DatasetOptions,
) -> Result<Dataset, DatasetError> {
    options.check()?;
    let dataset = match kind {
        DatasetKind::MslsVal => msls::load_labelled(root, options)?,
        DatasetKind::MslsTest => msls::load_test(root, options)?,
        DatasetKind::Pitts30k => utm::load("pitts30k", root, options)?,
        DatasetKind::Tokyo247 => utm::load("tokyo247", root, options)?,
        DatasetKind::Utm => utm::load("utm", root, options)?,
        DatasetKind::Nordland => nordland::load(root, options)?,
        DatasetKind::RobotcarSeasonsV2 => robotcar::load(root, options)?,
        DatasetKind::Csv => {
            return load_pairs(
                &root.join("database"),
                &root.join("queries"),
                &root.join("ground_truth.csv"),
            );
        }
    };
    dataset.checked(root)
}

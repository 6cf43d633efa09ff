//! Names of the data sets that can be read, and of their parts.

use crate::choice::Choice;

/// The data sets that can be read by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DatasetKind {
    /// Mapillary Street-Level Sequences, validation cities.
    MslsVal,
    /// Mapillary Street-Level Sequences, test cities: answers are withheld.
    MslsTest,
    /// Pittsburgh 30k as the common downloader formats it.
    Pitts30k,
    /// Nordland: summer as the database, winter as the queries, matched by frame.
    Nordland,
    /// Tokyo 24/7 as the common downloader formats it.
    Tokyo247,
    /// RobotCar Seasons v2: poses of the best match.
    RobotcarSeasonsV2,
    /// Any set with `@utm_east@utm_north@...` names.
    Utm,
    /// `database/`, `queries/` and `ground_truth.csv` below the root; positions from
    /// `positions.csv` if it is there.
    Csv,
}

impl Choice for DatasetKind {
    const ALL: &'static [Self] = &[
        Self::MslsVal,
        Self::MslsTest,
        Self::Pitts30k,
        Self::Nordland,
        Self::Tokyo247,
        Self::RobotcarSeasonsV2,
        Self::Utm,
        Self::Csv,
    ];

    fn as_str(self) -> &'static str {
        match self {
            Self::MslsVal => "msls-val",
            Self::MslsTest => "msls-test",
            Self::Pitts30k => "pitts30k",
            Self::Nordland => "nordland",
            Self::Tokyo247 => "tokyo247",
            Self::RobotcarSeasonsV2 => "robotcar-seasons-v2",
            Self::Utm => "utm",
            Self::Csv => "csv",
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::MslsVal => "Mapillary Street-Level Sequences, validation cities",
            Self::MslsTest => "Mapillary Street-Level Sequences, test cities: answers are withheld",
            Self::Pitts30k => "Pittsburgh 30k as the common downloader formats it",
            Self::Nordland => {
                "Nordland: summer as the database, winter as the queries, matched by frame"
            }
            Self::Tokyo247 => "Tokyo 24/7 as the common downloader formats it",
            Self::RobotcarSeasonsV2 => "RobotCar Seasons v2: poses of the best match",
            Self::Utm => "Any set with `@utm_east@utm_north@...` names",
            Self::Csv => {
                "`database/`, `queries/` and `ground_truth.csv` below the root; positions from \
                 `positions.csv` if it is there"
            }
        }
    }
}

/// The part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// Training images.
    Train,
    /// Validation images.
    Val,
    /// Test images.
    Test,
}

impl Choice for Split {
    const ALL: &'static [Self] = &[Self::Train, Self::Val, Self::Test];

    /// The name of the split, which is also the name of its folder.
    fn as_str(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Val => "val",
            Self::Test => "test",
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::Train => "Training images",
            Self::Val => "Validation images",
            Self::Test => "Test images",
        }
    }
}

//! Flags that say how data sets are read, for the subcommands that read them.

use super::choice::choice;
use placeformer_lab::datasets::{DatasetOptions, Split};

/// What is taken of a data set in the layout in which it is distributed.
#[derive(Debug, Clone, clap::Args)]
pub struct ReadArgs {
    /// Part of the data set [default: train for training; for evaluation test, val for MSLS, train
    /// for RobotCar, whose test poses are withheld].
    #[arg(long, value_parser = choice::<Split>())]
    pub split: Option<Split>,
    /// Only these cities (MSLS).
    #[arg(long, value_delimiter = ',', value_name = "CITY,...")]
    pub cities: Vec<String>,
    /// Task of MSLS: all, s2w, w2s, o2n, n2o, d2n, n2d.
    #[arg(long, default_value = "all")]
    pub subtask: String,
}

impl ReadArgs {
    /// The reader's options; what is not here is the reader's own default.
    pub fn options(&self) -> DatasetOptions {
        DatasetOptions {
            split: self.split,
            cities: self.cities.clone(),
            subtask: self.subtask.clone(),
            ..DatasetOptions::default()
        }
    }
}

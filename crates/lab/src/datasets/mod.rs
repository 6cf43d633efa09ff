//! Reads the data sets of the field in the layouts in which people have them.
//!
//! Every reader answers with the same [`Dataset`]: the images of both sides, and for each query its
//! [`Truth`]. What a reader leaves out (panoramas, rows without a position) it lists in `skipped`;
//! what it had to decide it says in `notes`; nothing is dropped in silence.
//!
//! | module | holds |
//! |---|---|
//! | `dataset`, `pose` | what every reader answers with |
//! | `kind`, `options` | which data set to read, and how |
//! | `msls`, `nordland`, `pairs`, `robotcar`, `utm` | the readers |
//! | `ground` | parts that share no place |
//! | `quarter` | a part of the ground that is held out |
//! | `layout`, `table`, `positions`, `zones`, `neighbours` | what several readers need |

mod dataset;
mod error;
mod ground;
mod kind;
mod layout;
mod msls;
mod neighbours;
mod nordland;
mod options;
mod pairs;
mod pose;
mod positions;
mod quarter;
mod robotcar;
mod table;
mod utm;
mod zones;

pub use dataset::{Dataset, Item, Skipped, Truth};
pub use error::DatasetError;
pub use ground::{GroundPart, GroundSplit};
pub use kind::{DatasetKind, Split};
pub use neighbours::{NeighbourGrid, angle_between};
pub use options::DatasetOptions;
pub use pairs::load_pairs;
pub use pose::Pose;
pub use quarter::{Parted, Quarter};

use std::path::Path;

/// Reads the data set `kind` that lies at `root`.
///
/// # Errors
/// An option is out of range, the folder does not have the layout of that data set, a file cannot
/// be read, or one side has no image.
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

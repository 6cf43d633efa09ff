//! What can go wrong while a data set is read, each with the file and the cause.

use placeformer_core::folder::FolderError;
use std::path::{Path, PathBuf};

/// Why a data set could not be read.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A file or folder could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The folder does not have the layout of the data set named.
    #[error("{dataset}: {} is missing; expected {expected}", path.display())]
    Layout {
        /// Name of the data set.
        dataset: &'static str,
        /// The missing file or folder.
        path: PathBuf,
        /// What the layout should look like.
        expected: &'static str,
    },
    /// A line of a metadata file makes no sense.
    #[error("{}, line {line}: {reason}", path.display())]
    Record {
        /// The file.
        path: PathBuf,
        /// 1-based line.
        line: u64,
        /// What is wrong.
        reason: String,
    },
    /// The ground truth speaks of images that are not in the folders.
    #[error(
        "{}: {count} image names are not in {}, among them {example:?}",
        path.display(),
        folder.display()
    )]
    UnknownImages {
        /// The ground-truth file.
        path: PathBuf,
        /// The folder that should hold them.
        folder: PathBuf,
        /// How many names.
        count: usize,
        /// One of them.
        example: String,
    },
    /// Nothing to search in, or nothing to ask.
    #[error("{dataset}: no usable {side} image in {}{detail}", path.display())]
    Empty {
        /// Name of the data set.
        dataset: String,
        /// `database` or `query`.
        side: &'static str,
        /// Where they should be.
        path: PathBuf,
        /// What else is known, such as how many were skipped and why.
        detail: String,
    },
    /// A setting is out of range or does not go with another.
    #[error("{0}")]
    Setting(String),
}

impl From<FolderError> for DatasetError {
    fn from(error: FolderError) -> Self {
        Self::Io {
            path: error.path,
            source: error.source,
        }
    }
}

impl DatasetError {
    /// Attaches a path to a system error, for `map_err`.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Self::Io { path, source }
    }
}

//! Checks that a data set lies on disk as its reader expects.

use super::error::DatasetError;
use std::path::PathBuf;

/// The folder, or an error that says what the layout should be.
pub(super) fn require(
    dataset: &'static str,
    path: PathBuf,
    expected: &'static str,
) -> Result<PathBuf, DatasetError> {
    if path.exists() {
        Ok(path)
    } else {
        Err(DatasetError::Layout {
            dataset,
            path,
            expected,
        })
    }
}

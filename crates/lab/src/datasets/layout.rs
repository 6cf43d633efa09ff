//! Checks that a data set lies on disk as its reader expects.

use crate::eval::EvalError;
use std::path::PathBuf;

/// The folder, or an error that says what the layout should be.
pub(super) fn require(
    dataset: &'static str,
    path: PathBuf,
    expected: &'static str,
) -> Result<PathBuf, EvalError> {
    if path.exists() {
        Ok(path)
    } else {
        Err(EvalError::Layout {
            dataset,
            path,
            expected,
        })
    }
}

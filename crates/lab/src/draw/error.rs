//! Why a picture cannot be drawn.

use placeformer_core::types::ImageSize;
use placeformer_vision::image::ImageError;

/// Why a picture cannot be drawn.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DrawError {
    /// An attention map whose values do not fill its grid.
    #[error("{values} attention values do not fill a grid of {columns}x{rows}")]
    AttentionShape {
        /// Values given.
        values: usize,
        /// Columns of the grid.
        columns: usize,
        /// Rows of the grid.
        rows: usize,
    },
    /// An inlier names a patch that is not there.
    #[error("inlier names key patch {row}, but there are {patches}")]
    NoSuchPatch {
        /// The row named.
        row: u32,
        /// How many patches there are.
        patches: usize,
    },
    /// A picture without pixels, or larger than can be drawn.
    #[error("a picture of {0} cannot be drawn")]
    Size(ImageSize),
    /// Resizing or encoding failed.
    #[error(transparent)]
    Image(#[from] ImageError),
}

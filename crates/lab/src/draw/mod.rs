//! Pictures of matches: both images, attention, key patches, inlier lines.
//!
//! A score is a number; an operator who doubts it wants to see why. [`match_picture`] shows what
//! re-ranking saw, in rows: where both images draw attention and which key patches came of it, then
//! one row per scale combination with a line for every inlier. Everything is given as plain values,
//! so that drawing depends on no stage.

mod canvas;
mod error;
mod panels;
mod thumbnail;

pub use error::DrawError;
pub use panels::{AttentionMap, CombinationLines, DrawnSide, attention_picture, match_picture};
pub use thumbnail::{jpeg_data_uri, thumbnail};

//! What every part of PlaceFormer shares.
//!
//! | module | holds |
//! |---|---|
//! | [`types`] | the nouns: identifiers, locations, descriptors, references |
//! | [`error`] | the one table of error codes |
//! | [`files`] | files that are written whole or not at all, and their hashes |
//! | [`geography`] | UTM zones and the image names that carry UTM positions |
//! | [`folder`] | the images below a folder |
//! | [`progress`] | how far a long task has come |

pub mod error;
pub mod files;
pub mod folder;
pub mod geography;
pub mod progress;
pub mod types;

//! What every part of PlaceFormer shares.
//!
//! | module | holds |
//! |---|---|
//! | [`types`] | the nouns: identifiers, locations, descriptors, references |
//! | [`clock`] | times as people, cameras and tables write them |
//! | [`error`] | the one table of error codes |
//! | [`files`] | files that are written whole or not at all, and their hashes |
//! | [`geography`] | positions, headings, UTM zones, and image names that carry UTM positions |
//! | [`folder`] | the images below a folder, and what else is there |
//! | [`printable`] | text from elsewhere, made fit for a terminal |
//! | [`progress`] | how far a long task has come |
//! | [`retry`] | trying again what failed for a reason that may pass |
//!
//! Every other crate depends on this one and it depends on none of them. Nothing here decides how
//! the service behaves. Only [`files`] and [`folder`] touch the disk.

pub mod clock;
pub mod error;
pub mod files;
pub mod folder;
pub mod geography;
mod invalid;
pub mod printable;
pub mod progress;
pub mod retry;
pub mod types;

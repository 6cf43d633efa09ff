//! Recall on data sets: readers, measures, reports.
//!
//! [`datasets`](crate::datasets) turns the layouts people have into one shape; [`features`] describes every image
//! and keeps the result on disk; [`run`] searches and re-ranks as the service does; [`measure`]
//! holds the numbers as pure functions; [`summary`] gathers them into one value, which [`report`]
//! prints and draws. [`ablate`] repeats it along the axes of the paper's tables; [`calibrate`]
//! learns from the answers how far they can be trusted.

pub mod ablate;
pub mod calibrate;
mod error;
pub mod evidence;
pub mod features;
pub mod measure;
mod places;
pub mod prediction;
pub mod report;
pub mod run;
pub mod summary;

pub use error::EvalError;

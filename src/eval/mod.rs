//! Recall on data sets: readers, measures, reports.
//!
//! [`datasets`] turns the layouts people have into one shape; [`measure`] holds the numbers.
pub mod datasets;
mod error;
pub mod measure;

pub use error::EvalError;

//! Recall on data sets: measures and reports.
//!
//! | module | holds |
//! |---|---|
//! | [`features`] | descriptors of every image, kept on disk |
//! | [`run`] | search and re-ranking of every query, as the service does them |
//! | [`answers`] | both of these for a whole data set |
//! | [`own_places`] | what is left out of the database to make a query one without a match |
//! | [`sequences`] | the same with tracks: queries as the frames of a drive |
//! | [`measure`] | the numbers, as pure functions |
//! | [`summary`], [`mod@summarise`] | all numbers of a run as one value, and how it is made |
//! | [`learn`], [`score_table`] | scores of candidates that are learned, and what they are worth |
//! | [`calibrate`] | from answers to how far they can be trusted |
//! | [`mod@ablate`] | the same along the axes of the paper's tables |
//! | [`report`], [`evidence`] | text, pages, pictures |
//! | [`prediction`] | files that the public benchmarks accept |

pub mod ablate;
pub mod answers;
pub mod calibrate;
mod error;
pub mod evidence;
pub mod features;
pub mod learn;
pub mod measure;
pub mod own_places;
mod places;
pub mod prediction;
pub mod report;
pub mod run;
pub mod score_table;
pub mod sequences;
pub mod summarise;
pub mod summary;

pub use error::EvalError;

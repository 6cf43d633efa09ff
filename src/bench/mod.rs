//! Every stage measured beside what one would write first, in the same run, and as a share of the machine's limit.
//!
//! | module | holds |
//! |---|---|
//! | `limits` | arithmetic and memory bandwidth that this machine reaches at most |
//! | `measure` | ours and the baseline in turn, so that what disturbs one disturbs the other |
//! | [`scenes`] | the inputs: a drawn photo, key patches with planted inliers, random references |
//! | [`baselines`] | the plain implementations |
//! | `stages` | the rows |
//! | [`filled`] | a store that shows more references than it holds |
//!
//! The Criterion benchmarks use the same inputs and baselines.

pub mod baselines;
pub mod filled;
mod limits;
mod measure;
pub mod scenes;
mod stages;

pub use limits::Limits;
pub use stages::{Bench, BenchError, NAMES, REFERENCE_SIZE, fill_with_streets, street_map};

use serde::Serialize;

/// One comparison. Times are medians in milliseconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// What was measured.
    pub name: String,
    /// Ours.
    pub ours_ms: f64,
    /// What it is compared with.
    pub baseline: String,
    /// The baseline.
    pub baseline_ms: f64,
    /// How many times faster ours is.
    pub ratio: f64,
    /// The time that the machine's limit allows at best, divided by ours; absent where no limit is known.
    pub limit_share: Option<f64>,
}

impl Row {
    fn new(name: &str, baseline: &str, (ours_ms, baseline_ms): (f64, f64), limit_ms: Option<f64>) -> Self {
        Self {
            name: name.to_owned(),
            ours_ms,
            baseline: baseline.to_owned(),
            baseline_ms,
            ratio: baseline_ms / ours_ms,
            limit_share: limit_ms.map(|limit| limit / ours_ms),
        }
    }
}

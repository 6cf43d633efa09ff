//! Where the time of one request went.

use crate::ops::{Metrics, Stage};
use std::time::Duration;

/// Stages with their durations, in the order they ran.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Timings(Vec<(Stage, Duration)>);

impl Timings {
    /// Notes a stage, here and in the metrics.
    pub(super) fn record(&mut self, metrics: &Metrics, stage: Stage, took: Duration) {
        metrics.stage(stage, took);
        self.0.push((stage, took));
    }

    /// All stages noted.
    pub fn iter(&self) -> impl Iterator<Item = (Stage, Duration)> + '_ {
        self.0.iter().copied()
    }
}

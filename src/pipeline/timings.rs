//! Where the time of one request went.

use crate::ops::{Metrics, PipelineStage};
use std::time::Duration;

/// Stages with their durations, in the order they ran.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Timings(Vec<(PipelineStage, Duration)>);

impl Timings {
    /// Adds a stage, here and in the metrics.
    pub(super) fn record(&mut self, metrics: &Metrics, stage: PipelineStage, took: Duration) {
        metrics.stage(stage, took);
        self.0.push((stage, took));
    }

    /// All stages added.
    pub fn iter(&self) -> impl Iterator<Item = (PipelineStage, Duration)> + '_ {
        self.0.iter().copied()
    }
}

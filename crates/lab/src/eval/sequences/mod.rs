//! Queries as the frames of a drive: what a track gains over single answers, and what it costs.
//!
//! The queries are asked in the order of their names, each with what was believed after the one
//! before it. In a second drive the same frames come in other order: the drive is cut into legs,
//! and each leg begins where the vehicle cannot have got to. Such a kidnapped vehicle has to be
//! found again, although its track says that it is elsewhere.
//!
//! | module | holds |
//! |---|---|
//! | `layout` | where the images are, in metres, or where they are assumed to be |
//! | `drive` | one frame after the other, as the service does it |
//! | `measures` | the numbers, as pure functions |

mod drive;
mod layout;
mod measures;
#[cfg(test)]
mod tests;

pub use measures::{AccuracyPoint, Certainty, Finding, SequenceSummary};

use super::answers::{DatasetAnswers, DescribedDataset};
use super::error::EvalError;
use super::measure::{self, Interval, RECALL_AT};
use super::summary::{AtK, Summary};
use crate::datasets::Dataset;
use drive::{Drive, Frame};
use layout::Layout;
use placeformer_core::types::ConfidenceCurve;
use placeformer_vision::rerank::RerankConfig;
use serde::Serialize;

/// How a data set's queries are driven.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SequenceOptions {
    /// Seconds between two frames.
    pub frame_seconds: f64,
    /// Highest speed of the vehicle in metres a second.
    pub max_speed_mps: f64,
    /// Metres between two images of a side whose positions are not known.
    pub spacing_m: f64,
    /// Odometry instead of the highest speed, where positions are known: its error as a share of
    /// the distance.
    pub odometry_error: Option<f64>,
    /// Legs of the drive with a kidnapped vehicle.
    pub legs: usize,
    /// Seed of the errors of odometry, and of the bootstrap.
    pub seed: u64,
}

impl SequenceOptions {
    /// Checks the numbers.
    ///
    /// # Errors
    /// One is not finite, or not positive.
    pub fn check(&self) -> Result<(), EvalError> {
        let error = self.odometry_error.unwrap_or(1.0);
        let numbers = [
            self.frame_seconds,
            self.max_speed_mps,
            self.spacing_m,
            error,
        ];
        if numbers
            .iter()
            .all(|number| *number > 0.0 && number.is_finite())
            && self.legs > 1
        {
            return Ok(());
        }
        Err(EvalError::Setting(
            "the seconds, speed, spacing and odometry of sequences must be positive numbers, and \
             there must be at least two legs"
                .into(),
        ))
    }
}

/// What sequences are measured with.
pub struct SequenceRun<'a> {
    /// The data set.
    pub dataset: &'a Dataset,
    /// Its descriptors.
    pub described: &'a DescribedDataset,
    /// The answers to its queries, each alone.
    pub answers: &'a DatasetAnswers,
    /// How candidates were re-ranked; absent if they were not.
    pub rerank: Option<&'a RerankConfig>,
    /// What turns scores into confidences.
    pub curve: &'a ConfidenceCurve,
    /// How they are driven.
    pub options: SequenceOptions,
}

/// Follows the queries of a data set, and adds what was measured to `summary`: its sequences, and
/// the recall of tracks.
///
/// # Errors
/// An option is out of range, or key patches cannot be read.
pub fn measure_sequences(run: &SequenceRun<'_>, summary: &mut Summary) -> Result<(), EvalError> {
    run.options.check()?;
    let layout = Layout::of(run.dataset, &run.options);
    let drive = Drive::new(run, &layout);
    let order = drive.order();
    let frames = drive.follow(&order)?;
    let legs = legs(&order, run.options.legs);
    let kidnapped = drive.follow(&legs.concat())?;
    let starts: Vec<usize> = legs.iter().map(Vec::len).scan(0, add_up).collect();

    summary.recall.tracked = Some(recall(&frames));
    summary.recall_interval.tracked = Some(intervals(&frames, summary));
    summary.sequences = Some(SequenceSummary {
        options: run.options,
        positions_assumed: layout.is_assumed(),
        alone: Certainty::of(&drive.alone(&order), run.curve),
        tracked: Certainty::of(&frames, run.curve),
        first_found: Finding::of(&frames, &[0], run.curve),
        found_again: Finding::of(&kidnapped, &starts[..starts.len() - 1], run.curve),
        frames_lost: frames.iter().filter(|frame| frame.is_lost).count(),
        accuracy: measures::accuracy(&frames, run.curve),
        median_error_m: measures::median_error(&frames, run.curve),
        median_error_of_best_m: measures::median_error_of_best(&frames, run.curve),
        step_ms: measures::mean_step_ms(&frames),
    });
    Ok(())
}

fn add_up(total: &mut usize, frames: usize) -> Option<usize> {
    *total += frames;
    Some(*total)
}

/// The order in parts, of which no one follows the one that it followed.
fn legs(order: &[usize], legs: usize) -> Vec<Vec<usize>> {
    let length = order.len().div_ceil(legs).max(1);
    let mut parts: Vec<Vec<usize>> = order.chunks(length).map(<[usize]>::to_vec).collect();
    // The last leg first, and every other one before its predecessor.
    parts.reverse();
    parts
}

fn hits(frames: &[Frame]) -> Vec<Option<usize>> {
    let with_match = frames.iter().filter(|frame| !frame.positives.is_empty());
    with_match
        .map(|frame| measure::first_hit(&frame.ranking, &frame.positives))
        .collect()
}

fn recall(frames: &[Frame]) -> AtK<Option<f64>> {
    let hits = hits(frames);
    let at = |k| (k, measure::recall_at(&hits, k));
    RECALL_AT.into_iter().map(at).collect()
}

fn intervals(frames: &[Frame], summary: &Summary) -> AtK<Interval> {
    let config = &summary.config;
    let hits = hits(frames);
    let intervals = measure::bootstrap_recall(&hits, &RECALL_AT, config.bootstrap, config.seed);
    RECALL_AT.into_iter().zip(intervals).collect()
}

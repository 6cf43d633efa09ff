//! Everything measured in one run, as one value: printed, written as JSON, drawn in the report.

use super::calibrate::Applied;
use super::error::EvalError;
use super::features::{GlobalKind, Unreadable};
use super::measure::{Interval, PoseAccuracy, Rejection, ReliabilityBin};
use super::sequences::SequenceSummary;
use crate::datasets::Skipped;
use placeformer_core::types::{Calibration, ConfidenceWeights, ModelId};
use placeformer_vision::extract::ExtractConfig;
use placeformer_vision::rerank::RerankConfig;
use serde::Serialize;
use std::collections::BTreeMap;

/// A value before re-ranking and, if it was done, after.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Both<T> {
    /// By global distance.
    pub global: T,
    /// By S; absent if nothing was re-ranked.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reranked: Option<T>,
    /// By all that is known of a vehicle whose frames the queries are; absent if they were not
    /// followed as sequences.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tracked: Option<T>,
}

impl<T> Both<T> {
    /// The value of the global ranking, and of the re-ranked one if there is one.
    pub(super) fn of(reranked: bool, mut value: impl FnMut(RankedBy) -> T) -> Self {
        Self {
            global: value(RankedBy::Distance),
            reranked: reranked.then(|| value(RankedBy::Score)),
            tracked: None,
        }
    }
}

/// What a ranking goes by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RankedBy {
    /// By global distance, before re-ranking.
    Distance,
    /// By S, after re-ranking.
    Score,
}

/// Values by k.
pub type AtK<T> = BTreeMap<usize, T>;

/// Mean seconds: per image for the first two, per query for the others.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Seconds {
    /// Decoding and resizing one image.
    pub decode: f64,
    /// Describing one image.
    pub extract: f64,
    /// Finding the candidates of one query.
    pub search: f64,
    /// Loading their key patches.
    pub load: f64,
    /// Matching and verifying them.
    pub rerank: f64,
}

/// Bytes of one reference at rest, on average.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Bytes {
    /// Global descriptor, f32.
    pub global: f64,
    /// Vector kept for another head, f16.
    pub pooled: f64,
    /// Key patches of all scales.
    pub patches: f64,
}

/// How far a probability fitted to the scores can be believed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CalibrationSummary {
    /// Fitted on all judged queries.
    pub fitted: ConfidenceWeights,
    /// 0 to 1, of predictions made by five-fold cross-validation, places kept whole.
    pub expected_calibration_error: f64,
    /// Of the same predictions.
    pub bins: Vec<ReliabilityBin>,
}

/// One part of a data set: a city, a condition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GroupSummary {
    /// Queries with a match.
    pub queries_with_match: usize,
    /// Recall in percent.
    pub recall: Both<AtK<Option<f64>>>,
    /// Pose accuracy, where poses are known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poses: Option<Both<[PoseAccuracy; 3]>>,
}

/// The settings of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunConfig {
    /// Identity of the model.
    pub model: ModelId,
    /// Which vector was searched.
    pub global: GlobalKind,
    /// Candidates re-ranked per query.
    pub candidates: usize,
    /// Settings of extraction, the preset's own values filled in.
    pub extract: ExtractConfig,
    /// Settings of re-ranking; absent if it was left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rerank: Option<RerankConfig>,
    /// Bootstrap resamples behind the intervals.
    pub bootstrap: usize,
    /// Seed of the bootstrap.
    pub seed: u64,
}

impl RunConfig {
    /// Refuses a calibration that says nothing about this run: confidences mean something only for
    /// the model and the re-ranking they were fitted on, and for distances of the head.
    ///
    /// # Errors
    /// Another vector is searched, or the calibration is one of another model or re-ranking.
    pub fn check_calibration(&self, given: &Calibration) -> Result<(), EvalError> {
        let refuse = |reason: String| Err(EvalError::Setting(reason));
        if self.global != GlobalKind::Head {
            return refuse(
                "a calibration holds for distances of the head: leave --global out".into(),
            );
        }
        if *given.model() != self.model {
            return refuse(format!(
                "the calibration is one of {}, and this model is {}",
                given.model(),
                self.model
            ));
        }
        let Some(rerank) = &self.rerank else {
            return Ok(());
        };
        let id = rerank.id();
        if *given.rerank() != id {
            return refuse(format!(
                "the calibration is one of re-ranking {}, and this is {id}",
                given.rerank()
            ));
        }
        Ok(())
    }
}

/// The whole result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Name of the data set.
    pub dataset: String,
    /// Queries searched.
    pub queries: usize,
    /// Of these, queries known to have a match: recall is over them.
    pub queries_with_match: usize,
    /// Of these, queries known to have none: they judge rejection.
    pub queries_without_match: usize,
    /// Queries asked again with their own place left out of the database; they judge rejection too.
    pub queries_left_out: usize,
    /// Images searched in.
    pub database: usize,
    /// Recall in percent at 1, 5, 10, 20; null if no query has a known match.
    pub recall: Both<AtK<Option<f64>>>,
    /// 95% bootstrap intervals of the recalls.
    pub recall_interval: Both<AtK<Interval>>,
    /// Mean average precision at 1, 5, 10, 20, 0 to 1.
    pub map: Both<AtK<f64>>,
    /// Rejecting unknown places by distance, and by S.
    pub rejection: Both<Rejection>,
    /// Pose of the best match, where the data set has poses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poses: Option<Both<[PoseAccuracy; 3]>>,
    /// Parts of the data set, if it has any.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub groups: BTreeMap<String, GroupSummary>,
    /// Probability of being right from S and distance; absent if answers of both kinds are too few.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<CalibrationSummary>,
    /// What the calibration that the program carries for this model comes to on these queries,
    /// after re-ranking if that was done; absent if it carries none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shipped_calibration: Option<Applied>,
    /// The same of a calibration that was given to be judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub given_calibration: Option<Applied>,
    /// What tracks come to, if the queries were followed as sequences.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sequences: Option<SequenceSummary>,
    /// Mean seconds per image and per query.
    pub seconds: Seconds,
    /// Mean bytes of one reference.
    pub bytes_per_reference: f64,
    /// The same by part.
    pub bytes: Bytes,
    /// The settings.
    pub config: RunConfig,
    /// Every query by itself.
    pub outcomes: Vec<Outcome>,
    /// Images that could not be read.
    pub unreadable: Vec<Unreadable>,
    /// Images the reader of the data set left out.
    pub skipped: Vec<Skipped>,
    /// What else there is to know.
    pub notes: Vec<String>,
}

/// What became of one query; ranks begin at 1 and are absent where no positive was among the
/// candidates.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Outcome {
    /// Name of the query.
    pub query: String,
    /// Known positives.
    pub positives: usize,
    /// Rank of the first positive by global distance.
    pub global_rank: Option<usize>,
    /// Rank of the first positive by S.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reranked_rank: Option<usize>,
    /// Name of the best answer, by S if that was asked for.
    pub best: Option<String>,
    /// Its distance.
    pub global_distance: Option<f32>,
    /// Its S.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spatial_score: Option<u32>,
    /// S of the positive ranked first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub positive_score: Option<u32>,
}

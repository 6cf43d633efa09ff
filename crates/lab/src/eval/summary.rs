//! Everything measured in one run, as one value: printed, written as JSON, drawn in the report.

use super::EvalError;
use super::calibrate::{Applied, BestAnswers, shipped_curve};
use super::features::{Features, GlobalKind, Unreadable};
use super::measure::{self, Interval, Judged, PoseAccuracy, RECALL_AT, Rejection, ReliabilityBin};
use super::run::{Answer, QuerySeconds};
use crate::datasets::{Dataset, Skipped, Truth};
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
}

impl<T> Both<T> {
    fn of(reranked: bool, mut value: impl FnMut(Stage) -> T) -> Self {
        Self {
            global: value(Stage::Global),
            reranked: reranked.then(|| value(Stage::Reranked)),
        }
    }
}

/// Before or after re-ranking.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// By global distance.
    Global,
    /// By S.
    Reranked,
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

/// Fewest right and fewest wrong answers a calibration is fitted on.
const CALIBRATION_MINIMUM: usize = 5;

/// What was asked, and how long it took.
#[derive(Debug, Clone, Copy)]
pub struct Asked<'a> {
    /// The answers to the data set as it is.
    pub answers: &'a [Answer],
    /// Answers to the same queries with their own place left out of the database: none of them can
    /// be right.
    pub left_out: &'a [Answer],
    /// Mean seconds per query.
    pub seconds: QuerySeconds,
}

/// Measures the answers; `given` is a calibration to be judged on them beside the model's own.
pub fn summarise(
    dataset: &Dataset,
    database: &Features,
    queries: &Features,
    asked: Asked<'_>,
    config: RunConfig,
    given: Option<&Calibration>,
) -> Result<Summary, EvalError> {
    let Asked {
        answers,
        left_out,
        seconds,
    } = asked;
    let view = View {
        dataset,
        reranked: config.rerank.is_some(),
    };
    let all: Vec<&Answer> = answers.iter().collect();
    let judged: Vec<&Answer> = all
        .iter()
        .copied()
        .filter(|a| dataset.truth[a.query] != Truth::Unknown)
        .collect();
    let with_match = view.with_match(&all);
    let best = BestAnswers::of(dataset, answers, left_out);
    let mut unreadable = database.unreadable.clone();
    unreadable.extend(queries.unreadable.iter().cloned());
    let bytes = Bytes {
        global: 4.0 * database.dim as f64,
        pooled: 2.0 * database.pooled_dim as f64,
        patches: database.patch_bytes,
    };
    let interval = |stage| {
        let hits = view.hits(&with_match, stage);
        let intervals = measure::bootstrap_recall(&hits, &RECALL_AT, config.bootstrap, config.seed);
        RECALL_AT.into_iter().zip(intervals).collect()
    };
    Ok(Summary {
        dataset: dataset.name.clone(),
        queries: answers.len(),
        queries_with_match: with_match.len(),
        queries_without_match: judged.len() - with_match.len(),
        queries_left_out: left_out.len(),
        database: dataset.database.len() - database.unreadable.len(),
        recall: Both::of(view.reranked, |stage| view.recall(&with_match, stage)),
        recall_interval: Both::of(view.reranked, interval),
        map: Both::of(view.reranked, |stage| {
            view.mean_average_precision(&with_match, stage)
        }),
        rejection: Both::of(view.reranked, |stage| {
            measure::rejection(&view.judged(&judged, left_out, stage))
        }),
        poses: view.poses(&all),
        groups: view.groups(&all),
        calibration: fitted_here(&best, config.seed),
        shipped_calibration: shipped_here(&best, &config),
        given_calibration: given
            .and_then(|given| given_here(&best, given, config.rerank.is_some())),
        seconds: Seconds {
            decode: database.seconds.decode,
            extract: database.seconds.extract,
            search: seconds.search,
            load: seconds.load,
            rerank: seconds.rerank,
        },
        bytes_per_reference: bytes.global + bytes.pooled + bytes.patches,
        bytes,
        config,
        outcomes: answers.iter().map(|answer| view.outcome(answer)).collect(),
        unreadable,
        skipped: dataset.skipped.clone(),
        notes: dataset.notes.clone(),
    })
}

/// A data set with the question whether answers were re-ranked.
struct View<'a> {
    dataset: &'a Dataset,
    reranked: bool,
}

fn ranking(answer: &Answer, stage: Stage) -> Vec<usize> {
    match stage {
        Stage::Global => answer.global_ranking(),
        Stage::Reranked => answer.reranked_ranking(),
    }
}

impl<'a> View<'a> {
    fn positives(&self, answer: &Answer) -> &'a [usize] {
        self.dataset.truth[answer.query].positives()
    }

    fn with_match<'b>(&self, answers: &[&'b Answer]) -> Vec<&'b Answer> {
        answers
            .iter()
            .copied()
            .filter(|answer| !self.positives(answer).is_empty())
            .collect()
    }

    fn hits(&self, with_match: &[&Answer], stage: Stage) -> Vec<Option<usize>> {
        with_match
            .iter()
            .map(|answer| measure::first_hit(&ranking(answer, stage), self.positives(answer)))
            .collect()
    }

    fn recall(&self, with_match: &[&Answer], stage: Stage) -> AtK<Option<f64>> {
        let hits = self.hits(with_match, stage);
        RECALL_AT
            .into_iter()
            .map(|k| (k, measure::recall_at(&hits, k)))
            .collect()
    }

    fn mean_average_precision(&self, with_match: &[&Answer], stage: Stage) -> AtK<f64> {
        let mean = |k| {
            let sum: f64 = with_match
                .iter()
                .map(|answer| {
                    measure::average_precision(&ranking(answer, stage), self.positives(answer), k)
                })
                .sum();
            sum / with_match.len().max(1) as f64
        };
        RECALL_AT.into_iter().map(|k| (k, mean(k))).collect()
    }

    fn outcome(&self, answer: &Answer) -> Outcome {
        let positives = self.positives(answer);
        let rank = |stage| measure::first_hit(&ranking(answer, stage), positives);
        let (global, reranked) = (rank(Stage::Global), rank(Stage::Reranked));
        let best = match answer.reranked.first() {
            Some(candidate) => Some((candidate.index, candidate.distance)),
            None => answer
                .global
                .first()
                .map(|neighbour| (neighbour.index, neighbour.distance)),
        };
        Outcome {
            query: self.dataset.queries[answer.query].name.clone(),
            positives: positives.len(),
            global_rank: global.map(|rank| rank + 1),
            reranked_rank: reranked.map(|rank| rank + 1),
            best: best.map(|(index, _)| self.dataset.database[index].name.clone()),
            global_distance: best.map(|(_, distance)| distance),
            spatial_score: answer
                .reranked
                .first()
                .map(|candidate| candidate.score.spatial_score),
            positive_score: reranked.map(|rank| answer.reranked[rank].score.spatial_score),
        }
    }

    fn judged(&self, answers: &[&Answer], left_out: &[Answer], stage: Stage) -> Vec<Judged> {
        let judge = |(answer, positives): (&Answer, &[usize])| {
            let (index, score) = match stage {
                Stage::Global => answer
                    .global
                    .first()
                    .map(|n| (n.index, -f64::from(n.distance)))?,
                Stage::Reranked => answer
                    .reranked
                    .first()
                    .map(|c| (c.index, f64::from(c.score.spatial_score)))?,
            };
            Some(Judged {
                score,
                correct: positives.binary_search(&index).is_ok(),
                has_match: !positives.is_empty(),
            })
        };
        let as_they_are = answers
            .iter()
            .map(|&answer| (answer, self.positives(answer)));
        let without: &[usize] = &[];
        as_they_are
            .chain(left_out.iter().map(|answer| (answer, without)))
            .filter_map(judge)
            .collect()
    }

    fn poses(&self, answers: &[&Answer]) -> Option<Both<[PoseAccuracy; 3]>> {
        let known: Vec<&&Answer> = answers
            .iter()
            .filter(|answer| self.dataset.queries[answer.query].pose.is_some())
            .collect();
        let accuracy = |stage| {
            let pair = |answer: &&&Answer| {
                let best = ranking(answer, stage)
                    .first()
                    .and_then(|&index| self.dataset.database[index].pose);
                Some((self.dataset.queries[answer.query].pose?, best))
            };
            measure::pose_accuracy(&known.iter().filter_map(pair).collect::<Vec<_>>())
        };
        (!known.is_empty()).then(|| Both::of(self.reranked, accuracy))
    }

    fn groups(&self, answers: &[&Answer]) -> BTreeMap<String, GroupSummary> {
        let mut groups: BTreeMap<&str, Vec<&Answer>> = BTreeMap::new();
        for answer in answers {
            if let Some(group) = &self.dataset.queries[answer.query].group {
                groups.entry(group).or_default().push(answer);
            }
        }
        let summary = |(name, members): (&str, Vec<&Answer>)| {
            let with_match = self.with_match(&members);
            let recall = Both::of(self.reranked, |stage| self.recall(&with_match, stage));
            let poses = self.poses(&members);
            (
                name.to_owned(),
                GroupSummary {
                    queries_with_match: with_match.len(),
                    recall,
                    poses,
                },
            )
        };
        groups.into_iter().map(summary).collect()
    }
}

/// A probability fitted to these very answers, if there are enough of both kinds.
fn fitted_here(best: &BestAnswers, seed: u64) -> Option<CalibrationSummary> {
    let answers = &best.reranked;
    let right = answers.iter().filter(|answer| answer.correct).count();
    if right.min(answers.len() - right) < CALIBRATION_MINIMUM {
        return None;
    }
    let fitted = measure::fit(answers, measure::RIDGE).ok()?;
    let unseen = measure::cross_validate(answers, measure::RIDGE, measure::FOLDS, seed);
    let bins = measure::reliability(&measure::predictions_of(&unseen));
    Some(CalibrationSummary {
        fitted,
        expected_calibration_error: measure::calibration_error(&bins),
        bins,
    })
}

/// What the model's own curve comes to on these answers.
fn shipped_here(best: &BestAnswers, config: &RunConfig) -> Option<Applied> {
    let rerank = config.rerank.as_ref().map(RerankConfig::id);
    // Distances without the head are of another kind.
    let curve = (config.global == GlobalKind::Head)
        .then(|| shipped_curve(&config.model, rerank.as_ref()))??;
    let answers = if rerank.is_some() {
        &best.reranked
    } else {
        &best.global
    };
    (!answers.is_empty()).then(|| Applied::of(&curve, answers))
}

/// What a given calibration comes to on these answers.
fn given_here(best: &BestAnswers, given: &Calibration, reranked: bool) -> Option<Applied> {
    let answers = if reranked {
        &best.reranked
    } else {
        &best.global
    };
    (!answers.is_empty()).then(|| Applied::of(given.curve(reranked), answers))
}

#[cfg(test)]
mod tests;

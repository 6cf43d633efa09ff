//! From the answers to a data set to the summary of a run.

use super::answers::DatasetAnswers;
use super::calibrate::{Applied, BestAnswers, shipped_curve};
use super::features::{Features, GlobalKind};
use super::measure::{self, Interval, Judged, PoseAccuracy, RECALL_AT};
use super::run::Answer;
use super::summary::{
    AtK, Both, Bytes, CalibrationSummary, GroupSummary, Outcome, RankedBy, RunConfig, Seconds,
    Summary,
};
use crate::datasets::{Dataset, Truth};
use placeformer_core::types::Calibration;
use placeformer_vision::rerank::RerankConfig;
use std::collections::BTreeMap;

/// Fewest right and fewest wrong answers a calibration is fitted on.
const CALIBRATION_MINIMUM: usize = 5;

/// Measures the answers; `given` is a calibration to be judged on them beside the model's own.
pub fn summarise(
    dataset: &Dataset,
    database: &Features,
    queries: &Features,
    asked: &DatasetAnswers,
    config: RunConfig,
    given: Option<&Calibration>,
) -> Summary {
    let DatasetAnswers {
        answers,
        left_out,
        seconds,
    } = asked;
    let view = View {
        dataset,
        reranked: config.rerank.is_some(),
    };
    let all: Vec<&Answer> = answers.iter().collect();
    let judged = view.of_known_truth(&all);
    let with_match = view.with_match(&all);
    let score = config.rerank.as_ref().map(|rerank| rerank.score);
    let best = BestAnswers::of(dataset, answers, left_out, score.unwrap_or_default());
    let bytes = bytes_of(database);
    Summary {
        dataset: dataset.name.clone(),
        queries: answers.len(),
        queries_with_match: with_match.len(),
        queries_without_match: judged.len() - with_match.len(),
        queries_left_out: left_out.len(),
        database: dataset.database.len() - database.unreadable.len(),
        recall: Both::of(view.reranked, |by| view.recall(&with_match, by)),
        recall_interval: Both::of(view.reranked, |by| {
            view.recall_intervals(&with_match, by, &config)
        }),
        map: Both::of(view.reranked, |by| {
            view.mean_average_precision(&with_match, by)
        }),
        rejection: Both::of(view.reranked, |by| {
            measure::rejection(&view.judged(&judged, left_out, by))
        }),
        poses: view.poses(&all),
        groups: view.groups(&all),
        calibration: fitted_here(&best, config.seed),
        shipped_calibration: shipped_here(&best, &config),
        given_calibration: given.and_then(|given| given_here(&best, given, view.reranked)),
        sequences: None,
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
        unreadable: [&database.unreadable[..], &queries.unreadable[..]].concat(),
        skipped: dataset.skipped.clone(),
        notes: dataset.notes.clone(),
    }
}

/// Bytes of one reference at rest: f32 global values, f16 pooled ones.
fn bytes_of(database: &Features) -> Bytes {
    Bytes {
        global: 4.0 * database.dim as f64,
        pooled: 2.0 * database.pooled_dim as f64,
        patches: database.patch_bytes,
    }
}

/// A data set with the question whether answers were re-ranked.
struct View<'a> {
    dataset: &'a Dataset,
    reranked: bool,
}

fn ranking(answer: &Answer, by: RankedBy) -> Vec<usize> {
    match by {
        RankedBy::Distance => answer.global_ranking(),
        RankedBy::Score => answer.reranked_ranking(),
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

    fn of_known_truth<'b>(&self, answers: &[&'b Answer]) -> Vec<&'b Answer> {
        let is_known = |answer: &&Answer| self.dataset.truth[answer.query] != Truth::Unknown;
        answers.iter().copied().filter(is_known).collect()
    }

    fn hits(&self, with_match: &[&Answer], by: RankedBy) -> Vec<Option<usize>> {
        with_match
            .iter()
            .map(|answer| measure::first_hit(&ranking(answer, by), self.positives(answer)))
            .collect()
    }

    fn recall(&self, with_match: &[&Answer], by: RankedBy) -> AtK<Option<f64>> {
        let hits = self.hits(with_match, by);
        RECALL_AT
            .into_iter()
            .map(|k| (k, measure::recall_at(&hits, k)))
            .collect()
    }

    fn recall_intervals(
        &self,
        with_match: &[&Answer],
        by: RankedBy,
        config: &RunConfig,
    ) -> AtK<Interval> {
        let hits = self.hits(with_match, by);
        let intervals = measure::bootstrap_recall(&hits, &RECALL_AT, config.bootstrap, config.seed);
        RECALL_AT.into_iter().zip(intervals).collect()
    }

    fn mean_average_precision(&self, with_match: &[&Answer], by: RankedBy) -> AtK<f64> {
        let mean = |k| {
            let sum: f64 = with_match
                .iter()
                .map(|answer| {
                    measure::average_precision(&ranking(answer, by), self.positives(answer), k)
                })
                .sum();
            sum / with_match.len().max(1) as f64
        };
        RECALL_AT.into_iter().map(|k| (k, mean(k))).collect()
    }

    fn outcome(&self, answer: &Answer) -> Outcome {
        let positives = self.positives(answer);
        let rank = |by| measure::first_hit(&ranking(answer, by), positives);
        let global = rank(RankedBy::Distance);
        let reranked = rank(RankedBy::Score);
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

    fn judged(&self, answers: &[&Answer], left_out: &[Answer], by: RankedBy) -> Vec<Judged> {
        let judge = |(answer, positives): (&Answer, &[usize])| {
            let (index, score) = match by {
                RankedBy::Distance => answer
                    .global
                    .first()
                    .map(|n| (n.index, -f64::from(n.distance)))?,
                RankedBy::Score => answer.reranked.first().map(|c| (c.index, c.value))?,
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
        let accuracy = |by| {
            let pair = |answer: &&&Answer| {
                let best = ranking(answer, by)
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
            let recall = Both::of(self.reranked, |by| self.recall(&with_match, by));
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
    if config.global != GlobalKind::Head {
        // The curve was fitted to distances of the head; those of mean tokens are of another kind.
        return None;
    }
    let curve = shipped_curve(&config.model, rerank.as_ref())?;
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

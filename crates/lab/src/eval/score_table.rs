//! What the ways to order candidates are worth, one row for each: by global distance alone, by S,
//! fused, and by a learned score.

use super::answers::DatasetAnswers;
use super::measure::{Interval, RECALL_AT, bootstrap_recall, first_hit, recall_at};
use super::run::Answer;
use super::summary::AtK;
use crate::datasets::Dataset;
use placeformer_core::types::LearnedScore;
use placeformer_vision::rerank::Ranking;
use serde::Serialize;
use std::fmt::Write;

/// Resamples behind the intervals.
const RESAMPLES: usize = 2000;

/// Recall with one way to order candidates.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScoreRow {
    /// What candidates are ordered by.
    pub ordered_by: &'static str,
    /// Queries with a match.
    pub queries: usize,
    /// In percent.
    pub recall: AtK<Option<f64>>,
    /// 95% intervals, in percent.
    pub intervals: AtK<Interval>,
}

/// The rows for answers to `dataset`, whose re-ranked candidates `learned` knows nothing of.
pub fn score_rows(
    dataset: &Dataset,
    asked: &DatasetAnswers,
    learned: &LearnedScore,
) -> Vec<ScoreRow> {
    let global = row(dataset, "global", &asked.answers, Answer::global_ranking);
    let rankings = [Ranking::Paper, Ranking::Fused, Ranking::Learned(learned)];
    let reranked = rankings.into_iter().map(|ranking| {
        let mut answers = asked.answers.clone();
        answers.iter_mut().for_each(|it| it.order_by(&ranking));
        let name = ranking.kind().as_str();
        row(dataset, name, &answers, Answer::reranked_ranking)
    });
    std::iter::once(global).chain(reranked).collect()
}

fn row(
    dataset: &Dataset,
    ordered_by: &'static str,
    answers: &[Answer],
    ranking: fn(&Answer) -> Vec<usize>,
) -> ScoreRow {
    let hit = |answer: &Answer| {
        let positives = dataset.truth[answer.query].positives();
        (!positives.is_empty()).then(|| first_hit(&ranking(answer), positives))
    };
    let hits: Vec<Option<usize>> = answers.iter().filter_map(hit).collect();
    let recall = RECALL_AT.into_iter().map(|k| (k, recall_at(&hits, k)));
    let intervals = bootstrap_recall(&hits, &RECALL_AT, RESAMPLES, 0);
    ScoreRow {
        ordered_by,
        queries: hits.len(),
        recall: recall.collect(),
        intervals: RECALL_AT.into_iter().zip(intervals).collect(),
    }
}

/// The rows as a table with a title.
pub fn score_text(title: &str, rows: &[ScoreRow]) -> String {
    let mut out = String::new();
    let queries = rows.first().map_or(0, |row| row.queries);
    // Writing into a `String` cannot fail.
    let _ = write!(out, "{title}, {queries} queries\n{:<10}", "ordered by");
    for k in RECALL_AT {
        let _ = write!(out, "{:>8}", format!("R@{k}"));
    }
    let _ = writeln!(out, "   95% of R@1");
    for row in rows {
        let _ = write!(out, "{:<10}", row.ordered_by);
        for recall in row.recall.values() {
            let _ = write!(out, "{:>8.1}", recall.unwrap_or_default());
        }
        if let Some(Interval { low, high }) = row.intervals.values().next() {
            let _ = writeln!(out, "   [{low:.1}, {high:.1}]");
        }
    }
    out
}

//! The plots of an evaluation: recall over k, precision over recall, S of right and wrong answers,
//! reliability.

use super::svg::{Histogram, LineChart, Series};
use crate::datasets::{Dataset, Truth};
use crate::eval::answers::DatasetAnswers;
use crate::eval::measure::{Rejection, ReliabilityBin, first_hit, recall_at};
use crate::eval::run::Answer;
use crate::eval::sequences::{Certainty, SequenceSummary};
use crate::eval::summary::Summary;
use maud::{Markup, html};

/// Longest list of answers the recall plot looks at.
const RECALL_TO: usize = 25;

/// All plots that the data allow, as figures.
pub fn plots(summary: &Summary, dataset: &Dataset, answers: &DatasetAnswers) -> Markup {
    let mut figures = Vec::new();
    if summary.queries_with_match > 0 {
        figures.push((
            recall_plot(summary, dataset, &answers.answers),
            "Share of queries with a right place among the first k.",
        ));
        figures.push((
            rejection_plot(summary),
            "Accepting only answers above a score: S, or nearness before re-ranking.",
        ));
    }
    if summary.recall.reranked.is_some() {
        figures.push((
            score_plot(dataset, answers),
            "S of the best answer, by whether it is right.",
        ));
    }
    if let Some(plot) = reliability_plot(summary) {
        figures.push((
            plot,
            "Share of right answers by confidence, with the calibration error; the dashed line is \
             ideal. What is fitted here is five-fold cross-validated.",
        ));
    }
    if let Some(sequences) = &summary.sequences {
        figures.push((
            certainty_plot(sequences),
            "Share of right answers by confidence, each frame alone and as one of a track; the \
             dashed line is ideal.",
        ));
        if !sequences.accuracy.is_empty() {
            figures.push((
                accuracy_plot(sequences),
                "Share of trusted positions whose error is within the radius that their accuracy \
                 gives for an expected share; the dashed line is ideal.",
            ));
        }
    }
    html! {
        div.plots {
            @for (svg, caption) in figures {
                figure {
                    (svg)
                    figcaption { (caption) }
                }
            }
        }
    }
}

fn recall_plot(summary: &Summary, dataset: &Dataset, answers: &[Answer]) -> Markup {
    let hits = |ranking: fn(&Answer) -> Vec<usize>| -> Vec<Option<usize>> {
        let with_match = answers
            .iter()
            .filter(|answer| !dataset.truth[answer.query].positives().is_empty());
        with_match
            .map(|answer| first_hit(&ranking(answer), dataset.truth[answer.query].positives()))
            .collect()
    };
    let line = |name: &str, class, ranking| {
        let hits = hits(ranking);
        let points = (1..=RECALL_TO)
            .filter_map(|k| Some((k as f64, recall_at(&hits, k)?)))
            .collect();
        Series {
            name: name.into(),
            class,
            points,
            dots: false,
        }
    };
    let mut series = vec![line("global", "b", Answer::global_ranking)];
    if summary.recall.reranked.is_some() {
        series.insert(0, line("re-ranked", "a", Answer::reranked_ranking));
    }
    let lowest = series
        .iter()
        .flat_map(|s| &s.points)
        .map(|point| point.1)
        .fold(100.0, f64::min);
    LineChart {
        title: format!("Recall at k on {}", summary.dataset),
        x_label: "k".into(),
        y_label: "recall, %".into(),
        x_range: (1.0, RECALL_TO as f64),
        y_range: (round_below(lowest), 100.0),
        series,
    }
    .render()
}

/// The lower end of an axis: a round number that leaves room for differences.
fn round_below(lowest: f64) -> f64 {
    let round = (lowest / 20.0).floor().max(0.0) * 20.0;
    if lowest >= 100.0 { round - 20.0 } else { round }
}

fn rejection_plot(summary: &Summary) -> Markup {
    let line = |name: &str, class, rejection: &Rejection| {
        let points = rejection
            .curve
            .iter()
            .map(|point| (point.recall, point.precision))
            .collect();
        Series {
            name: name.into(),
            class,
            points,
            dots: false,
        }
    };
    let mut series = vec![line("global", "b", &summary.rejection.global)];
    if let Some(rejection) = &summary.rejection.reranked {
        series.insert(0, line("re-ranked", "a", rejection));
    }
    LineChart {
        title: format!("Precision over recall on {}", summary.dataset),
        x_label: "recall, %".into(),
        y_label: "precision, %".into(),
        x_range: (0.0, 100.0),
        y_range: (0.0, 100.0),
        series,
    }
    .render()
}

fn score_plot(dataset: &Dataset, answers: &DatasetAnswers) -> Markup {
    let mut right = Vec::new();
    let mut wrong = Vec::new();
    let mut none = Vec::new();
    for answer in &answers.answers {
        let Some(best) = answer.reranked.first() else {
            continue;
        };
        let score = f64::from(best.score.spatial_score);
        match &dataset.truth[answer.query] {
            Truth::Positives(positives) if positives.binary_search(&best.index).is_ok() => {
                right.push(score)
            }
            Truth::Positives(_) => wrong.push(score),
            Truth::NoMatch => none.push(score),
            Truth::Unknown => {}
        }
    }
    for answer in &answers.left_out {
        if let Some(best) = answer.reranked.first() {
            none.push(f64::from(best.score.spatial_score));
        }
    }
    let series = [
        ("right", "a", right),
        ("wrong", "b", wrong),
        ("no match exists", "c", none),
    ];
    let series = series
        .into_iter()
        .filter(|(_, _, values)| !values.is_empty());
    Histogram {
        title: "Histogram of S".into(),
        x_label: "S of the best answer".into(),
        series: series
            .map(|(name, class, values)| (name.to_owned(), class, values))
            .collect(),
        bins: 30,
    }
    .render()
}

/// A line that would be reached if everything were as it says.
fn ideal() -> Series {
    Series {
        name: String::new(),
        class: "muted",
        points: vec![(0.0, 0.0), (1.0, 1.0)],
        dots: false,
    }
}

fn certainty_plot(sequences: &SequenceSummary) -> Markup {
    let line = |name: &str, class, certainty: &Certainty| Series {
        name: format!("{name}, error {:.3}", certainty.expected_calibration_error),
        class,
        points: certainty
            .bins
            .iter()
            .map(|bin| (bin.confidence, bin.accuracy))
            .collect(),
        dots: true,
    };
    LineChart {
        title: "Reliability of tracks".into(),
        x_label: "confidence".into(),
        y_label: "share of right answers".into(),
        x_range: (0.0, 1.0),
        y_range: (0.0, 1.0),
        series: vec![
            ideal(),
            line("tracked", "a", &sequences.tracked),
            line("alone", "b", &sequences.alone),
        ],
    }
    .render()
}

fn accuracy_plot(sequences: &SequenceSummary) -> Markup {
    let points = sequences
        .accuracy
        .iter()
        .map(|point| (point.expected, point.observed))
        .collect();
    LineChart {
        title: "Accuracy of positions".into(),
        x_label: "expected share within the radius".into(),
        y_label: "share within it".into(),
        x_range: (0.0, 1.0),
        y_range: (0.0, 1.0),
        series: vec![
            ideal(),
            Series {
                name: "trusted positions".into(),
                class: "a",
                points,
                dots: true,
            },
        ],
    }
    .render()
}

fn reliability_plot(summary: &Summary) -> Option<Markup> {
    let line = |name: String, class, bins: &[ReliabilityBin]| {
        let points = bins
            .iter()
            .map(|bin| (bin.confidence, bin.accuracy))
            .collect();
        Series {
            name,
            class,
            points,
            dots: true,
        }
    };
    let mut series = Vec::new();
    if let Some(fitted) = &summary.calibration {
        let name = format!(
            "fitted here, error {:.3}",
            fitted.expected_calibration_error
        );
        series.push(line(name, "a", &fitted.bins));
    }
    for (name, class, applied) in [
        ("the model's own", "b", &summary.shipped_calibration),
        ("the one given", "c", &summary.given_calibration),
    ] {
        if let Some(applied) = applied {
            let name = format!("{name}, error {:.3}", applied.expected_calibration_error);
            series.push(line(name, class, &applied.bins));
        }
    }
    if series.is_empty() {
        return None;
    }
    series.insert(0, ideal());
    let chart = LineChart {
        title: "Reliability of confidences".into(),
        x_label: "confidence".into(),
        y_label: "share right".into(),
        x_range: (0.0, 1.0),
        y_range: (0.0, 1.0),
        series,
    };
    Some(chart.render())
}

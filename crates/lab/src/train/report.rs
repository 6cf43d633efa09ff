//! A run as one self-contained page: what was learnt from, how loss and recall went, what came out.

use super::config::{TrainConfig, ValidationRecall};
use super::log::CycleRecord;
use super::trainer::Outcome;
use crate::eval::report::{LineChart, Series, page, table};
use maud::{Markup, html};

/// The page. `facts` are lines of a table: what was trained on what.
pub fn html(
    facts: &[(String, String)],
    config: &TrainConfig,
    records: &[CycleRecord],
    outcome: &Outcome,
) -> String {
    let figures = [
        (
            recall_chart(records, outcome),
            "Recall on places that are not learnt from, after each cycle.",
        ),
        (
            loss_chart(records),
            "Mean loss of each cycle, on hard negatives mined as it began.",
        ),
        (
            rate_chart(records),
            "Learning rate at the end of each cycle.",
        ),
    ];
    let facts: Vec<Vec<&String>> = facts
        .iter()
        .map(|(name, value)| vec![name, value])
        .collect();
    let settings = serde_json::to_string_pretty(config).unwrap_or_default();
    let body = html! {
        p.lead { (verdict(outcome)) }
        (recall_table(outcome))
        h2 { "Curves" }
        div.plots {
            @for (chart, caption) in figures {
                figure {
                    (chart.render())
                    figcaption { (caption) }
                }
            }
        }
        h2 { "The run" }
        (table("", &["", ""], &facts))
        h2 { "Settings" }
        pre { (settings) }
    };
    page("Training", &body)
}

/// How the run ended, in a sentence.
pub fn verdict(outcome: &Outcome) -> String {
    let end = if outcome.stopped_early {
        "stopped early"
    } else {
        "ran to the end of its schedule"
    };
    let gain = if outcome.kept == outcome.initial {
        "validation never improved, so the weights are those it started from".to_owned()
    } else {
        format!(
            "validation recall@1 went from {:.1} to {:.1} percent",
            outcome.initial.at_1, outcome.kept.at_1
        )
    };
    format!("The run {end} after {} steps; {gain}.", outcome.steps)
}

fn recall_table(outcome: &Outcome) -> Markup {
    let row = |name: &str, recall: &ValidationRecall| {
        let mut cells = vec![name.to_owned()];
        cells.extend([recall.at_1, recall.at_5, recall.at_10].map(|value| format!("{value:.1}")));
        cells
    };
    let rows = [row("before", &outcome.initial), row("kept", &outcome.kept)];
    table(
        "Validation recall in percent",
        &["weights", "R@1", "R@5", "R@10"],
        &rows,
    )
}

fn chart(title: &str, y_label: &str, y_range: (f64, f64), series: Vec<Series>) -> LineChart {
    let last = series
        .iter()
        .flat_map(|series| &series.points)
        .map(|point| point.0)
        .fold(1.0, f64::max);
    LineChart {
        title: title.into(),
        x_label: "step".into(),
        y_label: y_label.into(),
        x_range: (0.0, last),
        y_range,
        series,
    }
}

fn recall_chart(records: &[CycleRecord], outcome: &Outcome) -> LineChart {
    let line = |name: &str, class, value: fn(&ValidationRecall) -> f64| {
        let mut points = vec![(0.0, value(&outcome.initial))];
        points.extend(
            records
                .iter()
                .map(|record| (record.step as f64, value(&record.recall))),
        );
        Series {
            name: name.into(),
            class,
            points,
            dots: false,
        }
    };
    let series = vec![
        line("R@1", "a", |r| r.at_1),
        line("R@5", "b", |r| r.at_5),
        line("R@10", "c", |r| r.at_10),
    ];
    let lowest = series
        .iter()
        .flat_map(|series| &series.points)
        .map(|point| point.1)
        .fold(90.0, f64::min);
    chart(
        "Validation recall",
        "recall, %",
        ((lowest / 10.0).floor() * 10.0, 100.0),
        series,
    )
}

fn loss_chart(records: &[CycleRecord]) -> LineChart {
    falling(
        "Training loss",
        "loss",
        records
            .iter()
            .map(|record| (record.step as f64, f64::from(record.loss)))
            .collect(),
    )
}

fn rate_chart(records: &[CycleRecord]) -> LineChart {
    // In units of 1e-4, which is what rates come in; the axis shows three decimals.
    let points = records
        .iter()
        .map(|record| (record.step as f64, record.learning_rate * 1e4))
        .collect();
    falling("Learning rate", "rate, 1e-4", points)
}

fn falling(title: &str, y_label: &str, points: Vec<(f64, f64)>) -> LineChart {
    let top = points.iter().map(|point| point.1).fold(0.0, f64::max);
    let top = if top > 0.0 { top } else { 1.0 };
    chart(
        title,
        y_label,
        (0.0, top),
        vec![Series {
            name: String::new(),
            class: "a",
            points,
            dots: false,
        }],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_shows_both_recalls_and_says_when_nothing_was_gained() {
        let recall = |at_1| ValidationRecall {
            at_1,
            at_5: 90.0,
            at_10: 95.0,
        };
        let record = |step, at_1| CycleRecord {
            step,
            learning_rate: 5e-4,
            loss: 0.01,
            recall: recall(at_1),
            step_seconds: 0.5,
            seconds: 1.0,
        };
        let gained = Outcome {
            steps: 200,
            stopped_early: true,
            initial: recall(50.5),
            kept: recall(70.25),
            last_loss: 0.01,
        };
        let facts = [("data".to_owned(), "<set>".to_owned())];
        let page = html(
            &facts,
            &TrainConfig::default(),
            &[record(100, 60.0), record(200, 70.25)],
            &gained,
        );
        for part in [
            "50.5",
            "70.2",
            "&lt;set&gt;",
            "Training loss",
            "stopped early after 200 steps",
            "&quot;margin&quot;",
        ] {
            assert!(page.contains(part), "{part} is missing");
        }
        assert!(!page.contains("<set>"));
        let nothing = Outcome {
            kept: recall(50.5),
            ..gained
        };
        assert!(verdict(&nothing).contains("never improved"));
        // A run of no cycles still has a page.
        assert!(html(&facts, &TrainConfig::default(), &[], &nothing).contains("</html>"));
    }
}

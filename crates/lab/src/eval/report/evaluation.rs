//! The page of an evaluation: tables, plots, single queries, settings.

use super::html::{page, table};
use super::plots::plots;
use crate::datasets::Dataset;
use crate::eval::answers::DatasetAnswers;
use crate::eval::calibrate::Applied;
use crate::eval::measure::{Interval, RECALL_AT, Rejection};
use crate::eval::sequences::Certainty;
use crate::eval::summary::{AtK, GroupSummary, Summary};
use maud::{Markup, html};

/// The whole page. `details` follow the plots: single queries as pictures, an ablation table, or
/// nothing.
pub fn html(
    summary: &Summary,
    dataset: &Dataset,
    answers: &DatasetAnswers,
    details: &Markup,
) -> String {
    let config = serde_json::to_string_pretty(&summary.config).unwrap_or_default();
    let body = html! {
        (lead(summary))
        (recall_table(summary))
        (calibration_table(summary))
        (sequences_table(summary))
        (poses_table(summary))
        (groups_table(summary))
        (costs_tables(summary))
        h2 { "Plots" }
        (plots(summary, dataset, answers))
        (details)
        (problems(summary))
        h2 { "Settings" }
        pre { (config) }
    };
    page(&format!("Place recognition on {}", summary.dataset), &body)
}

/// What was measured, in a sentence or two.
fn lead(summary: &Summary) -> Markup {
    html! {
        p.lead {
            (summary.queries) " queries, " (summary.queries_with_match) " with a match and "
            (summary.queries_without_match) " without, against " (summary.database)
            " references. Model " code { (summary.config.model.as_str()) } "."
        }
        @if summary.queries_left_out > 0 {
            p {
                (summary.queries_left_out)
                " queries were asked again with their own place left out of the database. They \
                 judge rejection and confidences; recall is that of the first time."
            }
        }
    }
}

/// A cell of plain text.
fn text(value: impl AsRef<str>) -> Markup {
    html! { (value.as_ref()) }
}

fn percent(value: Option<f64>) -> String {
    value.map_or("-".into(), |value| format!("{value:.1}"))
}

/// What the recall table says about one ranking.
struct RecallRow<'a> {
    name: &'a str,
    recall: &'a AtK<Option<f64>>,
    intervals: &'a AtK<Interval>,
    map: &'a AtK<f64>,
    rejection: &'a Rejection,
}

impl RecallRow<'_> {
    fn cells(&self) -> Vec<Markup> {
        let mut cells = vec![text(self.name)];
        for k in RECALL_AT {
            let recall = percent(self.recall.get(&k).copied().flatten());
            cells.push(html! {
                (recall)
                @if let Some(interval) = self.intervals.get(&k) {
                    " " span.soft { (format!("[{:.1}, {:.1}]", interval.low, interval.high)) }
                }
            });
        }
        let map = self.map.values().last();
        cells.push(text(map.map_or("-".into(), |value| format!("{value:.3}"))));
        let rejection = self.rejection;
        cells.push(text(format!("{:.1}", rejection.recall_at_full_precision)));
        cells.push(text(format!("{:.3}", rejection.average_precision)));
        cells
    }
}

fn recall_table(summary: &Summary) -> Markup {
    let global = RecallRow {
        name: "global",
        recall: &summary.recall.global,
        intervals: &summary.recall_interval.global,
        map: &summary.map.global,
        rejection: &summary.rejection.global,
    };
    let mut rows = vec![global.cells()];
    if let (Some(recall), Some(intervals), Some(map), Some(rejection)) = (
        &summary.recall.reranked,
        &summary.recall_interval.reranked,
        &summary.map.reranked,
        &summary.rejection.reranked,
    ) {
        let reranked = RecallRow {
            name: "re-ranked",
            recall,
            intervals,
            map,
            rejection,
        };
        rows.push(reranked.cells());
    }
    let recalls = RECALL_AT.map(|k| format!("R@{k} [95%]"));
    let mut headers = vec!["ranking"];
    headers.extend(recalls.iter().map(String::as_str));
    headers.extend(["mAP@20", "R@1 at 100% precision", "AP of rejection"]);
    let caption = "Recall in percent over the queries that have a match, with bootstrap intervals \
                   (which take queries to be independent: where they follow each other along a \
                   street, the truth is wider)";
    table(caption, &headers, &rows)
}

fn calibration_table(summary: &Summary) -> Markup {
    let mut rows: Vec<Vec<String>> = Vec::new();
    if let Some(fitted) = &summary.calibration {
        let error = format!("{:.3}", fitted.expected_calibration_error);
        rows.push(vec![
            "fitted here, five-fold".into(),
            error,
            "-".into(),
            "-".into(),
            "-".into(),
        ]);
    }
    let applied = [
        ("the model's own", &summary.shipped_calibration),
        ("the one given", &summary.given_calibration),
    ];
    for (name, applied) in applied {
        let Some(Applied {
            expected_calibration_error,
            trusted,
            ..
        }) = applied
        else {
            continue;
        };
        rows.push(vec![
            name.into(),
            format!("{expected_calibration_error:.3}"),
            format!("{:.3}", trusted.threshold),
            format!("{:.1}", 100.0 * trusted.precision),
            format!("{:.1}", 100.0 * trusted.recall),
        ]);
    }
    if rows.is_empty() {
        return html! {};
    }
    let headers = [
        "confidence",
        "calibration error",
        "trusted from",
        "precision of those, %",
        "recall of those, %",
    ];
    table("How far confidences can be believed", &headers, &rows)
}

/// What tracks gain over single answers.
fn sequences_table(summary: &Summary) -> Markup {
    let Some(sequences) = &summary.sequences else {
        return html! {};
    };
    let recall = |recall: Option<&AtK<Option<f64>>>| {
        percent(recall.and_then(|recall| recall.get(&1).copied().flatten()))
    };
    let alone = summary.recall.reranked.as_ref();
    let alone = alone.unwrap_or(&summary.recall.global);
    let row = |name: &str, recall: String, certainty: &Certainty| {
        vec![
            name.to_owned(),
            recall,
            format!("{:.3}", certainty.expected_calibration_error),
            format!("{} of {}", certainty.trusted, certainty.judged),
            certainty.trusted_and_wrong.to_string(),
        ]
    };
    let rows = [
        row("alone", recall(Some(alone)), &sequences.alone),
        row(
            "tracked",
            recall(summary.recall.tracked.as_ref()),
            &sequences.tracked,
        ),
    ];
    let headers = [
        "frames",
        "R@1",
        "calibration error",
        "trusted",
        "of these wrong",
    ];
    let caption = "Queries in the order of their names: each frame alone, and as one of a track";
    table(caption, &headers, &rows)
}

fn poses_table(summary: &Summary) -> Markup {
    let Some(poses) = &summary.poses else {
        return html! {};
    };
    let rankings = [
        ("global", Some(&poses.global)),
        ("re-ranked", poses.reranked.as_ref()),
    ];
    let mut rows = Vec::new();
    for (name, accuracy) in rankings {
        if let Some(accuracy) = accuracy {
            let mut cells = vec![name.to_owned()];
            cells.extend(accuracy.iter().map(|a| format!("{:.1}", a.percent)));
            rows.push(cells);
        }
    }
    let headers = ["ranking", "0.25 m, 2 deg", "0.5 m, 5 deg", "5 m, 10 deg"];
    table(
        "Queries, in percent, whose best match has nearly their pose",
        &headers,
        &rows,
    )
}

fn groups_table(summary: &Summary) -> Markup {
    if summary.groups.is_empty() {
        return html! {};
    }
    let row = |(name, group): (&String, &GroupSummary)| {
        let global = |k| group.recall.global.get(&k).copied().flatten();
        let reranked = |k| group.recall.reranked.as_ref()?.get(&k).copied().flatten();
        let mut cells = vec![name.clone(), group.queries_with_match.to_string()];
        cells.extend([1, 5, 10].map(|k| percent(global(k))));
        cells.extend([1, 5, 10].map(|k| percent(reranked(k))));
        cells
    };
    let rows: Vec<Vec<String>> = summary.groups.iter().map(row).collect();
    let headers = [
        "part",
        "queries",
        "global R@1",
        "R@5",
        "R@10",
        "re-ranked R@1",
        "R@5",
        "R@10",
    ];
    table("By part of the data set", &headers, &rows)
}

fn costs_tables(summary: &Summary) -> Markup {
    let seconds = &summary.seconds;
    let ms = |seconds: f64| format!("{:.2}", seconds * 1e3);
    let times = vec![
        "milliseconds".into(),
        ms(seconds.decode),
        ms(seconds.extract),
        ms(seconds.search),
        ms(seconds.load),
        ms(seconds.rerank),
    ];
    let times_caption = format!(
        "Mean time per image and per query ({} candidates)",
        summary.config.candidates
    );
    let times_headers = ["", "decode", "extract", "search", "load", "re-rank"];
    let bytes = &summary.bytes;
    let kb = |bytes: f64| format!("{:.1}", bytes / 1e3);
    let sizes = vec![
        "kB".into(),
        kb(bytes.global),
        kb(bytes.pooled),
        kb(bytes.patches),
        kb(summary.bytes_per_reference),
    ];
    let sizes_caption = "Mean size of one reference at rest";
    let sizes_headers = ["", "global", "pooled", "key patches", "total"];
    html! {
        (table(&times_caption, &times_headers, &[times]))
        (table(sizes_caption, &sizes_headers, &[sizes]))
    }
}

/// Notes on the data, and the images that took no part.
fn problems(summary: &Summary) -> Markup {
    let unreadable: Vec<String> = summary
        .unreadable
        .iter()
        .map(|image| format!("{} {}: {}", image.side, image.name, image.reason))
        .collect();
    let skipped: Vec<String> = summary
        .skipped
        .iter()
        .map(|image| format!("{}: {}", image.name, image.reason))
        .collect();
    let unreadable_title = format!("{} images could not be read", unreadable.len());
    let skipped_title = format!("{} images were left out of the data set", skipped.len());
    let lists = [
        ("Notes", &summary.notes),
        (unreadable_title.as_str(), &unreadable),
        (skipped_title.as_str(), &skipped),
    ];
    if lists.iter().all(|(_, lines)| lines.is_empty()) {
        return html! {};
    }
    html! {
        h2 { "Images and data" }
        @for (title, lines) in lists {
            @if !lines.is_empty() {
                details {
                    summary { (title) }
                    ul.names {
                        @for line in lines {
                            li { (line) }
                        }
                    }
                }
            }
        }
    }
}

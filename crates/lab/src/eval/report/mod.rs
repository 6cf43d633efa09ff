//! Results for people: text, and a self-contained HTML page.

mod ablation;
mod gallery;
mod html;
mod plots;
mod svg;
mod text;

pub use ablation::{ablation_html, ablation_text};
pub use gallery::{Painter, gallery};
pub use html::{escape, page, table};
pub use plots::plots;
pub use svg::{Histogram, LineChart, Series};
pub use text::text;

use super::calibrate::Applied;
use super::measure::RECALL_AT;
use super::run::Answer;
use super::summary::{AtK, GroupSummary, Summary};
use crate::datasets::Dataset;

/// The whole page. `left_out` are answers that cannot be right, because the query's place was left
/// out. `details` is HTML that follows the plots: single queries as pictures, an ablation table, or
/// nothing.
pub fn html(
    summary: &Summary,
    dataset: &Dataset,
    answers: &[Answer],
    left_out: &[Answer],
    details: &str,
) -> String {
    let mut body = format!(
        "<p class=\"lead\">{} queries, {} with a match and {} without, against {} references. Model <code>{}</code>.</p>\n",
        summary.queries,
        summary.queries_with_match,
        summary.queries_without_match,
        summary.database,
        escape(summary.config.model.as_str())
    );
    if summary.queries_left_out > 0 {
        body += &format!(
            "<p>{} queries were asked again with their own place left out of the database. They judge rejection and \
             confidences; recall is that of the first time.</p>\n",
            summary.queries_left_out
        );
    }
    body += &recall_table(summary);
    body += &calibration_table(summary);
    body += &poses_table(summary);
    body += &groups_table(summary);
    body += &costs_table(summary);
    body += "<h2>Plots</h2>\n";
    body += &plots(summary, dataset, answers, left_out);
    body += details;
    body += &problems(summary);
    let config = serde_json::to_string_pretty(&summary.config).unwrap_or_default();
    body += &format!("<h2>Settings</h2>\n<pre>{}</pre>\n", escape(&config));
    page(&format!("Place recognition on {}", summary.dataset), &body)
}

fn percent(value: Option<f64>) -> String {
    value.map_or("-".into(), |value| format!("{value:.1}"))
}

fn recall_table(summary: &Summary) -> String {
    let mut headers = vec!["ranking".to_owned()];
    headers.extend(RECALL_AT.iter().map(|k| format!("R@{k} [95%]")));
    headers.extend(["mAP@20", "R@1 at 100% precision", "AP of rejection"].map(str::to_owned));
    let mut rows = Vec::new();
    let mut row = |name: &str,
                   recall: &AtK<Option<f64>>,
                   intervals: &AtK<_>,
                   map: &AtK<f64>,
                   rejection: &super::measure::Rejection| {
        let mut cells = vec![name.to_owned()];
        for k in RECALL_AT {
            let interval: Option<&super::measure::Interval> = intervals.get(&k);
            let range = interval.map_or(String::new(), |i| {
                format!(" <span class=\"soft\">[{:.1}, {:.1}]</span>", i.low, i.high)
            });
            cells.push(percent(recall.get(&k).copied().flatten()) + &range);
        }
        cells.push(
            map.values()
                .last()
                .map_or("-".into(), |value| format!("{value:.3}")),
        );
        cells.push(format!("{:.1}", rejection.recall_at_full_precision));
        cells.push(format!("{:.3}", rejection.average_precision));
        rows.push(cells);
    };
    row(
        "global",
        &summary.recall.global,
        &summary.recall_interval.global,
        &summary.map.global,
        &summary.rejection.global,
    );
    if let (Some(recall), Some(interval), Some(map), Some(rejection)) = (
        &summary.recall.reranked,
        &summary.recall_interval.reranked,
        &summary.map.reranked,
        &summary.rejection.reranked,
    ) {
        row("re-ranked", recall, interval, map, rejection);
    }
    let headers: Vec<&str> = headers.iter().map(String::as_str).collect();
    table(
        "Recall in percent over the queries that have a match, with bootstrap intervals (which take queries to be \
         independent: where they follow each other along a street, the truth is wider)",
        &headers,
        &rows,
    )
}

fn calibration_table(summary: &Summary) -> String {
    let mut rows = Vec::new();
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
    for (name, applied) in [
        ("the model's own", &summary.shipped_calibration),
        ("the one given", &summary.given_calibration),
    ] {
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
        return String::new();
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

fn poses_table(summary: &Summary) -> String {
    let Some(poses) = &summary.poses else {
        return String::new();
    };
    let mut rows = Vec::new();
    for (name, accuracy) in [
        ("global", Some(&poses.global)),
        ("re-ranked", poses.reranked.as_ref()),
    ] {
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

fn groups_table(summary: &Summary) -> String {
    if summary.groups.is_empty() {
        return String::new();
    }
    let row = |(name, group): (&String, &GroupSummary)| {
        let reranked = |k| {
            group
                .recall
                .reranked
                .as_ref()
                .and_then(|recall| recall.get(&k).copied().flatten())
        };
        let global = |k| group.recall.global.get(&k).copied().flatten();
        let mut cells = vec![escape(name), group.queries_with_match.to_string()];
        cells.extend([1, 5, 10].map(|k| percent(global(k))));
        cells.extend([1, 5, 10].map(|k| percent(reranked(k))));
        cells
    };
    let rows: Vec<_> = summary.groups.iter().map(row).collect();
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

fn costs_table(summary: &Summary) -> String {
    let s = &summary.seconds;
    let ms = |seconds: f64| format!("{:.2}", seconds * 1e3);
    let cells = vec![
        "milliseconds".into(),
        ms(s.decode),
        ms(s.extract),
        ms(s.search),
        ms(s.load),
        ms(s.rerank),
    ];
    let times = table(
        &format!(
            "Mean time per image and per query ({} candidates)",
            summary.config.candidates
        ),
        &["", "decode", "extract", "search", "load", "re-rank"],
        &[cells],
    );
    let b = &summary.bytes;
    let kb = |bytes: f64| format!("{:.1}", bytes / 1e3);
    let cells = vec![
        "kB".into(),
        kb(b.global),
        kb(b.pooled),
        kb(b.patches),
        kb(summary.bytes_per_reference),
    ];
    times
        + &table(
            "Mean size of one reference at rest",
            &["", "global", "pooled", "key patches", "total"],
            &[cells],
        )
}

fn problems(summary: &Summary) -> String {
    let mut out = String::new();
    let mut list = |title: String, names: Vec<String>| {
        if !names.is_empty() {
            let items: String = names
                .iter()
                .map(|name| format!("<li>{}</li>", escape(name)))
                .collect();
            out += &format!(
                "<details><summary>{}</summary><ul class=\"names\">{items}</ul></details>\n",
                escape(&title)
            );
        }
    };
    list("Notes".into(), summary.notes.clone());
    let unreadable: Vec<String> = summary
        .unreadable
        .iter()
        .map(|image| format!("{} {}: {}", image.side, image.name, image.reason))
        .collect();
    list(
        format!("{} images could not be read", unreadable.len()),
        unreadable,
    );
    let skipped: Vec<String> = summary
        .skipped
        .iter()
        .map(|image| format!("{}: {}", image.name, image.reason))
        .collect();
    list(
        format!("{} images were left out of the data set", skipped.len()),
        skipped,
    );
    if out.is_empty() {
        out
    } else {
        format!("<h2>Images and data</h2>\n{out}")
    }
}

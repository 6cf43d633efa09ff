//! The result as plain text for a terminal.

use crate::eval::calibrate::Applied;
use crate::eval::measure::RECALL_AT;
use crate::eval::summary::{AtK, Summary};
use std::fmt::Write;

/// A few lines a person reads first: recall, precision, time, size, and what went wrong.
pub fn text(summary: &Summary) -> String {
    let mut out = String::new();
    // Writing into a String cannot fail.
    let _ = writeln!(
        out,
        "{}: {} queries ({} with a match, {} without) against {} references",
        summary.dataset,
        summary.queries,
        summary.queries_with_match,
        summary.queries_without_match,
        summary.database
    );
    if summary.queries_left_out > 0 {
        let _ = writeln!(
            out,
            "{} queries were asked again with their own place left out: they judge rejection and confidences",
            summary.queries_left_out
        );
    }
    let _ = writeln!(out, "model {}\n", summary.config.model);
    recall_table(&mut out, summary);
    for (name, rejection) in stages(
        &summary.rejection.global,
        summary.rejection.reranked.as_ref(),
    ) {
        let _ = writeln!(
            out,
            "{name:<10} recall at 100% precision {:5.1}%, average precision {:.3}",
            rejection.recall_at_full_precision, rejection.average_precision
        );
    }
    for (name, poses) in summary
        .poses
        .iter()
        .flat_map(|poses| stages(&poses.global, poses.reranked.as_ref()))
    {
        let cells: Vec<String> = poses
            .iter()
            .map(|p| format!("{} m, {} deg: {:.1}%", p.metres, p.degrees, p.percent))
            .collect();
        let _ = writeln!(out, "{name:<10} pose within {}", cells.join("   "));
    }
    if let Some(calibration) = &summary.calibration {
        let _ = writeln!(
            out,
            "calibration error {:.3} (five-fold)",
            calibration.expected_calibration_error
        );
    }
    let applied = [
        ("the model's own curve", &summary.shipped_calibration),
        ("the calibration given", &summary.given_calibration),
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
        let _ = writeln!(
            out,
            "calibration error {expected_calibration_error:.3} of {name}, which trusts {} answers: precision {:.1}%, \
             recall {:.1}%",
            trusted.count,
            100.0 * trusted.precision,
            100.0 * trusted.recall
        );
    }
    let s = &summary.seconds;
    let _ = writeln!(
        out,
        "\nms per image: decode {:.1}, extract {:.1}; per query: search {:.2}, load {:.2}, rerank {:.1}",
        s.decode * 1e3,
        s.extract * 1e3,
        s.search * 1e3,
        s.load * 1e3,
        s.rerank * 1e3
    );
    let _ = writeln!(
        out,
        "{:.0} bytes per reference (global {:.0}, pooled {:.0}, patches {:.0})",
        summary.bytes_per_reference,
        summary.bytes.global,
        summary.bytes.pooled,
        summary.bytes.patches
    );
    problems(&mut out, summary);
    out
}

fn recall_table(out: &mut String, summary: &Summary) {
    let header: Vec<String> = RECALL_AT
        .iter()
        .map(|k| format!("{:>22}", format!("R@{k}")))
        .collect();
    let _ = writeln!(out, "{:<10}{}", "", header.concat());
    let intervals = [
        Some(&summary.recall_interval.global),
        summary.recall_interval.reranked.as_ref(),
    ];
    let maps = [Some(&summary.map.global), summary.map.reranked.as_ref()];
    let rows = stages(&summary.recall.global, summary.recall.reranked.as_ref());
    for (((name, recall), interval), map) in rows.into_iter().zip(intervals).zip(maps) {
        let (Some(interval), Some(map)) = (interval, map) else {
            continue;
        };
        let cells: Vec<String> = RECALL_AT
            .iter()
            .map(|k| match (cell(recall, *k), interval.get(k)) {
                (Some(value), Some(i)) => format!(
                    "{:>22}",
                    format!("{value:.1} [{:.1}, {:.1}]", i.low, i.high)
                ),
                _ => format!("{:>22}", "-"),
            })
            .collect();
        let map = map.values().last().copied().unwrap_or(0.0);
        let _ = writeln!(out, "{name:<10}{}   mAP@20 {map:.3}", cells.concat());
    }
}

fn cell(recall: &AtK<Option<f64>>, k: usize) -> Option<f64> {
    recall.get(&k).copied().flatten()
}

fn stages<'a, T>(global: &'a T, reranked: Option<&'a T>) -> Vec<(&'static str, &'a T)> {
    let mut rows = vec![("global", global)];
    rows.extend(reranked.map(|value| ("reranked", value)));
    rows
}

fn problems(out: &mut String, summary: &Summary) {
    for note in &summary.notes {
        let _ = writeln!(out, "note: {note}");
    }
    if !summary.skipped.is_empty() {
        let _ = writeln!(
            out,
            "note: {} images were left out of the data set (listed in the JSON)",
            summary.skipped.len()
        );
    }
    if !summary.unreadable.is_empty() {
        let _ = writeln!(
            out,
            "warning: {} images could not be read and take no part:",
            summary.unreadable.len()
        );
        for image in summary.unreadable.iter().take(10) {
            let _ = writeln!(out, "  {} {}: {}", image.side, image.name, image.reason);
        }
        if summary.unreadable.len() > 10 {
            let _ = writeln!(
                out,
                "  ... and {} more (listed in the JSON)",
                summary.unreadable.len() - 10
            );
        }
    }
}

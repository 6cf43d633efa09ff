//! The result as plain text for a terminal.

use crate::eval::calibrate::Applied;
use crate::eval::measure::{Interval, RECALL_AT};
use crate::eval::sequences::Finding;
use crate::eval::summary::{AtK, Summary};
use std::fmt::{self, Write};

/// A few lines a person reads first: recall, precision, time, size, and what went wrong.
pub fn text(summary: &Summary) -> String {
    let mut out = String::new();
    // Writing into a `String` cannot fail.
    let _ = write_all(&mut out, summary);
    out
}

fn write_all(out: &mut String, summary: &Summary) -> fmt::Result {
    writeln!(
        out,
        "{}: {} queries ({} with a match, {} without) against {} references",
        summary.dataset,
        summary.queries,
        summary.queries_with_match,
        summary.queries_without_match,
        summary.database
    )?;
    if summary.queries_left_out > 0 {
        writeln!(
            out,
            "{} queries were asked again with their own place left out: \
             they judge rejection and confidences",
            summary.queries_left_out
        )?;
    }
    writeln!(out, "model {}\n", summary.config.model)?;
    recall_table(out, summary)?;
    rejection(out, summary)?;
    poses(out, summary)?;
    calibration(out, summary)?;
    sequences(out, summary)?;
    costs(out, summary)?;
    problems(out, summary)
}

fn rejection(out: &mut String, summary: &Summary) -> fmt::Result {
    let rejection = &summary.rejection;
    for (name, rejection) in rankings(&rejection.global, rejection.reranked.as_ref()) {
        writeln!(
            out,
            "{name:<10} recall at 100% precision {:5.1}%, average precision {:.3}",
            rejection.recall_at_full_precision, rejection.average_precision
        )?;
    }
    Ok(())
}

fn poses(out: &mut String, summary: &Summary) -> fmt::Result {
    let Some(poses) = &summary.poses else {
        return Ok(());
    };
    for (name, poses) in rankings(&poses.global, poses.reranked.as_ref()) {
        let cells: Vec<String> = poses
            .iter()
            .map(|p| format!("{} m, {} deg: {:.1}%", p.metres, p.degrees, p.percent))
            .collect();
        writeln!(out, "{name:<10} pose within {}", cells.join("   "))?;
    }
    Ok(())
}

fn calibration(out: &mut String, summary: &Summary) -> fmt::Result {
    if let Some(calibration) = &summary.calibration {
        writeln!(
            out,
            "calibration error {:.3} (five-fold)",
            calibration.expected_calibration_error
        )?;
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
        writeln!(
            out,
            "calibration error {expected_calibration_error:.3} of {name}, \
             which trusts {} answers: precision {:.1}%, recall {:.1}%",
            trusted.count,
            100.0 * trusted.precision,
            100.0 * trusted.recall
        )?;
    }
    Ok(())
}

fn costs(out: &mut String, summary: &Summary) -> fmt::Result {
    let seconds = &summary.seconds;
    writeln!(
        out,
        "\nms per image: decode {:.1}, extract {:.1}; \
         per query: search {:.2}, load {:.2}, rerank {:.1}",
        seconds.decode * 1e3,
        seconds.extract * 1e3,
        seconds.search * 1e3,
        seconds.load * 1e3,
        seconds.rerank * 1e3
    )?;
    writeln!(
        out,
        "{:.0} bytes per reference (global {:.0}, pooled {:.0}, patches {:.0})",
        summary.bytes_per_reference,
        summary.bytes.global,
        summary.bytes.pooled,
        summary.bytes.patches
    )
}

fn recall_table(out: &mut String, summary: &Summary) -> fmt::Result {
    let header: Vec<String> = RECALL_AT
        .iter()
        .map(|k| format!("{:>22}", format!("R@{k}")))
        .collect();
    writeln!(out, "{:<10}{}", "", header.concat())?;
    let intervals = [
        Some(&summary.recall_interval.global),
        summary.recall_interval.reranked.as_ref(),
    ];
    let maps = [Some(&summary.map.global), summary.map.reranked.as_ref()];
    let rows = rankings(&summary.recall.global, summary.recall.reranked.as_ref());
    for (((name, recall), interval), map) in rows.into_iter().zip(intervals).zip(maps) {
        let (Some(interval), Some(map)) = (interval, map) else {
            continue;
        };
        let map = map.values().last().copied().unwrap_or(0.0);
        let cells = recall_cells(recall, interval);
        writeln!(out, "{name:<10}{cells}   mAP@20 {map:.3}")?;
    }
    let tracked = summary.recall.tracked.as_ref();
    if let Some((recall, interval)) = tracked.zip(summary.recall_interval.tracked.as_ref()) {
        writeln!(out, "{:<10}{}", "tracked", recall_cells(recall, interval))?;
    }
    Ok(())
}

fn recall_cells(recall: &AtK<Option<f64>>, intervals: &AtK<Interval>) -> String {
    let cell = |k: &usize| match (cell(recall, *k), intervals.get(k)) {
        (Some(value), Some(i)) => format!(
            "{:>22}",
            format!("{value:.1} [{:.1}, {:.1}]", i.low, i.high)
        ),
        _ => format!("{:>22}", "-"),
    };
    RECALL_AT.iter().map(cell).collect()
}

/// What tracks gain, and how far they can be believed.
fn sequences(out: &mut String, summary: &Summary) -> fmt::Result {
    let Some(sequences) = &summary.sequences else {
        return Ok(());
    };
    for (name, certainty) in [("alone", &sequences.alone), ("tracked", &sequences.tracked)] {
        writeln!(
            out,
            "{name:<10} calibration error {:.3}; {} of {} frames are trusted, {} of them wrong",
            certainty.expected_calibration_error,
            certainty.trusted,
            certainty.judged,
            certainty.trusted_and_wrong
        )?;
    }
    let findings = [
        ("found after", &sequences.first_found),
        (
            "carried elsewhere, found again after",
            &sequences.found_again,
        ),
    ];
    for (name, Finding { frames, never }) in findings {
        writeln!(out, "{name} {frames:?} frames, {never} times never")?;
    }
    writeln!(out, "lost after {} frames", sequences.frames_lost)?;
    if let (Some(error), Some(of_best)) =
        (sequences.median_error_m, sequences.median_error_of_best_m)
    {
        writeln!(
            out,
            "median error of trusted positions {error:.1} m, of their best reference {of_best:.1} m"
        )?;
        let shares = sequences.accuracy.iter();
        let shares: Vec<String> = shares
            .map(|at| format!("{:.0}%: {:.0}%", 100.0 * at.expected, 100.0 * at.observed))
            .collect();
        writeln!(
            out,
            "errors within the accuracy, expected: observed  {}",
            shares.join("  ")
        )?;
    }
    writeln!(out, "the filter takes {:.2} ms a frame", sequences.step_ms)
}

fn cell(recall: &AtK<Option<f64>>, k: usize) -> Option<f64> {
    recall.get(&k).copied().flatten()
}

/// The values of the rankings there are, with their names.
fn rankings<'a, T>(global: &'a T, reranked: Option<&'a T>) -> Vec<(&'static str, &'a T)> {
    let mut rows = vec![("global", global)];
    rows.extend(reranked.map(|value| ("reranked", value)));
    rows
}

fn problems(out: &mut String, summary: &Summary) -> fmt::Result {
    for note in &summary.notes {
        writeln!(out, "note: {note}")?;
    }
    if !summary.skipped.is_empty() {
        writeln!(
            out,
            "note: {} images were left out of the data set (listed in the JSON)",
            summary.skipped.len()
        )?;
    }
    if !summary.unreadable.is_empty() {
        writeln!(
            out,
            "warning: {} images could not be read and take no part:",
            summary.unreadable.len()
        )?;
        for image in summary.unreadable.iter().take(10) {
            writeln!(out, "  {} {}: {}", image.side, image.name, image.reason)?;
        }
        if summary.unreadable.len() > 10 {
            writeln!(
                out,
                "  ... and {} more (listed in the JSON)",
                summary.unreadable.len() - 10
            )?;
        }
    }
    Ok(())
}

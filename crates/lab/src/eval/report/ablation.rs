//! The ablation table for a terminal and for the page.

use super::html::table;
use crate::eval::ablate::AblationRow;
use crate::eval::summary::AtK;
use maud::{Markup, html};
use std::fmt::Write;

fn cell(recall: Option<&AtK<Option<f64>>>, k: usize) -> String {
    recall
        .and_then(|recall| recall.get(&k).copied().flatten())
        .map_or("-".into(), |value| format!("{value:.1}"))
}

fn numbers(row: &AblationRow) -> Vec<String> {
    let mut cells = Vec::new();
    for recall in [Some(&row.recall.global), row.recall.reranked.as_ref()] {
        cells.extend([1, 5, 10].map(|k| cell(recall, k)));
    }
    cells.push(format!("{:.0}", row.extract_seconds * 1e3));
    cells.push(format!("{:.1}", row.rerank_seconds * 1e3));
    cells.push(format!("{:.0}", row.patch_bytes / 1e3));
    cells
}

const HEADERS: [&str; 9] = [
    "gR@1",
    "gR@5",
    "gR@10",
    "R@1",
    "R@5",
    "R@10",
    "extract ms",
    "rerank ms",
    "patch kB",
];

/// Aligned columns; g marks the global ranking, a star the base setting.
pub fn ablation_text(rows: &[AblationRow]) -> String {
    let mut out = format!("{:<12}{:<18}", "axis", "setting");
    for header in HEADERS {
        out += &format!("{header:>11}");
    }
    out.push('\n');
    for row in rows {
        // Writing into a `String` cannot fail.
        let _ = write!(out, "{:<12}{:<18}", row.axis, row.setting);
        for cell in numbers(row) {
            let _ = write!(out, "{cell:>11}");
        }
        out.push('\n');
    }
    out
}

/// The same for a page.
pub fn ablation_html(rows: &[AblationRow]) -> Markup {
    let cells = |row: &AblationRow| {
        let mut cells = vec![row.axis.to_owned(), row.setting.clone()];
        cells.extend(numbers(row));
        cells
    };
    let mut headers = vec!["axis", "setting"];
    headers.extend(HEADERS);
    let caption = "One setting varied at a time; g marks the global ranking by the mean token, \
                   * the base setting";
    let rows: Vec<Vec<String>> = rows.iter().map(cells).collect();
    html! {
        h2 { "Ablation" }
        (table(caption, &headers, &rows))
    }
}

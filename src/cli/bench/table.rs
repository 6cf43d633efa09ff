//! Results as text.

use super::peers::QueryFigures;
use super::{EndToEndRow, Report};
use placeformer_lab::bench::BenchRow;
use std::fmt::Write;

/// What it ran on.
pub(super) fn machine(report: &Report) -> String {
    let limits = &report.limits;
    let optional =
        |value: Option<f64>| value.map_or("none".to_owned(), |value| format!("{value:.0}"));
    format!(
        "{} threads at {}; at most {:.0} GFLOP/s f32, {} bf16, {} GOP/s int8; memory {:.1} GB/s; \
         encoder {}",
        report.threads,
        report.simd,
        limits.f32_gflops,
        optional(limits.bf16_gflops),
        optional(limits.int8_gops),
        limits.read_gbytes,
        report.encoder,
    )
}

/// One line per stage.
pub(super) fn rows(rows: &[BenchRow]) -> String {
    let mut text = format!(
        "{:<20} {:>10} {:>12} {:>7} {:>9}  baseline\n",
        "stage", "ours ms", "baseline ms", "ratio", "of limit"
    );
    for row in rows {
        let share = format!("{:.0}%", row.limit_share * 100.0);
        // Writing into a `String` cannot fail.
        let _ = writeln!(
            text,
            "{:<20} {:>10.3} {:>12.3} {:>6.2}x {:>9}  {}",
            row.name, row.ours_ms, row.baseline_ms, row.ratio, share, row.baseline
        );
    }
    text
}

/// One line per number of references and clients.
pub(super) fn end_to_end(rows: &[EndToEndRow]) -> String {
    let mut text = format!(
        "{:>10} {:>7} {:>8} {:>9} {:>9} {:>8}  median ms per stage\n",
        "references", "clients", "queries", "p50 ms", "p99 ms", "q/s"
    );
    for row in rows {
        let _ = writeln!(
            text,
            "{:>10} {:>7} {}",
            row.references,
            row.clients,
            measured(&row.ours)
        );
        if let Some(peer) = &row.peer {
            let times = peer.p50_ms / row.ours.p50_ms;
            let _ = writeln!(
                text,
                "{:>10} {:>7} {} ({times:.1} times ours)",
                "peers",
                1,
                measured(peer)
            );
        }
    }
    text
}

fn measured(of: &QueryFigures) -> String {
    let stages: Vec<String> = of
        .stages_ms
        .iter()
        .map(|(stage, ms)| format!("{stage} {ms:.1}"))
        .collect();
    format!(
        "{:>8} {:>9.1} {:>9.1} {:>8.2}  {}; {} MiB resident",
        of.queries,
        of.p50_ms,
        of.p99_ms,
        of.queries_per_second,
        stages.join(", "),
        of.resident_bytes >> 20,
    )
}

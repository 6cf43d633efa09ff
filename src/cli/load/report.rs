//! The figures of a run.

use super::client::Outcome;
use hdrhistogram::Histogram;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

/// Counts and latencies while a run lasts.
pub(super) struct Tally {
    admitted: Histogram<u64>,
    rejected: Histogram<u64>,
    without_retry_after: u64,
    not_sent: u64,
    failures: BTreeMap<String, u64>,
}

impl Default for Tally {
    fn default() -> Self {
        Self {
            admitted: histogram(),
            rejected: histogram(),
            without_retry_after: 0,
            not_sent: 0,
            failures: BTreeMap::new(),
        }
    }
}

/// Microseconds from 1 to ten minutes at three significant digits.
fn histogram() -> Histogram<u64> {
    // Cannot fail: 1 <= 600e6 / 2 and 3 digits are within the crate's documented bounds.
    Histogram::new_with_bounds(1, 600_000_000, 3).expect("constant bounds are valid")
}

impl Tally {
    pub(super) fn add(&mut self, latency: Duration, outcome: Outcome) {
        let micros = latency.as_micros() as u64;
        match outcome {
            Outcome::Admitted => self.admitted.saturating_record(micros),
            Outcome::Rejected { retry_after } => {
                self.rejected.saturating_record(micros);
                self.without_retry_after += u64::from(!retry_after);
            }
            Outcome::Failed(reason) => *self.failures.entry(reason).or_default() += 1,
            Outcome::NotSent => self.not_sent += 1,
        }
    }
}

/// Latency in milliseconds at the usual points.
#[derive(Debug, Serialize)]
pub(super) struct Latency {
    p50: f64,
    p90: f64,
    p99: f64,
    p999: f64,
    max: f64,
}

impl From<&Histogram<u64>> for Latency {
    fn from(histogram: &Histogram<u64>) -> Self {
        let at = |quantile| histogram.value_at_quantile(quantile) as f64 / 1e3;
        Self {
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            p999: at(0.999),
            max: histogram.max() as f64 / 1e3,
        }
    }
}

/// What a run showed.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    /// Requests per second that were due.
    pub(super) rate: f64,
    /// Answers per second of the closed-loop measurement before, if one was made.
    pub(super) capacity: Option<f64>,
    /// Seconds.
    pub(super) duration: f64,
    /// Answered.
    pub(super) admitted: u64,
    /// Turned away.
    pub(super) rejected: u64,
    /// Of these, without a Retry-After header.
    pub(super) rejected_without_retry_after: u64,
    /// Neither answered nor turned away.
    pub(super) failed: u64,
    /// Never sent because too many were under way.
    pub(super) not_sent: u64,
    /// Milliseconds from the due time to the answer.
    pub(super) admitted_ms: Latency,
    /// Milliseconds from the due time to the rejection.
    pub(super) rejected_ms: Latency,
    /// The server's resident memory: at the start, highest, at the end.
    pub(super) resident_bytes: Option<[u64; 3]>,
    /// Its highest of the second half less its highest of the first: what a leak would grow, and
    /// warming up would not.
    pub(super) resident_growth_bytes: Option<i64>,
    /// What the failures said, with their number.
    pub(super) failures: BTreeMap<String, u64>,
}

impl Report {
    pub(super) fn new(
        rate: f64,
        capacity: Option<f64>,
        duration: f64,
        tally: Tally,
        memory: Vec<u64>,
    ) -> Self {
        let resident_bytes = match (memory.first(), memory.iter().max(), memory.last()) {
            (Some(&first), Some(&peak), Some(&last)) => Some([first, peak, last]),
            _ => None,
        };
        let (first, second) = memory.split_at(memory.len() / 2);
        let highest = |half: &[u64]| half.iter().max().map(|&bytes| bytes as i64);
        Self {
            rate,
            capacity,
            duration,
            admitted: tally.admitted.len(),
            rejected: tally.rejected.len(),
            rejected_without_retry_after: tally.without_retry_after,
            failed: tally.failures.values().sum(),
            not_sent: tally.not_sent,
            admitted_ms: Latency::from(&tally.admitted),
            rejected_ms: Latency::from(&tally.rejected),
            resident_bytes,
            resident_growth_bytes: highest(second)
                .zip(highest(first))
                .map(|(second, first)| second - first),
            failures: tally.failures,
        }
    }
}

/// What a run must keep to. Every rejection must carry Retry-After, and nothing may fail, in any
/// case.
#[derive(Debug, Default, clap::Args)]
pub(super) struct Bounds {
    /// Fail if the 99th percentile of answered queries is above this.
    #[arg(long, value_name = "MS")]
    pub(super) max_p99_ms: Option<f64>,
    /// Fail if the server's highest resident memory of the second half is more above that of the
    /// first.
    #[arg(long, value_name = "MIB")]
    pub(super) max_growth_mib: Option<f64>,
    /// Fail if fewer queries than this are answered per second.
    #[arg(long, value_name = "RATE")]
    pub(super) min_admitted_rate: Option<f64>,
}

impl Bounds {
    /// What the run broke, in words; nothing if it kept to everything.
    pub(super) fn broken_by(&self, report: &Report) -> Vec<String> {
        let mut broken = Vec::new();
        if report.rejected_without_retry_after > 0 {
            broken.push(format!(
                "{} rejections carried no Retry-After",
                report.rejected_without_retry_after
            ));
        }
        if report.failed > 0 {
            broken.push(format!(
                "{} requests failed with neither an answer nor a rejection",
                report.failed
            ));
        }
        if let Some(bound) = self.max_p99_ms
            && report.admitted_ms.p99 > bound
        {
            broken.push(format!(
                "the 99th percentile is {:.0} ms, above {bound} ms",
                report.admitted_ms.p99
            ));
        }
        let rate = report.admitted as f64 / report.duration;
        if let Some(bound) = self.min_admitted_rate
            && rate < bound
        {
            broken.push(format!(
                "{rate:.2} queries were answered per second, fewer than {bound}"
            ));
        }
        match (
            self.max_growth_mib,
            report.resident_growth_bytes.map(mebibytes),
        ) {
            (Some(bound), Some(growth)) if growth > bound => {
                broken.push(format!(
                    "the server's memory grew by {growth:.0} MiB, more than {bound} MiB"
                ));
            }
            (Some(_), None) => broken
                .push("the server's memory could not be read, so its growth is not known".into()),
            _ => {}
        }
        broken
    }
}

fn mebibytes(bytes: i64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(capacity) = self.capacity {
            writeln!(f, "capacity   {capacity:.2} queries/s (closed loop)")?;
        }
        writeln!(
            f,
            "offered    {:.2} queries/s for {:.0} s",
            self.rate, self.duration
        )?;
        writeln!(
            f,
            "admitted   {} ({:.2}/s)",
            self.admitted,
            self.admitted as f64 / self.duration
        )?;
        writeln!(
            f,
            "rejected   {} ({} without Retry-After)",
            self.rejected, self.rejected_without_retry_after
        )?;
        writeln!(f, "failed     {}", self.failed)?;
        writeln!(f, "not sent   {}", self.not_sent)?;
        for (name, latency) in [
            ("admitted", &self.admitted_ms),
            ("rejected", &self.rejected_ms),
        ] {
            writeln!(
                f,
                "{name}   ms: p50 {:.1}  p90 {:.1}  p99 {:.1}  p99.9 {:.1}  max {:.1}",
                latency.p50, latency.p90, latency.p99, latency.p999, latency.max
            )?;
        }
        if let Some([first, peak, last]) = self.resident_bytes {
            let mib = |bytes: u64| mebibytes(bytes as i64);
            writeln!(
                f,
                "resident   {:.0} MiB at the start, {:.0} highest, {:.0} at the end",
                mib(first),
                mib(peak),
                mib(last)
            )?;
        }
        if let Some(growth) = self.resident_growth_bytes {
            writeln!(
                f,
                "growth     {:+.1} MiB from the first half to the second",
                mebibytes(growth)
            )?;
        }
        for (reason, count) in &self.failures {
            writeln!(f, "  {count} x {reason}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_counts_each_outcome_once() {
        let mut tally = Tally::default();
        tally.add(Duration::from_millis(10), Outcome::Admitted);
        tally.add(Duration::from_millis(30), Outcome::Admitted);
        tally.add(
            Duration::from_millis(1),
            Outcome::Rejected { retry_after: true },
        );
        tally.add(
            Duration::from_millis(1),
            Outcome::Rejected { retry_after: false },
        );
        tally.add(Duration::ZERO, Outcome::Failed("500".into()));
        tally.add(Duration::ZERO, Outcome::NotSent);
        let report = Report::new(2.0, None, 3.0, tally, vec![5, 9, 7]);
        assert_eq!(
            (
                report.admitted,
                report.rejected,
                report.failed,
                report.not_sent
            ),
            (2, 2, 1, 1)
        );
        assert_eq!(
            (report.rejected_without_retry_after, report.resident_bytes),
            (1, Some([5, 9, 7]))
        );
        assert!((report.admitted_ms.max - 30.0).abs() < 0.1);
        assert_eq!(report.resident_growth_bytes, Some(4));
    }

    #[test]
    fn a_broken_bound_is_told_and_a_kept_one_is_not() {
        let report = |memory| {
            let mut tally = Tally::default();
            tally.add(Duration::from_millis(100), Outcome::Admitted);
            Report::new(1.0, None, 1.0, tally, memory)
        };
        let mebi = |count: u64| count << 20;
        let kept = Bounds {
            max_p99_ms: Some(110.0),
            max_growth_mib: Some(8.0),
            min_admitted_rate: Some(0.9),
        };
        assert_eq!(
            kept.broken_by(&report(vec![mebi(10), mebi(50), mebi(40), mebi(58)])),
            Vec::<String>::new()
        );
        let broken = Bounds {
            max_p99_ms: Some(90.0),
            max_growth_mib: Some(7.0),
            min_admitted_rate: Some(1.1),
        };
        assert_eq!(
            broken
                .broken_by(&report(vec![mebi(10), mebi(50), mebi(40), mebi(58)]))
                .len(),
            3
        );
        let unknown = broken.broken_by(&report(Vec::new()));
        assert!(
            unknown
                .iter()
                .any(|reason| reason.contains("could not be read")),
            "{unknown:?}"
        );
    }
}

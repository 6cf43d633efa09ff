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
        Self { p50: at(0.5), p90: at(0.9), p99: at(0.99), p999: at(0.999), max: histogram.max() as f64 / 1e3 }
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
    /// What the failures said, with their number.
    pub(super) failures: BTreeMap<String, u64>,
}

impl Report {
    pub(super) fn new(rate: f64, capacity: Option<f64>, duration: f64, tally: Tally, memory: Vec<u64>) -> Self {
        let resident_bytes = match (memory.first(), memory.iter().max(), memory.last()) {
            (Some(&first), Some(&peak), Some(&last)) => Some([first, peak, last]),
            _ => None,
        };
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
            failures: tally.failures,
        }
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(capacity) = self.capacity {
            writeln!(f, "capacity   {capacity:.2} queries/s (closed loop)")?;
        }
        writeln!(f, "offered    {:.2} queries/s for {:.0} s", self.rate, self.duration)?;
        writeln!(f, "admitted   {} ({:.2}/s)", self.admitted, self.admitted as f64 / self.duration)?;
        writeln!(f, "rejected   {} ({} without Retry-After)", self.rejected, self.rejected_without_retry_after)?;
        writeln!(f, "failed     {}", self.failed)?;
        writeln!(f, "not sent   {}", self.not_sent)?;
        for (name, latency) in [("admitted", &self.admitted_ms), ("rejected", &self.rejected_ms)] {
            writeln!(
                f,
                "{name}   ms: p50 {:.1}  p90 {:.1}  p99 {:.1}  p99.9 {:.1}  max {:.1}",
                latency.p50, latency.p90, latency.p99, latency.p999, latency.max
            )?;
        }
        if let Some([first, peak, last]) = self.resident_bytes {
            let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
            writeln!(
                f,
                "resident   {:.0} MiB at the start, {:.0} highest, {:.0} at the end",
                mib(first),
                mib(peak),
                mib(last)
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
        tally.add(Duration::from_millis(1), Outcome::Rejected { retry_after: true });
        tally.add(Duration::from_millis(1), Outcome::Rejected { retry_after: false });
        tally.add(Duration::ZERO, Outcome::Failed("500".into()));
        tally.add(Duration::ZERO, Outcome::NotSent);
        let report = Report::new(2.0, None, 3.0, tally, vec![5, 9, 7]);
        assert_eq!((report.admitted, report.rejected, report.failed, report.not_sent), (2, 2, 1, 1));
        assert_eq!((report.rejected_without_retry_after, report.resident_bytes), (1, Some([5, 9, 7])));
        assert!((report.admitted_ms.max - 30.0).abs() < 0.1);
    }
}

//! The figures of a run.

use super::target::RequestOutcome;
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
    /// Counts one request, with the time from when it was due until it was over.
    pub(super) fn add(&mut self, latency: Duration, outcome: RequestOutcome) {
        let micros = latency.as_micros() as u64;
        match outcome {
            RequestOutcome::Admitted => self.admitted.saturating_record(micros),
            RequestOutcome::Rejected { retry_after } => {
                self.rejected.saturating_record(micros);
                self.without_retry_after += u64::from(!retry_after);
            }
            RequestOutcome::Failed(reason) => *self.failures.entry(reason).or_default() += 1,
            RequestOutcome::NotSent => self.not_sent += 1,
        }
    }
}

/// Latency in milliseconds at the usual points.
#[derive(Debug, Serialize)]
pub(super) struct Latency {
    p50: f64,
    p90: f64,
    pub(super) p99: f64,
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
    /// Its highest of the second half less its highest of the first. A leak makes this grow, and a
    /// warm-up does not.
    pub(super) resident_growth_bytes: Option<i64>,
    /// What the failures said, with their number.
    pub(super) failures: BTreeMap<String, u64>,
}

impl Report {
    /// The figures of a run of `duration` seconds at `rate` requests per second. `memory` are the
    /// server's resident bytes, in the order sampled.
    pub(super) fn new(
        rate: f64,
        capacity: Option<f64>,
        duration: f64,
        tally: Tally,
        memory: Vec<u64>,
    ) -> Self {
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
            resident_bytes: resident(&memory),
            resident_growth_bytes: growth(&memory),
            failures: tally.failures,
        }
    }
}

/// The first, the highest and the last of the samples.
fn resident(memory: &[u64]) -> Option<[u64; 3]> {
    let first = *memory.first()?;
    let highest = *memory.iter().max()?;
    let last = *memory.last()?;
    Some([first, highest, last])
}

/// The highest sample of the second half less the highest of the first.
fn growth(memory: &[u64]) -> Option<i64> {
    let (first, second) = memory.split_at(memory.len() / 2);
    let first = *first.iter().max()?;
    let second = *second.iter().max()?;
    Some(second as i64 - first as i64)
}

/// Bytes as mebibytes.
pub(super) fn mebibytes(bytes: i64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.write_counts(f)?;
        write_latency(f, "admitted", &self.admitted_ms)?;
        write_latency(f, "rejected", &self.rejected_ms)?;
        self.write_memory(f)?;
        for (reason, count) in &self.failures {
            writeln!(f, "  {count} x {reason}")?;
        }
        Ok(())
    }
}

impl Report {
    fn write_counts(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            rate,
            duration,
            admitted,
            rejected,
            ..
        } = self;
        if let Some(capacity) = self.capacity {
            writeln!(f, "capacity   {capacity:.2} queries/s (closed loop)")?;
        }
        writeln!(f, "offered    {rate:.2} queries/s for {duration:.0} s")?;
        let admitted_rate = *admitted as f64 / duration;
        writeln!(f, "admitted   {admitted} ({admitted_rate:.2}/s)")?;
        let without = self.rejected_without_retry_after;
        writeln!(f, "rejected   {rejected} ({without} without Retry-After)")?;
        writeln!(f, "failed     {}", self.failed)?;
        writeln!(f, "not sent   {}", self.not_sent)
    }

    fn write_memory(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(resident) = self.resident_bytes {
            let [first, highest, last] = resident.map(|bytes| mebibytes(bytes as i64));
            writeln!(
                f,
                "resident   {first:.0} MiB at the start, {highest:.0} highest, {last:.0} at the end"
            )?;
        }
        if let Some(growth) = self.resident_growth_bytes {
            let growth = mebibytes(growth);
            writeln!(
                f,
                "growth     {growth:+.1} MiB from the first half to the second"
            )?;
        }
        Ok(())
    }
}

fn write_latency(f: &mut fmt::Formatter<'_>, name: &str, latency: &Latency) -> fmt::Result {
    let Latency {
        p50,
        p90,
        p99,
        p999,
        max,
    } = latency;
    writeln!(
        f,
        "{name}   ms: p50 {p50:.1}  p90 {p90:.1}  p99 {p99:.1}  p99.9 {p999:.1}  max {max:.1}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_counts_each_outcome_once() {
        let mut tally = Tally::default();
        tally.add(Duration::from_millis(10), RequestOutcome::Admitted);
        tally.add(Duration::from_millis(30), RequestOutcome::Admitted);
        tally.add(
            Duration::from_millis(1),
            RequestOutcome::Rejected { retry_after: true },
        );
        tally.add(
            Duration::from_millis(1),
            RequestOutcome::Rejected { retry_after: false },
        );
        tally.add(Duration::ZERO, RequestOutcome::Failed("500".into()));
        tally.add(Duration::ZERO, RequestOutcome::NotSent);
        let report = Report::new(2.0, None, 3.0, tally, vec![5, 9, 7]);
        assert_eq!((report.admitted, report.rejected), (2, 2));
        assert_eq!((report.failed, report.not_sent), (1, 1));
        assert_eq!(report.rejected_without_retry_after, 1);
        assert_eq!(report.resident_bytes, Some([5, 9, 7]));
        assert!((report.admitted_ms.max - 30.0).abs() < 0.1);
        assert_eq!(report.resident_growth_bytes, Some(4));
    }
}

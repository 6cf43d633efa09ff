//! What a run must keep to.

use super::report::{Report, mebibytes};

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
        let without = report.rejected_without_retry_after;
        if without > 0 {
            broken.push(format!("{without} rejections carried no Retry-After"));
        }
        let failed = report.failed;
        if failed > 0 {
            broken.push(format!(
                "{failed} requests failed with neither an answer nor a rejection"
            ));
        }
        broken.extend(self.slow(report));
        broken.extend(self.few(report));
        broken.extend(self.growing(report));
        broken
    }

    fn slow(&self, report: &Report) -> Option<String> {
        let bound = self.max_p99_ms?;
        let p99 = report.admitted_ms.p99;
        (p99 > bound).then(|| format!("the 99th percentile is {p99:.0} ms, above {bound} ms"))
    }

    fn few(&self, report: &Report) -> Option<String> {
        let bound = self.min_admitted_rate?;
        let rate = report.admitted as f64 / report.duration;
        (rate < bound)
            .then(|| format!("{rate:.2} queries were answered per second, fewer than {bound}"))
    }

    fn growing(&self, report: &Report) -> Option<String> {
        let bound = self.max_growth_mib?;
        let Some(growth) = report.resident_growth_bytes.map(mebibytes) else {
            return Some(
                "the server's memory could not be read, so its growth is not known".into(),
            );
        };
        (growth > bound)
            .then(|| format!("the server's memory grew by {growth:.0} MiB, more than {bound} MiB"))
    }
}

#[cfg(test)]
mod tests {
    use super::super::report::Tally;
    use super::super::target::RequestOutcome;
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_broken_bound_is_reported_and_a_kept_one_is_not() {
        let report = |memory| {
            let mut tally = Tally::default();
            tally.add(Duration::from_millis(100), RequestOutcome::Admitted);
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

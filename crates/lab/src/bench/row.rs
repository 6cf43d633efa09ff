//! One comparison of ours with a baseline.

use super::error::BenchError;
use serde::Serialize;

/// One comparison. Times are medians in milliseconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BenchRow {
    /// What was measured.
    pub name: String,
    /// Ours.
    pub ours_ms: f64,
    /// What it is compared with.
    pub baseline: String,
    /// The baseline.
    pub baseline_ms: f64,
    /// How many times faster ours is.
    pub ratio: f64,
    /// The time that the machine's limit allows at best, divided by ours. Above 1 where memory is
    /// the limit and the data fit a cache.
    pub limit_share: f64,
}

impl BenchRow {
    /// The row of two medians and a limit, all in milliseconds.
    ///
    /// # Errors
    /// A figure is not a finite number, which a report could not hold.
    pub(super) fn new(
        name: &str,
        baseline: &str,
        (ours_ms, baseline_ms): (f64, f64),
        limit_ms: f64,
    ) -> Result<Self, BenchError> {
        let ratio = baseline_ms / ours_ms;
        let limit_share = limit_ms / ours_ms;
        if !(ratio.is_finite() && limit_share.is_finite()) {
            return Err(BenchError::NotComparable {
                row: name.to_owned(),
                ours_ms,
                baseline_ms,
                limit_ms,
            });
        }
        Ok(Self {
            name: name.to_owned(),
            ours_ms,
            baseline: baseline.to_owned(),
            baseline_ms,
            ratio,
            limit_share,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_figure_of_a_row_is_a_number() {
        let row = BenchRow::new("a", "b", (2.0, 6.0), 1.0).unwrap();
        assert_eq!((row.ratio, row.limit_share), (3.0, 0.5));
        for (times, limit) in [
            ((0.0, 1.0), 1.0),
            ((f64::NAN, 1.0), 1.0),
            ((1.0, f64::NAN), 1.0),
            ((1.0, 1.0), f64::NAN),
        ] {
            assert!(matches!(
                BenchRow::new("a", "b", times, limit),
                Err(BenchError::NotComparable { .. })
            ));
        }
    }
}

//! Two things timed in turn.

use std::hint::black_box;
use std::time::Instant;

/// Medians in milliseconds of `ours` and `baseline`, run in turn `rounds` times after one unmeasured run of each.
pub(super) fn paired<A, B>(rounds: usize, mut ours: impl FnMut() -> A, mut baseline: impl FnMut() -> B) -> (f64, f64) {
    black_box(ours());
    black_box(baseline());
    let (mut our_times, mut baseline_times) = (Vec::new(), Vec::new());
    for round in 0..rounds {
        // Who goes first changes, so that neither always finds the caches as the other left them.
        if round % 2 == 0 {
            our_times.push(milliseconds(&mut ours));
            baseline_times.push(milliseconds(&mut baseline));
        } else {
            baseline_times.push(milliseconds(&mut baseline));
            our_times.push(milliseconds(&mut ours));
        }
    }
    (median(our_times), median(baseline_times))
}

/// Time of one run.
pub(super) fn milliseconds<T>(work: impl FnOnce() -> T) -> f64 {
    let started = Instant::now();
    black_box(work());
    started.elapsed().as_secs_f64() * 1e3
}

/// The middle value; NaN of none.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => values[n / 2],
        n => (values[n / 2 - 1] + values[n / 2]) / 2.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_the_middle_whatever_the_order() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), 2.5);
        assert!(median(vec![]).is_nan());
    }

    #[test]
    fn both_run_as_often_as_asked() {
        let (mut ours, mut baseline) = (0, 0);
        let (a, b) = paired(5, || ours += 1, || baseline += 1);
        assert_eq!((ours, baseline), (6, 6));
        assert!(a >= 0.0 && b >= 0.0);
    }
}

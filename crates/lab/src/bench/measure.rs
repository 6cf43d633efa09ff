//! Two things timed in turn.

use std::convert::Infallible;
use std::hint::black_box;
use std::time::Instant;

/// Medians in milliseconds of `ours` and `baseline`, run in turn `rounds` times after one
/// unmeasured run of each.
pub(super) fn paired<A, B>(
    rounds: usize,
    mut ours: impl FnMut() -> A,
    mut baseline: impl FnMut() -> B,
) -> (f64, f64) {
    let run = |work: &mut dyn FnMut()| -> Result<(), Infallible> {
        work();
        Ok(())
    };
    let mut ours = || drop(black_box(ours()));
    let mut baseline = || drop(black_box(baseline()));
    let Ok([ours, baseline]) =
        in_turn(rounds, [&mut || run(&mut ours), &mut || run(&mut baseline)]);
    (ours, baseline)
}

/// Medians in milliseconds of several works, run in turn `rounds` times after one unmeasured run of
/// each.
///
/// # Errors
/// The first that a work fails with.
pub(super) fn in_turn<const N: usize, E>(
    rounds: usize,
    mut works: [&mut dyn FnMut() -> Result<(), E>; N],
) -> Result<[f64; N], E> {
    works.iter_mut().try_for_each(|work| work())?;
    let mut times = [const { Vec::new() }; N];
    for round in 0..rounds {
        // The order changes from round to round. Otherwise each work would always run on caches
        // that the same other work has filled.
        for place in 0..N {
            let number = (round + place) % N;
            let mut outcome = Ok(());
            times[number].push(milliseconds(|| outcome = works[number]()));
            outcome?;
        }
    }
    Ok(times.map(median))
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
        let mut ours = 0;
        let mut baseline = 0;
        let (a, b) = paired(5, || ours += 1, || baseline += 1);
        assert_eq!((ours, baseline), (6, 6));
        assert!(a >= 0.0 && b >= 0.0);
    }

    #[test]
    fn a_failure_ends_the_measurement() {
        let mut left = 3;
        let mut failing = || {
            left -= 1;
            if left == 0 { Err("enough") } else { Ok(()) }
        };
        assert_eq!(in_turn(5, [&mut failing, &mut || Ok(())]), Err("enough"));
        assert_eq!(left, 0);
    }
}

//! Recall@k with bootstrap intervals, and average precision.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// The ranks at which recall is given (paper IV: 1, 5, 10; 20 as the field does).
pub const RECALL_AT: [usize; 4] = [1, 5, 10, 20];

/// A 95% interval in percent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    /// 2.5th percentile.
    pub low: f64,
    /// 97.5th percentile.
    pub high: f64,
}

/// The 0-based rank of the first positive.
pub fn first_hit(ranking: &[usize], positives: &[usize]) -> Option<usize> {
    ranking
        .iter()
        .position(|index| positives.binary_search(index).is_ok())
}

/// Percentage of queries whose first positive is among the top k; `first_hits` holds one entry per
/// query that has a match. `None` if there is no such query.
pub fn recall_at(first_hits: &[Option<usize>], k: usize) -> Option<f64> {
    let found = first_hits
        .iter()
        .flatten()
        .filter(|&&rank| rank < k)
        .count();
    (!first_hits.is_empty()).then(|| 100.0 * found as f64 / first_hits.len() as f64)
}

/// 95% percentile intervals of [`recall_at`] for every k, from `resamples` draws of as many queries
/// with replacement. The same seed gives the same interval.
pub fn bootstrap_recall(
    first_hits: &[Option<usize>],
    ks: &[usize],
    resamples: usize,
    seed: u64,
) -> Vec<Interval> {
    let n = first_hits.len();
    if n == 0 || resamples == 0 {
        return vec![
            Interval {
                low: 0.0,
                high: 100.0
            };
            ks.len()
        ];
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut samples = vec![Vec::with_capacity(resamples); ks.len()];
    for _ in 0..resamples {
        let mut found = vec![0usize; ks.len()];
        for _ in 0..n {
            if let Some(rank) = first_hits[random.random_range(0..n)] {
                for (count, &k) in found.iter_mut().zip(ks) {
                    *count += usize::from(rank < k);
                }
            }
        }
        for (sample, count) in samples.iter_mut().zip(found) {
            sample.push(100.0 * count as f64 / n as f64);
        }
    }
    samples.into_iter().map(interval).collect()
}

fn interval(mut sample: Vec<f64>) -> Interval {
    sample.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| sample[((sample.len() - 1) as f64 * share).round() as usize];
    Interval {
        low: at(0.025),
        high: at(0.975),
    }
}

/// Average precision of the first `k` answers, 0 to 1: the mean, over the hits, of the precision at
/// their rank, divided by the number of hits that were possible (as the MSLS evaluation defines
/// it).
pub fn average_precision(ranking: &[usize], positives: &[usize], k: usize) -> f64 {
    let possible = positives.len().min(k);
    if possible == 0 {
        return 0.0;
    }
    let mut hits = 0.0;
    let mut sum = 0.0;
    for (rank, index) in ranking.iter().take(k).enumerate() {
        if positives.binary_search(index).is_ok() {
            hits += 1.0;
            sum += hits / (rank + 1) as f64;
        }
    }
    sum / possible as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn recall_by_hand() {
        let hits = [Some(0), Some(4), Some(5), None];
        assert_eq!(
            [1, 5, 6, 20].map(|k| recall_at(&hits, k).unwrap()),
            [25.0, 50.0, 75.0, 75.0]
        );
        assert_eq!(recall_at(&[], 1), None);
        assert_eq!(first_hit(&[9, 4, 2], &[2, 4]), Some(1));
        assert_eq!(first_hit(&[9], &[2, 4]), None);
    }

    #[test]
    fn average_precision_by_hand() {
        // Hits at ranks 1 and 3: (1/1 + 2/3) / 2.
        assert!((average_precision(&[7, 1, 8], &[7, 8], 3) - 5.0 / 6.0).abs() < 1e-12);
        // Only one of two positives can be found at k = 1.
        assert_eq!(average_precision(&[7, 1, 8], &[7, 8], 1), 1.0);
        // The example in the MSLS evaluation: positives on ranks 4 and 2.
        assert!(
            (average_precision(&[0, 1, 2, 3, 4, 5], &[4, 5], 6) - (1.0 / 5.0 + 2.0 / 6.0) / 2.0)
                .abs()
                < 1e-12
        );
        assert_eq!(average_precision(&[1], &[], 5), 0.0);
    }

    #[test]
    fn intervals_have_the_width_theory_gives() {
        // 400 queries at 50%: the standard error is 2.5 points.
        let hits: Vec<_> = (0..400).map(|i| (i % 2 == 0).then_some(0)).collect();
        let Interval { low, high } = bootstrap_recall(&hits, &[1], 2000, 7)[0];
        assert!(
            (low - 45.1).abs() < 1.0 && (high - 54.9).abs() < 1.0,
            "{low} {high}"
        );
        let all = vec![Some(0); 10];
        assert_eq!(
            bootstrap_recall(&all, &[1], 100, 7)[0],
            Interval {
                low: 100.0,
                high: 100.0
            }
        );
    }

    fn hits() -> impl Strategy<Value = Vec<Option<usize>>> {
        prop::collection::vec(prop::option::of(0usize..30), 1..80)
    }

    proptest! {
        #[test]
        fn recall_grows_with_k_and_ignores_order(mut hits in hits()) {
            let before: Vec<_> = (1..30).map(|k| recall_at(&hits, k).unwrap()).collect();
            prop_assert!(before.windows(2).all(|pair| pair[0] <= pair[1]));
            prop_assert!(before.iter().all(|recall| (0.0..=100.0).contains(recall)));
            hits.reverse();
            let after: Vec<_> = (1..30).map(|k| recall_at(&hits, k).unwrap()).collect();
            prop_assert_eq!(before, after);
        }

        #[test]
        fn intervals_are_ordered_repeatable_and_bounded(hits in hits(), seed: u64) {
            let intervals = bootstrap_recall(&hits, &RECALL_AT, 50, seed);
            prop_assert_eq!(&intervals, &bootstrap_recall(&hits, &RECALL_AT, 50, seed));
            prop_assert!(intervals.iter().all(|i| 0.0 <= i.low && i.low <= i.high && i.high <= 100.0));
        }

        #[test]
        fn average_precision_is_one_exactly_when_positives_lead(n in 1usize..20, positives in 1usize..20) {
            let ranking: Vec<usize> = (0..n).collect();
            let wanted: Vec<usize> = (0..positives).collect();
            prop_assert!((average_precision(&ranking, &wanted, n) - 1.0).abs() < 1e-12);
            let missed: Vec<usize> = (100..100 + positives).collect();
            prop_assert_eq!(average_precision(&ranking, &missed, n), 0.0);
        }
    }
}

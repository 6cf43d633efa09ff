//! Rejecting unknown places: how far can an answer's score be trusted?
//!
//! An answer is accepted if its score reaches a threshold. Accepted and right counts for precision;
//! a wrong place, or any place where none exists, counts against it. Recall is over the queries
//! that have a match.

use serde::Serialize;

/// A query's best answer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Judged {
    /// Higher is surer.
    pub score: f64,
    /// Whether it is a positive.
    pub correct: bool,
    /// Whether the database shows the place at all.
    pub has_match: bool,
}

/// One threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PrecisionRecall {
    /// Answers with at least this score are accepted.
    pub threshold: f64,
    /// Accepted answers that are right, in percent of those accepted.
    pub precision: f64,
    /// Accepted answers that are right, in percent of the queries that have a match.
    pub recall: f64,
}

/// The whole curve and what is read off it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rejection {
    /// By descending threshold, one entry for each distinct score.
    pub curve: Vec<PrecisionRecall>,
    /// Largest recall, in percent, with no wrong answer accepted.
    pub recall_at_full_precision: f64,
    /// The threshold that gives it; absent if the highest score is wrong.
    pub full_precision_threshold: Option<f64>,
    /// Area under the curve, 0 to 1, by steps: precision weighted with the recall gained.
    pub average_precision: f64,
    /// Queries without a match among those judged.
    pub without_match: usize,
}

/// Sweeps the threshold over all scores; answers of equal score are accepted together.
pub fn rejection(answers: &[Judged]) -> Rejection {
    let mut sorted = answers.to_vec();
    sorted.sort_unstable_by(|a, b| b.score.total_cmp(&a.score));
    let with_match = answers.iter().filter(|answer| answer.has_match).count();
    let mut curve = Vec::new();
    let mut accepted = 0usize;
    let mut correct = 0usize;
    for same in sorted.chunk_by(|a, b| a.score.total_cmp(&b.score).is_eq()) {
        accepted += same.len();
        correct += same.iter().filter(|answer| answer.correct).count();
        curve.push(PrecisionRecall {
            threshold: same[0].score,
            precision: 100.0 * correct as f64 / accepted as f64,
            recall: if with_match == 0 {
                0.0
            } else {
                100.0 * correct as f64 / with_match as f64
            },
        });
    }
    // Precision is whole only until the first wrong answer; the last such threshold accepts most.
    let sure = curve
        .iter()
        .take_while(|point| point.precision >= 100.0)
        .last();
    let mut average_precision = 0.0;
    let mut recall_before = 0.0;
    for point in &curve {
        average_precision += (point.recall - recall_before) * point.precision / 1e4;
        recall_before = point.recall;
    }
    Rejection {
        recall_at_full_precision: sure.map_or(0.0, |point| point.recall),
        full_precision_threshold: sure.map(|point| point.threshold),
        average_precision,
        without_match: answers.len() - with_match,
        curve,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn judged(score: f64, correct: bool, has_match: bool) -> Judged {
        Judged {
            score,
            correct,
            has_match,
        }
    }

    #[test]
    fn a_curve_by_hand() {
        let answers = [
            judged(9.0, true, true),
            judged(8.0, true, true),
            judged(7.0, false, false),
            judged(6.0, true, true),
            judged(5.0, false, true),
        ];
        let result = rejection(&answers);
        assert_eq!(
            (
                result.recall_at_full_precision,
                result.full_precision_threshold
            ),
            (50.0, Some(8.0))
        );
        let points: Vec<_> = result
            .curve
            .iter()
            .map(|p| (p.precision.round(), p.recall))
            .collect();
        assert_eq!(
            points,
            [
                (100.0, 25.0),
                (100.0, 50.0),
                (67.0, 50.0),
                (75.0, 75.0),
                (60.0, 75.0)
            ]
        );
        assert!((result.average_precision - (0.25 + 0.25 + 0.25 * 0.75)).abs() < 1e-12);
        assert_eq!(result.without_match, 1);
    }

    #[test]
    fn equal_scores_stand_or_fall_together() {
        let answers = [
            judged(3.0, true, true),
            judged(3.0, false, false),
            judged(1.0, true, true),
        ];
        let result = rejection(&answers);
        assert_eq!(
            (
                result.recall_at_full_precision,
                result.full_precision_threshold
            ),
            (0.0, None)
        );
        assert_eq!(result.curve.len(), 2);
        assert_eq!(rejection(&[]).curve.len(), 0);
    }

    proptest! {
        #[test]
        fn thresholds_fall_recall_grows_and_the_last_point_accepts_all(
            raw in prop::collection::vec((0u8..20, 0u8..3), 1..60),
        ) {
            let answers: Vec<_> =
                raw.iter().map(|&(score, kind)| judged(f64::from(score), kind == 0, kind < 2)).collect();
            let result = rejection(&answers);
            prop_assert!(result.curve.windows(2).all(|p| p[0].threshold > p[1].threshold && p[0].recall <= p[1].recall));
            let correct = answers.iter().filter(|answer| answer.correct).count() as f64;
            let last = result.curve.last().unwrap();
            prop_assert!((last.precision - 100.0 * correct / answers.len() as f64).abs() < 1e-9);
            if let Some(threshold) = result.full_precision_threshold {
                prop_assert!(answers.iter().all(|answer| answer.correct || answer.score < threshold));
            }
            prop_assert!((-1e-12..=1.0 + 1e-12).contains(&result.average_precision));
        }
    }
}

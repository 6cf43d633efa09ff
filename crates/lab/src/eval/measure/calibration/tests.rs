//! Fits on planted truths, folds, thresholds by hand.

use super::super::answers::Prediction;
use super::super::cross_validation::Unseen;
use super::super::threshold::{trusted, wilson};
use super::*;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn answer(place: usize, spatial_score: f64, global_distance: f64, correct: bool) -> TopOne {
    TopOne {
        place,
        evidence: Some(spatial_score.ln_1p()),
        global_distance,
        correct,
        has_match: correct,
    }
}

fn prediction(confidence: f64, correct: bool) -> Prediction {
    Prediction {
        confidence,
        correct,
        has_match: correct,
    }
}

/// Answers whose rightness is drawn from `truth`.
fn drawn(truth: &ConfidenceWeights, count: usize, seed: u64) -> Vec<TopOne> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    (0..count)
        .map(|query| {
            let spatial_score = random.random_range(0.0..120.0);
            let distance = random.random_range(0.0..1.5);
            let correct = random.random::<f64>()
                < truth.confidence(Some(f64::ln_1p(spatial_score)), distance);
            answer(query, spatial_score, distance, correct)
        })
        .collect()
}

#[test]
fn planted_weights_are_recovered() {
    let truth = ConfidenceWeights {
        bias: -3.0,
        score: 1.5,
        distance: -2.0,
    };
    let answers = drawn(&truth, 20_000, 3);
    let fitted = fit(&answers, 1e-3).unwrap();
    for (a, b) in [
        (fitted.bias, truth.bias),
        (fitted.score, truth.score),
        (fitted.distance, truth.distance),
    ] {
        assert!((a - b).abs() < 0.25, "{fitted:?}");
    }
    assert!(calibration_error(&reliability(&predict(&fitted, &answers))) < 0.02);
    let unseen = predictions_of(&cross_validate(&answers, 1e-3, 5, 1));
    assert_eq!(unseen.len(), answers.len());
    assert!(calibration_error(&reliability(&unseen)) < 0.02);
}

#[test]
fn separable_answers_stay_finite_and_one_kind_is_refused() {
    let answers = [
        answer(0, 100.0, 0.5, true),
        answer(1, 90.0, 0.5, true),
        answer(2, 5.0, 0.5, false),
        answer(3, 8.0, 0.5, false),
    ];
    let fitted = fit(&answers, 1e-2).unwrap();
    assert!(
        fitted.confidence(Some(100.0f64.ln_1p()), 0.5) > 0.9
            && fitted.confidence(Some(5.0f64.ln_1p()), 0.5) < 0.1,
        "{fitted:?}"
    );
    assert!(fitted.score.is_finite());
    assert_eq!(
        fit(&answers[..2], 1e-2),
        Err(CalibrationError::OneSided { right: 2, wrong: 0 })
    );
}

#[test]
fn evidence_never_counts_against_itself() {
    // Farther answers happen to be right, and fewer inliers too: neither slope may say so.
    let answers: Vec<TopOne> = (0..40)
        .map(|i| {
            answer(
                i,
                10.0 + (i % 2) as f64,
                1.0 - (i % 2) as f64 * 0.5,
                i % 2 == 0,
            )
        })
        .collect();
    let fitted = fit(&answers, 1e-2).unwrap();
    assert_eq!((fitted.score, fitted.distance), (0.0, 0.0), "{fitted:?}");
    assert!((fitted.confidence(Some(10.0f64.ln_1p()), 0.7) - 0.5).abs() < 1e-6);
}

#[test]
fn answers_without_a_score_are_judged_by_distance_alone() {
    let truth = ConfidenceWeights {
        bias: 3.0,
        score: 0.0,
        distance: -4.0,
    };
    let mut answers = drawn(&truth, 4000, 8);
    answers.iter_mut().for_each(|answer| answer.evidence = None);
    let fitted = fit_curve(&answers, 0.9, 1).unwrap();
    let curve = &fitted.curve;
    assert_eq!(curve.weights.score, 0.0);
    assert!(
        (curve.weights.distance + 4.0).abs() < 0.5 && fitted.in_sample_error < 0.03,
        "{fitted:?}"
    );
    assert_eq!(curve.right + curve.wrong, 4000);
    // On places without a say the promise is kept only nearly, and the interval knows by how much.
    assert!(
        curve.precision >= 0.88 && fitted.check.interval[0] < 0.9 && 0.9 < fitted.check.interval[1],
        "{fitted:?}"
    );
    assert!(curve.recall > 0.3 && curve.threshold >= 0.5, "{curve:?}");
}

#[test]
fn answers_of_one_place_share_a_fold() {
    // Each place teaches the opposite of the other, so whoever is judged only by the other is never
    // judged well.
    let answers = [
        answer(0, 100.0, 0.5, true),
        answer(0, 0.0, 0.5, false),
        answer(1, 0.0, 0.5, true),
        answer(1, 100.0, 0.5, false),
    ];
    let unseen = predictions_of(&cross_validate(&answers, 1e-2, 2, 4));
    assert_eq!(unseen.len(), 4);
    assert!(
        unseen.iter().all(|one| if one.correct {
            one.confidence < 0.51
        } else {
            one.confidence > 0.49
        }),
        "{unseen:?}"
    );
    assert!(
        unseen.iter().any(|one| one.correct && one.confidence < 0.2),
        "{unseen:?}"
    );
}

#[test]
fn calibration_error_by_hand() {
    // Confidence 0.95 with half of them right; confidence 0.05 with none right.
    let predictions = [
        prediction(0.95, true),
        prediction(0.95, false),
        prediction(0.05, false),
        prediction(0.05, false),
    ];
    let error = calibration_error(&reliability(&predictions));
    assert!((error - (0.45 * 0.5 + 0.05 * 0.5)).abs() < 1e-12, "{error}");
    assert_eq!(calibration_error(&[]), 0.0);
}

#[test]
fn a_threshold_by_hand() {
    let confidences = [
        (0.99, true),
        (0.95, true),
        (0.9, false),
        (0.8, true),
        (0.7, true),
        (0.2, false),
    ];
    let predictions = confidences.map(|(confidence, correct)| prediction(confidence, correct));
    let strict = choose_threshold(&predictions, 1.0);
    assert_eq!(
        (
            strict.threshold,
            strict.count,
            strict.precision,
            strict.recall
        ),
        (0.95, 2, 1.0, 0.5)
    );
    let lenient = choose_threshold(&predictions, 0.8);
    assert_eq!(
        (
            lenient.threshold,
            lenient.count,
            lenient.precision,
            lenient.recall
        ),
        (0.5, 5, 0.8, 1.0)
    );
    let hopeless = choose_threshold(&[prediction(0.9, false), prediction(0.8, true)], 0.9);
    assert_eq!(
        (hopeless.threshold, hopeless.count, hopeless.recall),
        (1.0, 0, 0.0)
    );
}

#[test]
fn a_threshold_is_judged_where_it_was_not_chosen() {
    let one = |fold: usize, place: usize, confidence: f64, correct: bool| Unseen {
        fold,
        place,
        prediction: prediction(confidence, correct),
    };
    // Fold 0 alone would choose 0.6 and fold 1 alone 0.95: each is applied to the other.
    let unseen = [
        one(0, 0, 0.9, true),
        one(0, 0, 0.9, true),
        one(0, 1, 0.6, true),
        one(1, 2, 0.95, true),
        one(1, 3, 0.7, false),
        one(1, 3, 0.2, false),
    ];
    let check = check_threshold(&unseen, 1.0);
    // Of fold 0 nothing reaches 0.95; of fold 1 two reach 0.6, one of them wrong.
    assert_eq!(
        (check.count, check.places, check.precision, check.recall),
        (2, 2, 0.5, 0.25)
    );
    let all = predictions_of(&unseen);
    assert_eq!(
        choose_threshold(&all, 1.0).precision,
        1.0,
        "chosen and judged on the same answers it would look perfect"
    );
}

#[test]
fn few_places_leave_much_open() {
    // A textbook value: 10 of 10.
    let [low, high] = wilson(1.0, 10);
    assert!(
        (low - 0.7225).abs() < 1e-3 && high > 0.999_999,
        "{low} {high}"
    );
    assert_eq!(wilson(1.0, 0), [0.0, 1.0]);
    let [low, high] = wilson(0.5, 100);
    assert!(
        (low - 0.4038).abs() < 1e-3 && (high - 0.5962).abs() < 1e-3,
        "{low} {high}"
    );
}

#[test]
fn neighbouring_frames_no_longer_vouch_for_each_other() {
    // Ten frames of each place, all right or all wrong by the toss of a coin: nothing can be known
    // about a place that was not seen, however many frames there are.
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let answers: Vec<TopOne> = (0..40)
        .flat_map(|place| {
            let score = random.random_range(0.0..100.0);
            let correct = random.random::<bool>();
            (0..10).map(move |_| answer(place, score, 0.5, correct))
        })
        .collect();
    let fitted = fit_curve(&answers, 0.9, 3).unwrap();
    let [low, high] = fitted.check.interval;
    assert!(fitted.check.places <= 40 && high - low > 0.1, "{fitted:?}");
}

proptest! {
    #[test]
    fn a_threshold_keeps_its_promise_and_is_the_lowest_that_does(
        raw in prop::collection::vec((0u8..=100, any::<bool>()), 1..60), target in 0.3..1.0f64,
    ) {
        let predictions: Vec<_> = raw.iter().map(|&(c, right)| prediction(f64::from(c) / 100.0, right)).collect();
        let chosen = choose_threshold(&predictions, target);
        prop_assert!((0.5..=1.0).contains(&chosen.threshold));
        // Nothing is trusted, or the target is kept, or only certainty is trusted.
        prop_assert!(chosen.precision >= target || chosen.threshold == 1.0);
        for lower in predictions.iter().map(|one| one.confidence).filter(|c| (0.5..chosen.threshold).contains(c)) {
            prop_assert!(trusted(&predictions, lower).precision < target);
        }
    }

    #[test]
    fn fitted_curves_are_monotone_whatever_the_data(
        raw in prop::collection::vec((0.0..300.0f64, 0.0..2.0f64, any::<bool>()), 4..40),
    ) {
        let answers: Vec<_> = raw.iter().enumerate().map(|(i, &(s, d, right))| answer(i, s, d, right)).collect();
        if let Ok(fitted) = fit(&answers, RIDGE) {
            prop_assert!(fitted.score >= 0.0 && fitted.distance <= 0.0 && fitted.bias.is_finite(), "{fitted:?}");
        }
    }
}

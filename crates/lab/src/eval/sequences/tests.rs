//! Frames with known outcomes, and how a drive is cut.

use super::drive::{Estimated, Frame};
use super::measures::{self, Certainty, Finding};
use super::{SequenceOptions, legs, recall};
use placeformer_core::types::{ConfidenceCurve, ConfidenceWeights};
use proptest::prelude::*;
use std::time::Duration;

/// Trusts from 0.8 on.
fn curve() -> ConfidenceCurve {
    ConfidenceCurve {
        weights: ConfidenceWeights {
            bias: 0.0,
            score: 1.0,
            distance: -1.0,
        },
        threshold: 0.8,
        right: 1,
        wrong: 1,
        without_match: 0,
        precision: 1.0,
        recall: 1.0,
        expected_calibration_error: 0.0,
    }
}

fn frame(is_right: bool, probability: f64) -> Frame {
    Frame {
        ranking: vec![if is_right { 1 } else { 2 }, 1],
        positives: vec![1],
        is_judged: true,
        probability,
        is_lost: false,
        estimated: None,
        error_of_best_m: None,
        step: Duration::from_millis(2),
    }
}

#[test]
fn a_vehicle_is_found_once_it_is_right_and_trusted() {
    let frames = [
        frame(true, 0.5),
        frame(false, 0.9),
        frame(true, 0.9),
        frame(false, 0.9),
        frame(true, 0.9),
        frame(true, 0.1),
    ];
    let finding = Finding::of(&frames, &[0, 3, 5], &curve());
    assert_eq!((finding.frames.clone(), finding.never), (vec![2, 3], 1));
    assert_eq!(finding.median(), Some(3));
    assert_eq!(Finding::of(&frames, &[], &curve()).median(), None);
}

#[test]
fn confident_and_wrong_frames_are_counted() {
    let unknown = Frame {
        is_judged: false,
        ..frame(false, 0.9)
    };
    let frames = [
        frame(true, 0.9),
        frame(false, 0.9),
        frame(false, 0.1),
        unknown,
    ];
    let certainty = Certainty::of(&frames, &curve());
    assert_eq!(
        (
            certainty.trusted,
            certainty.trusted_and_wrong,
            certainty.judged
        ),
        (2, 1, 3)
    );
    assert_eq!(recall(&frames)[&1], Some(25.0));
    assert_eq!(measures::mean_step_ms(&frames), 2.0);
}

#[test]
fn errors_that_are_as_large_as_they_should_be_lie_on_the_line() {
    // The quantiles of a Rayleigh distribution whose 68 % are within 10 m.
    let at = |share: f64| Frame {
        estimated: Some(Estimated {
            accuracy_m: 10.0,
            error_m: 10.0 * ((1.0 - share).ln() / (1.0 - 0.68f64).ln()).sqrt(),
        }),
        ..frame(true, 0.9)
    };
    let mut frames: Vec<Frame> = (0..1000).map(|i| at((i as f64 + 0.5) / 1000.0)).collect();
    for point in measures::accuracy(&frames, &curve()) {
        assert!((point.expected - point.observed).abs() < 0.01, "{point:?}");
    }
    let median = measures::median_error(&frames, &curve()).unwrap();
    assert!((median - 7.8).abs() < 0.1, "{median}");
    // What is not trusted promises nothing.
    frames.iter_mut().for_each(|frame| frame.probability = 0.1);
    assert_eq!(measures::accuracy(&frames, &curve()), []);
    assert_eq!(measures::median_error(&frames, &curve()), None);
}

#[test]
fn options_that_are_no_positive_numbers_are_refused() {
    let good = SequenceOptions {
        frame_seconds: 1.0,
        max_speed_mps: 10.0,
        spacing_m: 5.0,
        odometry_error: Some(0.1),
        legs: 3,
        seed: 0,
    };
    assert!(good.check().is_ok());
    for bad in [
        SequenceOptions {
            frame_seconds: 0.0,
            ..good
        },
        SequenceOptions {
            max_speed_mps: f64::NAN,
            ..good
        },
        SequenceOptions {
            spacing_m: f64::INFINITY,
            ..good
        },
        SequenceOptions {
            odometry_error: Some(-0.1),
            ..good
        },
        SequenceOptions { legs: 1, ..good },
    ] {
        assert!(bad.check().is_err(), "{bad:?}");
    }
}

proptest! {
    #[test]
    fn legs_are_the_whole_drive_and_none_follows_its_own_end(
        count in 2usize..100, parts in 2usize..8,
    ) {
        let order: Vec<usize> = (0..count).collect();
        let legs = legs(&order, parts);
        let mut frames = legs.concat();
        for pair in legs.windows(2) {
            prop_assert!(pair[0].last().unwrap() + 1 != pair[1][0]);
        }
        frames.sort_unstable();
        prop_assert_eq!(frames, order);
    }
}

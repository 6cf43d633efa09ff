//! What must hold of any belief, motion and photo.

use super::*;
use crate::ground::Point;
use crate::motion::Travel;
use proptest::prelude::*;

fn at(x: f64, y: f64) -> Place {
    Place {
        point: Point::planar(x, y),
        heading: None,
    }
}

/// A street with a place every `step` metres.
fn street(places: usize, step: f64) -> Vec<Place> {
    (0..places).map(|i| at(i as f64 * step, 0.0)).collect()
}

fn within(reach_m: f64) -> Motion {
    Motion::new(Travel::Within { reach_m }, None).unwrap()
}

fn moved(distance_m: f64) -> Motion {
    let travel = Travel::Measured {
        distance_m,
        sigma_m: 1.0,
    };
    Motion::new(travel, None).unwrap()
}

fn sum(posterior: &Posterior) -> f64 {
    posterior.elsewhere() + posterior.places().iter().sum::<f64>()
}

/// A belief, a motion, targets and what a photo says about them.
#[derive(Debug, Clone)]
struct Case {
    belief: Belief,
    motion: Motion,
    targets: Vec<Place>,
    log_ratios: Vec<Option<f64>>,
}

fn case() -> impl Strategy<Value = Case> {
    let place = || (-200.0..200.0f64, -200.0..200.0f64).prop_map(|(x, y)| at(x, y));
    let weighted = (place(), 0.0..1.0f64);
    let ratio = prop::option::weighted(0.9, -30.0..30.0f64);
    (
        prop::collection::vec(weighted, 0..30),
        0.0..1.0f64,
        prop_oneof![
            (0.0..100.0f64).prop_map(within),
            (0.0..100.0f64).prop_map(moved)
        ],
        prop::collection::vec((place(), ratio), 0..40),
    )
        .prop_map(|(places, elsewhere, motion, targets)| {
            let (targets, log_ratios) = targets.into_iter().unzip();
            Case {
                belief: Belief::new(places, elsewhere),
                motion,
                targets,
                log_ratios,
            }
        })
}

impl Case {
    fn prediction(&self) -> Prediction {
        predict(
            &self.belief,
            &self.motion,
            &self.targets,
            FilterSettings::ON_THE_ROAD,
        )
    }

    fn posterior(&self) -> Posterior {
        self.prediction().posterior(&self.log_ratios)
    }
}

proptest! {
    #[test]
    fn a_posterior_sums_to_one(case in case()) {
        let posterior = case.posterior();
        prop_assert!((sum(&posterior) - 1.0).abs() < 1e-9, "{posterior:?}");
        prop_assert!(posterior.places().iter().all(|p| (0.0..=1.0).contains(p)));
    }

    #[test]
    fn the_order_of_references_does_not_matter(case in case(), turn in 0usize..40) {
        let straight = case.posterior();
        let mut turned = case.clone();
        let by = turn % case.targets.len().max(1);
        turned.targets.rotate_left(by);
        turned.log_ratios.rotate_left(by);
        let mut believed = case.belief.places.clone();
        believed.reverse();
        turned.belief = Belief::new(believed, case.belief.elsewhere);
        let posterior = turned.posterior();
        for (i, probability) in posterior.places().iter().enumerate() {
            let same = (i + by) % case.targets.len();
            prop_assert!((probability - straight.places()[same]).abs() < 1e-9);
        }
        prop_assert!((posterior.elsewhere() - straight.elsewhere()).abs() < 1e-9);
    }

    #[test]
    fn a_photo_that_says_the_same_of_every_place_leaves_the_prediction(case in case()) {
        let prediction = case.prediction();
        let ground: f64 = prediction.ground.iter().sum();
        let posterior = prediction.clone().posterior(&vec![Some(0.0); case.targets.len()]);
        for (i, probability) in posterior.places().iter().enumerate() {
            let returned = prediction.returning * prediction.ground[i] / ground;
            prop_assert!((probability - prediction.tracked[i] - returned).abs() < 1e-9);
        }
        prop_assert!((posterior.elsewhere() - prediction.elsewhere).abs() < 1e-9);
    }

    #[test]
    fn a_perfect_sensor_finds_the_place_in_one_frame(case in case(), right in 0usize..40) {
        prop_assume!(!case.targets.is_empty());
        let right = right % case.targets.len();
        let mut says = vec![Some(-60.0); case.targets.len()];
        says[right] = Some(60.0);
        let posterior = case.prediction().posterior(&says);
        prop_assert!(posterior.places()[right] > 0.999, "{posterior:?}");
    }

    #[test]
    fn a_photo_taken_twice_changes_no_probability_of_its_ground(
        ratio in -5.0..5.0f64, other in -5.0..5.0f64,
    ) {
        let once = [at(0.0, 0.0), at(500.0, 0.0)];
        let twice = [at(0.0, 0.0), at(0.0, 0.0), at(500.0, 0.0)];
        let belief = Belief::new(vec![(at(0.0, 0.0), 0.6), (at(500.0, 0.0), 0.1)], 0.3);
        let told = |targets: &[Place], ratios: &[Option<f64>]| {
            predict(&belief, &within(10.0), targets, FilterSettings::ON_THE_ROAD).posterior(ratios)
        };
        let one = told(&once, &[Some(ratio), Some(other)]);
        let two = told(&twice, &[Some(ratio), Some(ratio), Some(other)]);
        prop_assert!((one.elsewhere() - two.elsewhere()).abs() < 1e-9);
        prop_assert!((one.places()[1] - two.places()[2]).abs() < 1e-9);
        prop_assert!((one.density(0) - two.density(0)).abs() < 1e-9);
    }
}

#[test]
fn the_first_frame_is_as_sure_as_a_single_answer() {
    // Calibrated odds of 4 to 1, where half of all best answers are right: a ratio of 4.
    let targets = [at(0.0, 0.0), at(500.0, 0.0)];
    let first = predict(
        &Belief::unknown(),
        &within(0.0),
        &targets,
        FilterSettings::at_the_start(0.5),
    );
    let posterior = first.posterior(&[Some(4f64.ln()), Some(-20.0)]);
    let probability = posterior.probability_around(0, &targets);
    assert!((probability - 0.8).abs() < 1e-6, "{probability}");
}

#[test]
fn many_poor_answers_are_not_together_a_good_one() {
    let targets = street(100, 100.0);
    let first = predict(
        &Belief::unknown(),
        &within(0.0),
        &targets,
        FilterSettings::at_the_start(0.5),
    );
    let posterior = first.posterior(&vec![Some(-4.0); 100]);
    assert!(
        posterior.is_lost() && posterior.elsewhere() > 0.95,
        "{posterior:?}"
    );
}

#[test]
fn twins_are_told_apart_by_the_way_to_them() {
    // Places 3 and 15 look alike; the vehicle comes from place 2.
    let targets = street(20, 10.0);
    let belief = Belief::new(vec![(targets[2], 0.9)], 0.1);
    let mut says = vec![Some(-3.0); 20];
    says[3] = Some(3.0);
    says[15] = Some(3.0);
    let posterior =
        predict(&belief, &moved(10.0), &targets, FilterSettings::ON_THE_ROAD).posterior(&says);
    assert!(
        posterior.places()[3] > 5.0 * posterior.places()[15],
        "{posterior:?}"
    );
}

#[test]
fn a_kidnapped_vehicle_gets_lost_and_is_found_again() {
    let targets = street(200, 10.0);
    let mut belief = Belief::new(vec![(targets[20], 0.97)], 0.03);
    let photo_of = |place: usize| -> Vec<Option<f64>> {
        let near = |i: usize| if i.abs_diff(place) <= 1 { 4.0 } else { -4.0 };
        (0..200).map(|i| Some(near(i))).collect()
    };
    let mut found_after = None;
    for frame in 0..10 {
        // The odometry knows nothing of the lift to place 150.
        let place = 150 + frame;
        let prediction = predict(&belief, &moved(10.0), &targets, FilterSettings::ON_THE_ROAD);
        let posterior = prediction.posterior(&photo_of(place));
        let ranked =
            (0..200).max_by(|&a, &b| posterior.density(a).total_cmp(&posterior.density(b)));
        let best = ranked.unwrap();
        if best.abs_diff(place) <= 1 && posterior.probability_around(best, &targets) > 0.9 {
            found_after = Some(frame + 1);
            break;
        }
        let places = targets
            .iter()
            .copied()
            .zip(posterior.places().iter().copied());
        belief = Belief::new(places.collect(), posterior.elsewhere());
    }
    assert!(
        found_after.is_some_and(|frames| frames <= 4),
        "{found_after:?}"
    );
}

#[test]
fn a_way_that_leads_out_of_the_map_is_given_up() {
    let targets = street(5, 10.0);
    let belief = Belief::new(vec![(targets[0], 1.0)], 0.0);
    let prediction = predict(
        &belief,
        &moved(1000.0),
        &targets,
        FilterSettings::ON_THE_ROAD,
    );
    let posterior = prediction.posterior(&[None; 5]);
    assert!(posterior.is_lost(), "{posterior:?}");
}

#[test]
fn beliefs_of_nonsense_are_unknown() {
    let broken = Belief::new(vec![(at(0.0, 0.0), f64::NAN), (at(1.0, 0.0), -1.0)], 0.0);
    assert_eq!(broken.elsewhere(), 1.0);
    let partly = Belief::new(vec![(at(0.0, 0.0), f64::NAN), (at(1.0, 0.0), 3.0)], 1.0);
    assert_eq!((partly.places()[1].1, partly.elsewhere()), (0.75, 0.25));
}

//! How likely a vehicle came from one place to another since the last frame.
//!
//! With odometry the way is known to within its uncertainty; without, only how far the vehicle may
//! have come in the time between two frames. Either is widened by what a reference's position is
//! worth: a vehicle is said to be at a reference when it is merely nearer to it than to others, and
//! the reference was located by a receiver that errs by metres.

use crate::ground::Place;
use placeformer_core::types::InvalidValue;

/// How far the spot of a vehicle lies from that of its reference, as a standard deviation in
/// metres: some metres of the receiver, and half the usual distance between references.
const SPOT_SIGMA_M: f64 = 5.0;

/// Standard deviation of a reference's heading in degrees: compasses of phones err so much.
const HEADING_SIGMA_DEG: f64 = 15.0;

/// Share of turns that headings do not show, because a reference's heading is wrong.
const WRONG_HEADING_SHARE: f64 = 0.05;

/// Beyond so many standard deviations nothing is likely.
const CUTOFF_SIGMAS: f64 = 4.0;

/// Largest distance in metres that a motion may name: once around the Earth.
const LARGEST_DISTANCE_M: f64 = 4.0e7;

/// How far the vehicle came.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Travel {
    /// So far, by odometry.
    Measured {
        /// Distance in metres.
        distance_m: f64,
        /// Its standard deviation in metres.
        sigma_m: f64,
    },
    /// At most so far.
    Within {
        /// Distance in metres.
        reach_m: f64,
    },
}

/// How far the vehicle turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// Degrees, clockwise positive.
    degrees: f64,
    /// Standard deviation in degrees.
    sigma_deg: f64,
}

impl Turn {
    /// Largest turn in degrees that is taken: ten times around.
    const LARGEST_DEG: f64 = 3600.0;

    /// Checks both numbers.
    ///
    /// # Errors
    /// The turn is not finite or above 3600 degrees; its deviation is not in 0 (exclusive) to 360.
    pub fn new(degrees: f64, sigma_deg: f64) -> Result<Self, InvalidValue> {
        let largest = Self::LARGEST_DEG;
        if !(-largest..=largest).contains(&degrees) {
            let reason = format!("{degrees} is outside -{largest} to {largest} degrees");
            return Err(InvalidValue::new("turned_deg", reason));
        }
        if !(sigma_deg > 0.0 && sigma_deg <= 360.0) {
            let reason = format!("{sigma_deg} is not above 0 and at most 360 degrees");
            return Err(InvalidValue::new("turned_sigma_deg", reason));
        }
        Ok(Self { degrees, sigma_deg })
    }
}

/// What is known about the way between two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    travel: Travel,
    turn: Option<Turn>,
}

impl Motion {
    /// No motion at all, as before the first frame.
    pub const STILL: Self = Self {
        travel: Travel::Within { reach_m: 0.0 },
        turn: None,
    };

    /// Checks the travel.
    ///
    /// # Errors
    /// A distance or deviation is negative, not finite or farther than around the Earth.
    pub fn new(travel: Travel, turn: Option<Turn>) -> Result<Self, InvalidValue> {
        let (named, values) = match travel {
            Travel::Measured {
                distance_m,
                sigma_m,
            } => (["moved_m", "moved_sigma_m"], [distance_m, sigma_m]),
            Travel::Within { reach_m } => (["max_speed_mps", "max_speed_mps"], [reach_m, reach_m]),
        };
        for (field, value) in named.into_iter().zip(values) {
            // NaN is in no range.
            if !(0.0..=LARGEST_DISTANCE_M).contains(&value) {
                let reason = format!("{value} metres are outside 0 to {LARGEST_DISTANCE_M}");
                return Err(InvalidValue::new(field, reason));
            }
        }
        Ok(Self { travel, turn })
    }

    /// Farthest distance in metres that the vehicle is thought to have come.
    pub fn reach_m(&self) -> f64 {
        self.farthest_m() + CUTOFF_SIGMAS * self.sigma_m()
    }

    fn farthest_m(&self) -> f64 {
        match self.travel {
            Travel::Measured { distance_m, .. } => distance_m,
            Travel::Within { reach_m } => reach_m,
        }
    }

    /// Standard deviation of a distance between the references of two frames.
    fn sigma_m(&self) -> f64 {
        match self.travel {
            Travel::Measured { sigma_m, .. } => sigma_m.hypot(SPOT_SIGMA_M),
            Travel::Within { .. } => SPOT_SIGMA_M,
        }
    }

    /// The motion with its constants worked out, to be applied to many pairs of places.
    pub(crate) fn kernel(&self) -> Kernel {
        let reach_m = self.reach_m();
        let heading = self.turn.map(|turn| {
            // The headings of two references differ by the turn and by the errors of both.
            let variance = turn.sigma_deg.powi(2) + 2.0 * HEADING_SIGMA_DEG.powi(2);
            (turn.degrees, 0.5 / variance)
        });
        Kernel {
            squared_reach: reach_m * reach_m,
            nearest_m: match self.travel {
                Travel::Measured { distance_m, .. } => distance_m,
                Travel::Within { .. } => 0.0,
            },
            farthest_m: self.farthest_m(),
            half_precision: 0.5 / self.sigma_m().powi(2),
            heading,
        }
    }
}

/// A [`Motion`], ready to be applied.
pub(crate) struct Kernel {
    squared_reach: f64,
    /// Between these two distances everything is equally likely.
    nearest_m: f64,
    farthest_m: f64,
    half_precision: f64,
    /// The turn in degrees, and half the precision of a difference of headings.
    heading: Option<(f64, f64)>,
}

impl Kernel {
    /// How likely the vehicle came from one place to the other, 0 to 1, up to a common factor.
    pub(crate) fn weight(&self, from: &Place, to: &Place) -> f64 {
        let squared = from.point.squared_distance(to.point);
        if squared > self.squared_reach {
            return 0.0;
        }
        let distance_m = squared.sqrt();
        let beyond = (distance_m - self.farthest_m).max(self.nearest_m - distance_m);
        let by_distance = if beyond <= 0.0 {
            1.0
        } else {
            (-beyond * beyond * self.half_precision).exp()
        };
        by_distance * self.heading_weight(from, to)
    }

    fn heading_weight(&self, from: &Place, to: &Place) -> f64 {
        let (Some((turned, half_precision)), Some(before), Some(after)) =
            (self.heading, from.heading, to.heading)
        else {
            return 1.0;
        };
        let error = degrees_apart(after.degrees(), before.degrees() + turned);
        let agrees = (-error * error * half_precision).exp();
        WRONG_HEADING_SHARE + (1.0 - WRONG_HEADING_SHARE) * agrees
    }
}

/// The angle between two directions, 0 to 180 degrees.
pub(crate) fn degrees_apart(a: f64, b: f64) -> f64 {
    let difference = (a - b).rem_euclid(360.0);
    difference.min(360.0 - difference)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::Point;
    use placeformer_core::types::Heading;
    use proptest::prelude::*;

    fn at(x: f64, heading: Option<f64>) -> Place {
        Place {
            point: Point::planar(x, 0.0),
            heading: heading.map(|degrees| Heading::new(degrees).unwrap()),
        }
    }

    fn measured(distance_m: f64, sigma_m: f64) -> Motion {
        let travel = Travel::Measured {
            distance_m,
            sigma_m,
        };
        Motion::new(travel, None).unwrap()
    }

    #[test]
    fn odometry_prefers_the_distance_it_measured() {
        let kernel = measured(40.0, 2.0).kernel();
        let weight = |x: f64| kernel.weight(&at(0.0, None), &at(x, None));
        assert_eq!(weight(40.0), 1.0);
        assert_eq!(weight(-40.0), 1.0);
        assert!(weight(0.0) < 1e-6 && weight(50.0) < weight(45.0) && weight(45.0) < 1.0);
        assert_eq!(weight(500.0), 0.0);
    }

    #[test]
    fn without_odometry_all_that_is_in_reach_is_equally_likely() {
        let motion = Motion::new(Travel::Within { reach_m: 30.0 }, None).unwrap();
        let kernel = motion.kernel();
        let weight = |x: f64| kernel.weight(&at(0.0, None), &at(x, None));
        assert_eq!((weight(0.0), weight(30.0)), (1.0, 1.0));
        assert!(weight(36.0) < 1.0 && weight(36.0) > 0.0);
        assert_eq!(weight(motion.reach_m() + 1.0), 0.0);
    }

    #[test]
    fn a_turn_prefers_references_that_look_that_way() {
        let travel = Travel::Within { reach_m: 30.0 };
        let turn = Turn::new(90.0, 5.0).unwrap();
        let kernel = Motion::new(travel, Some(turn)).unwrap().kernel();
        let weight = |to: Option<f64>| kernel.weight(&at(0.0, Some(350.0)), &at(1.0, to));
        assert!((weight(Some(80.0)) - 1.0).abs() < 1e-12);
        assert!(weight(Some(260.0)) < 0.06);
        assert_eq!(weight(None), 1.0, "an unknown heading says nothing");
    }

    #[test]
    fn motions_that_are_no_numbers_or_out_of_range_are_refused() {
        for value in [f64::NAN, f64::INFINITY, -1.0, 1e12] {
            assert!(Motion::new(Travel::Within { reach_m: value }, None).is_err());
            for (distance_m, sigma_m) in [(value, 1.0), (1.0, value)] {
                let travel = Travel::Measured {
                    distance_m,
                    sigma_m,
                };
                assert!(Motion::new(travel, None).is_err(), "{travel:?}");
            }
        }
        for (degrees, sigma) in [
            (f64::NAN, 1.0),
            (1e6, 1.0),
            (0.0, 0.0),
            (0.0, -1.0),
            (0.0, f64::NAN),
        ] {
            assert!(Turn::new(degrees, sigma).is_err(), "{degrees} {sigma}");
        }
    }

    proptest! {
        #[test]
        fn a_weight_is_a_share_whatever_the_motion(
            distance_m in 0.0..1e5f64, sigma_m in 0.0..1e3f64, x in -1e6..1e6f64,
            degrees in -3600.0..3600.0f64, before in 0.0..360.0f64, after in 0.0..360.0f64,
        ) {
            let travel = Travel::Measured { distance_m, sigma_m };
            let turn = Turn::new(degrees, 1.0).unwrap();
            let kernel = Motion::new(travel, Some(turn)).unwrap().kernel();
            let weight = kernel.weight(&at(0.0, Some(before)), &at(x, Some(after)));
            prop_assert!((0.0..=1.0).contains(&weight));
        }
    }
}

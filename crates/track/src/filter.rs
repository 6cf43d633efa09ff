//! Belief about where a vehicle is: predicted by its motion, weighed by a photo.
//!
//! The vehicle is at one of some hundred places or elsewhere: at a place of the map that nothing
//! points to, or beyond the map. From one frame to the next a place passes its probability on to
//! the places in reach ([`predict`]). A share is given up, as if the vehicle had been moved by
//! other means, and what leads to no place of the map is given up as well. Then every place is
//! weighed by what the photo says about it ([`Prediction::posterior`]).
//!
//! # Ground, not photos
//!
//! A map has many photos of one corner and few of the next. A vehicle is not likelier to be where
//! there are more photos, so a place counts by the ground that it stands for: the inverse of the
//! number of places around it. Ranks compare density, which is probability by ground, so that ten
//! photos of a corner do not lose to one of a street merely because they share its probability.
//!
//! # Coming back
//!
//! From elsewhere the vehicle comes to a place of the map now and then. Which one, only the photo
//! can tell, and its scores were calibrated on best answers: a confidence is the probability that
//! the best of all places is right. So what comes back is shared among the places as their
//! evidence compares, instead of being offered to each in full: a hundred poor answers are not
//! together a good one.

use crate::ground::Place;
use crate::motion::Motion;

/// Places within so many metres show the same: the distance within which an answer counts as right
/// in the field's evaluations.
pub const PLACE_RADIUS_M: f64 = 25.0;

/// Places within so many metres stand for the same ground.
const SHARED_GROUND_M: f64 = 10.0;

/// Where a vehicle is thought to be. Probabilities, which sum to one.
#[derive(Debug, Clone, PartialEq)]
pub struct Belief {
    places: Vec<(Place, f64)>,
    elsewhere: f64,
}

impl Belief {
    /// Nothing is known.
    pub fn unknown() -> Self {
        Self {
            places: Vec::new(),
            elsewhere: 1.0,
        }
    }

    /// From weights, which are scaled to sum to one. Weights that are negative or not finite count
    /// as zero; if nothing is left, nothing is known.
    pub fn new(places: Vec<(Place, f64)>, elsewhere: f64) -> Self {
        let sound = |weight: f64| {
            if weight.is_finite() {
                weight.max(0.0)
            } else {
                0.0
            }
        };
        let elsewhere = sound(elsewhere);
        let total: f64 = elsewhere + places.iter().map(|place| sound(place.1)).sum::<f64>();
        if total <= 0.0 || !total.is_finite() {
            return Self::unknown();
        }
        let scaled = |(place, weight)| (place, sound(weight) / total);
        Self {
            places: places.into_iter().map(scaled).collect(),
            elsewhere: elsewhere / total,
        }
    }

    /// The places with their probabilities.
    pub fn places(&self) -> &[(Place, f64)] {
        &self.places
    }

    /// Probability of being at none of them.
    pub fn elsewhere(&self) -> f64 {
        self.elsewhere
    }
}

/// How a belief changes from one frame to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FilterSettings {
    /// Share of what is believed of places that is given up.
    pub lost_share: f64,
    /// Share of what is elsewhere that comes to places of the map.
    pub returning_share: f64,
    /// Power to which the evidence of a photo is raised. Photos of one street resemble each other,
    /// and so do their mistakes: below 1, the second photo of a wrong place convinces less than if
    /// it were independent of the first.
    pub evidence_power: f64,
}

impl FilterSettings {
    /// For a frame that follows another. One frame in fifty being no continuation of the last is
    /// far more than happens; it keeps a track that follows the wrong street from taking longer
    /// than a few frames to be given up. Chosen on drives: see `eval --sequences`.
    pub const ON_THE_ROAD: Self = Self {
        lost_share: 0.02,
        returning_share: 0.2,
        evidence_power: 0.5,
    };

    /// For the first frame, which is in the map with probability `in_map`. It is as sure as a
    /// single answer.
    pub fn at_the_start(in_map: f64) -> Self {
        Self {
            lost_share: 0.0,
            returning_share: in_map,
            evidence_power: 1.0,
        }
    }
}

/// Where a vehicle is expected before its photo is looked at.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// Probability of each target, by the motion alone.
    tracked: Vec<f64>,
    /// The ground that each target stands for: 1 for one that is alone.
    ground: Vec<f64>,
    /// Probability of coming from elsewhere to some target.
    returning: f64,
    elsewhere: f64,
    evidence_power: f64,
}

/// Moves a belief along with the vehicle, to the places `targets`.
pub fn predict(
    belief: &Belief,
    motion: &Motion,
    targets: &[Place],
    settings: FilterSettings,
) -> Prediction {
    let kernel = motion.kernel();
    let ground = ground_of(targets);
    let mut tracked = vec![0.0; targets.len()];
    let mut elsewhere = belief.elsewhere;
    let mut weights = vec![0.0; targets.len()];
    for (source, probability) in &belief.places {
        let mut total = 0.0;
        for ((weight, target), ground) in weights.iter_mut().zip(targets).zip(&ground) {
            *weight = kernel.weight(source, target) * ground;
            total += *weight;
        }
        if total <= 0.0 {
            // The way leads to no place of the map.
            elsewhere += probability;
            continue;
        }
        elsewhere += probability * settings.lost_share;
        let kept = probability * (1.0 - settings.lost_share) / total;
        for (tracked, weight) in tracked.iter_mut().zip(&weights) {
            *tracked += kept * weight;
        }
    }
    let returning = if targets.is_empty() {
        0.0
    } else {
        elsewhere * settings.returning_share
    };
    Prediction {
        tracked,
        ground,
        returning,
        elsewhere: elsewhere - returning,
        evidence_power: settings.evidence_power,
    }
}

/// The ground that each place stands for: the inverse of how many stand for the same.
fn ground_of(places: &[Place]) -> Vec<f64> {
    let squared_radius = SHARED_GROUND_M * SHARED_GROUND_M;
    let mut around = vec![1u32; places.len()];
    for (i, a) in places.iter().enumerate() {
        for (j, b) in places.iter().enumerate().skip(i + 1) {
            if a.point.squared_distance(b.point) <= squared_radius {
                around[i] += 1;
                around[j] += 1;
            }
        }
    }
    around
        .into_iter()
        .map(|count| 1.0 / f64::from(count))
        .collect()
}

impl Prediction {
    /// Probability by ground of each target, by the motion alone: those with the most deserve to be
    /// looked at.
    pub fn density(&self, target: usize) -> f64 {
        self.tracked[target] / self.ground[target]
    }

    /// Weighs every target by what the photo says about it: the logarithm of how much likelier the
    /// photo is there than elsewhere. A target that was not compared with the photo (`None`) counts
    /// as the poorest of those that were, which keeps it from winning by not being looked at.
    ///
    /// # Panics
    /// If there are not as many as targets.
    pub fn posterior(self, log_ratios: &[Option<f64>]) -> Posterior {
        assert_eq!(log_ratios.len(), self.tracked.len(), "evidence of targets");
        let poorest = log_ratios.iter().flatten().copied().reduce(f64::min);
        let poorest = poorest.unwrap_or(0.0);
        let log_ratios: Vec<f64> = log_ratios
            .iter()
            .map(|ratio| self.evidence_power * ratio.unwrap_or(poorest))
            .collect();

        // Everything is divided by the largest ratio, so that nothing overflows; elsewhere has a
        // ratio of its own, whose logarithm is 0.
        let best = log_ratios.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let largest = best.max(0.0);
        let shares: Vec<f64> = log_ratios
            .iter()
            .zip(&self.ground)
            .map(|(ratio, ground)| ground * (ratio - best).exp())
            .collect();
        let all_shares: f64 = shares.iter().sum();
        let mut places = Vec::with_capacity(log_ratios.len());
        for ((ratio, tracked), share) in log_ratios.iter().zip(&self.tracked).zip(&shares) {
            // The sum of shares is not zero, unless there are no places: the largest is not.
            let returned = self.returning * share / all_shares;
            places.push((tracked + returned) * (ratio - largest).exp());
        }
        let elsewhere = self.elsewhere * (-largest).exp();
        Posterior::scaled(places, self.ground, elsewhere)
    }
}

/// Where a vehicle is thought to be after its photo was looked at. Probabilities, which sum to one.
#[derive(Debug, Clone, PartialEq)]
pub struct Posterior {
    /// Of each target.
    places: Vec<f64>,
    ground: Vec<f64>,
    elsewhere: f64,
}

impl Posterior {
    fn scaled(mut places: Vec<f64>, ground: Vec<f64>, mut elsewhere: f64) -> Self {
        let total = elsewhere + places.iter().sum::<f64>();
        if total > 0.0 {
            places.iter_mut().for_each(|place| *place /= total);
            elsewhere /= total;
        } else {
            // Certainty of what the photo excludes: nothing is known.
            places.fill(0.0);
            elsewhere = 1.0;
        }
        Self {
            places,
            ground,
            elsewhere,
        }
    }

    /// Probability of each target.
    pub fn places(&self) -> &[f64] {
        &self.places
    }

    /// Probability of being at none of them.
    pub fn elsewhere(&self) -> f64 {
        self.elsewhere
    }

    /// Whether the vehicle is more likely at no known place.
    pub fn is_lost(&self) -> bool {
        self.elsewhere >= 0.5
    }

    /// Probability by ground, by which places are ranked.
    pub fn density(&self, target: usize) -> f64 {
        self.places[target] / self.ground[target]
    }

    /// Probability that the vehicle is where `best` shows it: at any of `targets` within
    /// [`PLACE_RADIUS_M`] of that one.
    pub fn probability_around(&self, best: usize, targets: &[Place]) -> f64 {
        let squared_radius = PLACE_RADIUS_M * PLACE_RADIUS_M;
        let centre = targets[best].point;
        let near = targets.iter().zip(&self.places);
        let near = near.filter(|(t, _)| t.point.squared_distance(centre) <= squared_radius);
        // The sum of shares may exceed one by rounding.
        near.map(|(_, probability)| probability)
            .sum::<f64>()
            .min(1.0)
    }
}

#[cfg(test)]
mod tests;

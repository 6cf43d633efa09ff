//! One frame of a track: what is expected, what to look at because of it, what is believed after.
//!
//! References have names here (`K`), so that a service and an evaluation take the same step.

use crate::filter::{Belief, FilterSettings, Posterior, Prediction, predict};
use crate::ground::Place;
use crate::motion::Motion;
use std::collections::HashMap;
use std::hash::Hash;

/// Most references that are compared with a photo only because the motion leads to them.
const MOST_SUPPORTED: usize = 50;

/// The places that a photo may show, with what is expected before it is looked at.
#[derive(Debug, Clone)]
pub struct Expectation<K> {
    names: Vec<K>,
    places: Vec<Place>,
    number_of: HashMap<K, usize>,
    prediction: Prediction,
}

impl<K: Copy + Eq + Hash + Ord> Expectation<K> {
    /// Before the first frame, whose photo is in the map with probability `in_map` and may show the
    /// places `found`.
    pub fn at_the_start(found: Vec<(K, Place)>, in_map: f64) -> Self {
        let settings = FilterSettings::at_the_start(in_map);
        Self::new(&Belief::unknown(), &Motion::STILL, settings, found)
    }

    /// Before a frame that follows `belief` by `motion`. Its photo may show the places `found` by
    /// its looks, and those `in_reach`.
    pub fn after(
        belief: &Belief,
        motion: &Motion,
        found: Vec<(K, Place)>,
        in_reach: Vec<(K, Place)>,
    ) -> Self {
        let mut places = found;
        places.extend(in_reach);
        Self::new(belief, motion, FilterSettings::ON_THE_ROAD, places)
    }

    fn new(
        belief: &Belief,
        motion: &Motion,
        settings: FilterSettings,
        targets: Vec<(K, Place)>,
    ) -> Self {
        let mut names = Vec::with_capacity(targets.len());
        let mut places = Vec::with_capacity(targets.len());
        let mut number_of = HashMap::with_capacity(targets.len());
        for (name, place) in targets {
            number_of.entry(name).or_insert_with(|| {
                names.push(name);
                places.push(place);
                names.len() - 1
            });
        }
        let prediction = predict(belief, motion, &places, settings);
        Self {
            names,
            places,
            number_of,
            prediction,
        }
    }

    /// Whether there is no place at all.
    pub fn is_empty(&self) -> bool {
        self.names.is_empty()
    }

    /// The places that are not among `candidates` and that the motion makes likeliest: they deserve
    /// to be compared with the photo, too. At most fifty.
    pub fn supported(&self, candidates: &[K]) -> Vec<K> {
        let mut is_candidate = vec![false; self.names.len()];
        for name in candidates {
            if let Some(&number) = self.number_of.get(name) {
                is_candidate[number] = true;
            }
        }
        let density = |number: usize| self.prediction.density(number);
        let mut others: Vec<usize> = (0..self.names.len())
            .filter(|&number| !is_candidate[number] && density(number) > 0.0)
            .collect();
        let by_density = |a: &usize, b: &usize| {
            let order = density(*b).total_cmp(&density(*a));
            order.then(self.names[*a].cmp(&self.names[*b]))
        };
        others.sort_by(by_density);
        others.truncate(MOST_SUPPORTED);
        others.iter().map(|&number| self.names[number]).collect()
    }

    /// Weighs the places by what the photo says about those that it was compared with: the
    /// logarithm of how much likelier it is there than elsewhere.
    pub fn weigh(self, log_ratios: impl Iterator<Item = (K, f64)>) -> Whereabouts<K> {
        let mut of_places = vec![None; self.names.len()];
        for (name, ratio) in log_ratios {
            if let Some(&number) = self.number_of.get(&name) {
                of_places[number] = Some(ratio);
            }
        }
        Whereabouts {
            posterior: self.prediction.posterior(&of_places),
            names: self.names,
            places: self.places,
            number_of: self.number_of,
        }
    }
}

/// Where the vehicle is after its photo was looked at.
#[derive(Debug, Clone)]
pub struct Whereabouts<K> {
    names: Vec<K>,
    places: Vec<Place>,
    number_of: HashMap<K, usize>,
    posterior: Posterior,
}

impl<K: Copy + Eq + Hash + Ord> Whereabouts<K> {
    /// By what a place is ranked; `None` if it takes no part.
    pub fn density(&self, name: K) -> Option<f64> {
        let number = *self.number_of.get(&name)?;
        Some(self.posterior.density(number))
    }

    /// Probability that the photo was taken where the place `best` is; 0 if that takes no part.
    pub fn probability(&self, best: Option<K>) -> f64 {
        let number = best.and_then(|name| self.number_of.get(&name));
        number.map_or(0.0, |&number| {
            self.posterior.probability_around(number, &self.places)
        })
    }

    /// Whether the vehicle is more likely at no known place.
    pub fn is_lost(&self) -> bool {
        self.posterior.is_lost()
    }

    /// Every place with its probability.
    pub fn probabilities(&self) -> impl Iterator<Item = (K, f64)> + '_ {
        let probabilities = self.posterior.places().iter().copied();
        self.names.iter().copied().zip(probabilities)
    }

    /// The likeliest places, in descending order, at most so many.
    pub fn likeliest(&self, most: usize) -> Vec<(K, f64)> {
        let mut places: Vec<(K, f64)> = self.probabilities().collect();
        places.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        places.truncate(most);
        places
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::Point;
    use crate::motion::Travel;

    fn at(x: f64) -> Place {
        Place {
            point: Point::planar(x, 0.0),
            heading: None,
        }
    }

    #[test]
    fn the_motion_supports_what_is_in_reach_and_not_what_was_found_anyway() {
        let belief = Belief::new(vec![(at(0.0), 1.0)], 0.0);
        let motion = Motion::new(Travel::Within { reach_m: 20.0 }, None).unwrap();
        let found = vec![("found", at(10.0)), ("far", at(1e4))];
        let in_reach = vec![("found", at(10.0)), ("near", at(5.0)), ("beyond", at(30.0))];
        let expected = Expectation::after(&belief, &motion, found, in_reach);
        assert_eq!(
            expected.supported(&["found", "far", "unknown"]),
            ["near", "beyond"]
        );
        let whereabouts =
            expected.weigh([("near", 5.0), ("found", 1.0), ("unknown", 9.0)].into_iter());
        assert_eq!(whereabouts.likeliest(1)[0].0, "near");
        assert!(whereabouts.density("near") > whereabouts.density("found"));
        assert_eq!(whereabouts.density("unknown"), None);
        assert_eq!(whereabouts.probability(Some("unknown")), 0.0);
    }

    #[test]
    fn without_places_the_vehicle_is_lost() {
        let nothing: Expectation<u8> = Expectation::at_the_start(Vec::new(), 0.5);
        assert!(nothing.is_empty());
        let whereabouts = nothing.weigh(std::iter::empty());
        assert!(whereabouts.is_lost());
        assert_eq!(whereabouts.probability(None), 0.0);
    }
}

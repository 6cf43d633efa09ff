//! From candidates to where the vehicle is: the filter of the crate `placeformer-track` between the
//! index of a map and the answer of a query.

use super::TrackAnswer;
use super::frame::Frame;
use placeformer_core::types::{
    GeoCircle, GeoPoint, MapName, ModelId, ReferenceFilter, ReferenceId, Timestamp,
};
use placeformer_track::{
    Belief, Believed, Estimate, Evidence, Expectation, MOST_PLACES, Motion, Place, Sight, Track,
    TrackKey, Whereabouts, estimate,
};
use placeformer_vision::search::{LocatedReference, MapIndex, Neighbour};
use std::collections::HashMap;

/// Most references in reach that the filter looks at. Where there are more, the vehicle can be
/// almost anywhere, and the motion says little.
const MOST_IN_REACH: usize = 400;

/// A place that is believed in less than this leads nowhere: what is in its reach is not looked up.
const LEAST_BELIEF: f64 = 1e-4;

/// The places that a photo may show, with what is expected before it is looked at.
pub(crate) struct Localisation {
    located: HashMap<ReferenceId, LocatedReference>,
    expected: Expectation<ReferenceId>,
}

impl Localisation {
    /// For a photo of which `candidates` were found by their global descriptors. What the motion of
    /// `frame` supports beyond these is added to them.
    pub(crate) fn new(
        index: &MapIndex,
        filter: &ReferenceFilter,
        global: &[f32],
        candidates: &mut Vec<Neighbour>,
        frame: Option<&Frame>,
        evidence: Evidence<'_>,
    ) -> Self {
        let ids: Vec<ReferenceId> = candidates.iter().map(|candidate| candidate.id).collect();
        let found: Vec<LocatedReference> = index.located(&ids).into_iter().flatten().collect();
        let mut located: HashMap<ReferenceId, LocatedReference> =
            found.iter().map(|at| (at.id, *at)).collect();
        let found = named(&found);
        let previous = frame.and_then(|frame| Some((frame, frame.previous.as_ref()?)));
        let Some((frame, track)) = previous else {
            return Self {
                expected: Expectation::at_the_start(found, evidence.prior()),
                located,
            };
        };
        let known = Known::of(track, index);
        let in_reach = index.near(&known.reach(&frame.motion), filter, MOST_IN_REACH);
        located.extend(in_reach.iter().map(|at| (at.id, *at)));
        let expected = Expectation::after(&known.belief, &frame.motion, found, named(&in_reach));
        candidates.extend(index.compare(global, &expected.supported(&ids)));
        Self { located, expected }
    }

    /// Whether no candidate has a position, so that nothing can be said about places.
    pub(crate) fn is_nowhere(&self) -> bool {
        self.expected.is_empty()
    }

    /// Weighs every place by what the photo says about it: S, where it was re-ranked, and the
    /// global distance of each candidate.
    pub(crate) fn weigh(
        self,
        scores: impl Iterator<Item = (ReferenceId, Option<f64>, f32)>,
        evidence: Evidence<'_>,
    ) -> Sighting {
        let ratios = scores.map(|(id, spatial_score, distance)| {
            (id, evidence.log_ratio(spatial_score, f64::from(distance)))
        });
        Sighting {
            whereabouts: self.expected.weigh(ratios),
            located: self.located,
        }
    }
}

fn place_of(located: &LocatedReference) -> Place {
    Place {
        point: located.location.into(),
        heading: located.heading,
    }
}

fn named(located: &[LocatedReference]) -> Vec<(ReferenceId, Place)> {
    located.iter().map(|at| (at.id, place_of(at))).collect()
}

/// Where the vehicle was thought to be, as far as the references are still there.
struct Known {
    belief: Belief,
    /// The same places on the Earth, with their probabilities.
    points: Vec<(GeoPoint, f64)>,
}

impl Known {
    fn of(track: &Track, index: &MapIndex) -> Self {
        let ids: Vec<ReferenceId> = track.places.iter().map(|place| place.id).collect();
        let mut places = Vec::with_capacity(ids.len());
        let mut points = Vec::with_capacity(ids.len());
        for (located, believed) in index.located(&ids).into_iter().zip(&track.places) {
            if let Some(located) = located {
                places.push((place_of(&located), believed.probability));
                points.push((located.location, believed.probability));
            }
        }
        Self {
            belief: Belief::new(places, track.elsewhere),
            points,
        }
    }

    /// Where the motion may have led.
    fn reach(&self, motion: &Motion) -> Vec<GeoCircle> {
        self.points
            .iter()
            .filter(|(_, probability)| *probability >= LEAST_BELIEF)
            .filter_map(|(point, _)| GeoCircle::new(*point, motion.reach_m()).ok())
            .collect()
    }
}

/// Where a photo was taken, as far as it can be told.
pub(crate) struct Sighting {
    located: HashMap<ReferenceId, LocatedReference>,
    whereabouts: Whereabouts<ReferenceId>,
}

impl Sighting {
    /// By what a reference is ranked in a track; `None` if it has no position, so that the track
    /// says nothing about it.
    pub(crate) fn density(&self, id: ReferenceId) -> Option<f64> {
        self.whereabouts.density(id)
    }

    /// Probability that the photo was taken where `best` shows it.
    pub(crate) fn probability(&self, best: Option<ReferenceId>) -> f64 {
        self.whereabouts.probability(best)
    }

    /// Where exactly it was taken, given that it was where `best` shows it.
    pub(crate) fn pose(&self, best: ReferenceId) -> Option<Estimate> {
        let sight = |(id, weight): (ReferenceId, f64)| {
            let at = self.located.get(&id)?;
            Some(Sight {
                point: at.location,
                heading: at.heading,
                alt: at.alt,
                weight,
            })
        };
        let sights: Vec<Sight> = self.whereabouts.probabilities().filter_map(sight).collect();
        estimate(self.located.get(&best)?.location, &sights)
    }

    /// What is known of a track after `frame`, whose photo this is; `best` is the first result.
    pub(crate) fn continued(
        &self,
        frame: &Frame,
        (map, model): (&MapName, &ModelId),
        key: &TrackKey,
        best: Option<ReferenceId>,
    ) -> TrackAnswer {
        let before = frame.previous.as_ref().map_or(0, |track| track.frames);
        let believed = |(id, probability)| Believed { id, probability };
        let likeliest = self.whereabouts.likeliest(MOST_PLACES);
        let places: Vec<Believed> = likeliest.into_iter().map(believed).collect();
        let kept: f64 = places.iter().map(|place| place.probability).sum();
        let track = Track {
            map: map.clone(),
            model: model.clone(),
            issued_at: Timestamp::now(),
            captured_at: frame.captured_at,
            by_client_clock: frame.by_client_clock,
            frames: before.saturating_add(1),
            elsewhere: (1.0 - kept).clamp(0.0, 1.0),
            places,
        };
        TrackAnswer {
            token: track.seal(key),
            probability: self.probability(best),
            lost: self.whereabouts.is_lost(),
            frames: track.frames,
        }
    }
}

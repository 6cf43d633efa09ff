//! The row of one step of a track: everything that a query of a track costs beyond its re-ranking.

use super::context::{Bench, agree};
use super::error::BenchError;
use super::measure::paired;
use super::row::BenchRow;
use super::scenes::{made_up_id, unit_vector};
use super::search::random_index;
use placeformer_core::types::{GeoCircle, GeoPoint, InvalidValue, ReferenceFilter, ReferenceId};
use placeformer_track::{Belief, Expectation, MOST_PLACES, Motion, Place, Travel};
use placeformer_vision::search::{LocatedReference, MapIndex};

/// References of the map.
const REFERENCES: u64 = 1_000_000;
/// Candidates of the search.
const CANDIDATES: u64 = 100;
/// References in reach that the filter looks at, as in the service.
const MOST_IN_REACH: usize = 400;
/// How far the vehicle may have come, in metres.
const REACH_M: f64 = 40.0;

impl Bench<'_> {
    /// A belief in as many places as a token has room for, in a map of a million references of
    /// which hundreds are in reach; the baseline measures the distance to each reference from one
    /// of these places.
    pub(super) fn track(&self) -> Result<BenchRow, BenchError> {
        let name = "track_1m";
        let (index, _) = random_index(REFERENCES, 0);
        let positions: Vec<GeoPoint> = index
            .located(&(0..REFERENCES).map(made_up_id).collect::<Vec<_>>())
            .into_iter()
            .filter_map(|located| Some(located?.location))
            .collect();
        let scene = Scene::new(&index)?;
        let step = || scene.step();
        agree(name, step().is_some_and(|best| best == scene.right), || {
            "the step does not find the place that the photo shows".into()
        })?;
        let here = positions[positions.len() / 2];
        let times = paired(20 * self.rounds, step, || {
            let near = positions.iter().filter(|at| at.distance_m(here) <= REACH_M);
            near.count()
        });
        let limit = self
            .limits
            .memory_ms(REFERENCES as f64 * size_of::<GeoPoint>() as f64);
        BenchRow::new(name, "haversine to each reference", times, limit)
    }
}

/// A vehicle in the middle of the map.
struct Scene<'a> {
    index: &'a MapIndex,
    motion: Motion,
    global: Vec<f32>,
    believed: Vec<ReferenceId>,
    candidates: Vec<ReferenceId>,
    /// The candidate that the photo shows.
    right: ReferenceId,
}

impl<'a> Scene<'a> {
    fn new(index: &'a MapIndex) -> Result<Self, BenchError> {
        let setup = |error: InvalidValue| BenchError::Setup(error.to_string());
        let middle = REFERENCES / 2;
        let travel = Travel::Within { reach_m: REACH_M };
        // Candidates lie all over the map; one of them is in reach.
        let candidates = (0..CANDIDATES).map(|i| made_up_id(i * REFERENCES / CANDIDATES));
        Ok(Self {
            index,
            motion: Motion::new(travel, None).map_err(setup)?,
            global: unit_vector(middle),
            believed: (middle..middle + MOST_PLACES as u64)
                .map(made_up_id)
                .collect(),
            candidates: candidates.collect(),
            right: made_up_id(middle),
        })
    }

    /// The place that is likeliest after the photo.
    fn step(&self) -> Option<ReferenceId> {
        let known: Vec<LocatedReference> = self.located(&self.believed);
        let circles: Vec<GeoCircle> = known
            .iter()
            .filter_map(|at| GeoCircle::new(at.location, self.motion.reach_m()).ok())
            .collect();
        let everything = ReferenceFilter::default();
        let in_reach = self.index.near(&circles, &everything, MOST_IN_REACH);
        let share = 1.0 / known.len() as f64;
        let places = named(&known).into_iter().map(|(_, place)| (place, share));
        let belief = Belief::new(places.collect(), 0.0);
        let found = named(&self.located(&self.candidates));
        let expected = Expectation::after(&belief, &self.motion, found, named(&in_reach));
        let supported = expected.supported(&self.candidates);
        let compared = self.index.compare(&self.global, &supported);
        let poor = self.candidates.iter().copied();
        let poor = poor.chain(compared.iter().map(|neighbour| neighbour.id));
        let says = poor.map(|id| (id, if id == self.right { 6.0 } else { -4.0 }));
        let likeliest = expected.weigh(says).likeliest(MOST_PLACES);
        likeliest.first().map(|(id, _)| *id)
    }

    fn located(&self, ids: &[ReferenceId]) -> Vec<LocatedReference> {
        self.index.located(ids).into_iter().flatten().collect()
    }
}

fn named(located: &[LocatedReference]) -> Vec<(ReferenceId, Place)> {
    let place = |at: &LocatedReference| Place {
        point: at.location.into(),
        heading: at.heading,
    };
    located.iter().map(|at| (at.id, place(at))).collect()
}

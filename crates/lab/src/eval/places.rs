//! Which queries show the same place, so that what is learnt from one is not tested on its
//! neighbour.

use super::measure::FOLDS;
use crate::datasets::{Dataset, NeighbourGrid, Truth};
use std::collections::BTreeMap;

/// Queries without a match that stand this near to each other show one place.
const PLACE_M: f64 = 25.0;

/// For every query the number of its place: queries that share a positive, directly or by others
/// between them, have the same; of those without a match, queries that stand together.
///
/// Where frames are dense a whole drive hangs together like this. A place of more than half of all
/// queries is therefore cut into as many stretches as there are folds, in the order of the
/// database.
pub(super) fn places_of(dataset: &Dataset) -> Vec<usize> {
    let references = dataset.database.len();
    let mut sets = Sets::new(references + dataset.queries.len());
    for (query, truth) in dataset.truth.iter().enumerate() {
        for &positive in truth.positives() {
            sets.join(references + query, positive);
        }
    }
    join_unmatched(dataset, &mut sets);

    let mut members: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for query in 0..dataset.queries.len() {
        let root = sets.root(references + query);
        members.entry(root).or_default().push(query);
    }
    let mut places = vec![0; dataset.queries.len()];
    let mut next = 0;
    for mut queries in members.into_values() {
        queries.sort_by_key(|&query| (dataset.truth[query].positives().first().copied(), query));
        let is_chain = 2 * queries.len() > dataset.queries.len();
        let stretch = if is_chain {
            queries.len().div_ceil(FOLDS)
        } else {
            queries.len()
        };
        for together in queries.chunks(stretch.max(1)) {
            for &query in together {
                places[query] = next;
            }
            next += 1;
        }
    }
    places
}

/// Joins queries without a match that stand together. In `sets` the queries follow the references.
fn join_unmatched(dataset: &Dataset, sets: &mut Sets) {
    let references = dataset.database.len();
    let mut unmatched = Vec::new();
    for (query, item) in dataset.queries.iter().enumerate() {
        if dataset.truth[query] == Truth::NoMatch
            && let Some(position) = item.position
        {
            unmatched.push((query, position));
        }
    }
    let grid = NeighbourGrid::new(PLACE_M, unmatched.iter().copied());
    for &(query, position) in &unmatched {
        for other in grid.within(position) {
            if dataset.queries[other].group == dataset.queries[query].group {
                sets.join(references + query, references + other);
            }
        }
    }
}

/// Disjoint sets of numbers.
struct Sets(Vec<usize>);

impl Sets {
    fn new(count: usize) -> Self {
        Self((0..count).collect())
    }

    fn root(&mut self, mut member: usize) -> usize {
        while self.0[member] != member {
            // Halving the way keeps later walks short.
            self.0[member] = self.0[self.0[member]];
            member = self.0[member];
        }
        member
    }

    fn join(&mut self, a: usize, b: usize) {
        let a = self.root(a);
        let b = self.root(b);
        self.0[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::datasets::Item;
    use placeformer_core::geography::MetricPoint;

    fn dataset(truth: Vec<Truth>) -> Dataset {
        let items = |n: usize| (0..n).map(|i| Item::new(i.to_string(), "x")).collect();
        let queries = items(truth.len());
        let skipped = Vec::new();
        let notes = Vec::new();
        Dataset {
            name: "d".into(),
            database: items(40),
            queries,
            truth,
            skipped,
            notes,
        }
    }

    fn positives(indices: &[usize]) -> Truth {
        Truth::Positives(indices.to_vec())
    }

    #[test]
    fn shared_positives_make_one_place_even_through_others() {
        let truth = vec![
            positives(&[0, 1]),
            positives(&[7]),
            positives(&[2, 3]),
            Truth::NoMatch,
            positives(&[1, 2]),
            Truth::Unknown,
            positives(&[9]),
        ];
        let places = places_of(&dataset(truth));
        assert!(places[0] == places[2] && places[2] == places[4]);
        let distinct: std::collections::BTreeSet<_> = places.iter().collect();
        assert_eq!(distinct.len(), 5, "{places:?}");
    }

    #[test]
    fn unmatched_queries_that_stand_together_are_one_place() {
        let mut set = dataset(vec![
            Truth::NoMatch,
            Truth::NoMatch,
            Truth::NoMatch,
            positives(&[1]),
            positives(&[9]),
        ]);
        for (query, east) in [0.0, 20.0, 500.0, 0.0].into_iter().enumerate() {
            set.queries[query].position = Some(MetricPoint { east, north: 0.0 });
        }
        let places = places_of(&set);
        assert_eq!(places[0], places[1]);
        assert!(places[0] != places[2] && places[0] != places[3]);
    }

    #[test]
    fn a_drive_that_hangs_together_is_cut_into_stretches() {
        // Asked in reverse: stretches follow the database.
        let places = places_of(&dataset(
            (0..30).rev().map(|i| positives(&[i, i + 1])).collect(),
        ));
        let distinct: std::collections::BTreeSet<_> = places.iter().collect();
        assert_eq!(distinct.len(), FOLDS);
        assert_eq!(
            places.windows(2).filter(|pair| pair[0] != pair[1]).count(),
            FOLDS - 1
        );
    }
}

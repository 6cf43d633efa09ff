//! The index compared with a plain scan of all references.

use super::block::CAPACITY;
use super::nearest::squared_distance;
use super::{IndexEntry, LocatedReference, MapIndex, Neighbour};
use placeformer_core::types::{
    GLOBAL_DIM, GeoCircle, GeoPoint, Heading, ReferenceFilter, ReferenceId, Timestamp,
};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

fn id(number: u64) -> ReferenceId {
    ReferenceId::from_bytes((u128::from(number) << 32).to_be_bytes())
}

/// What an artificial vector looks like; each kind is difficult for the bounds in its own way.
#[derive(Debug, Clone, Copy)]
enum Kind {
    Unit,
    Clustered,
    Duplicate,
    Axis,
    Zero,
    Long,
}

const KINDS: [Kind; 6] = [
    Kind::Unit,
    Kind::Clustered,
    Kind::Duplicate,
    Kind::Axis,
    Kind::Zero,
    Kind::Long,
];

fn vector(kind: Kind, seed: u64) -> Vec<f32> {
    let mut random = ChaCha8Rng::seed_from_u64(match kind {
        Kind::Duplicate => seed % 3,
        _ => seed,
    });
    let mut noise = |scale: f32| -> Vec<f32> {
        (0..GLOBAL_DIM)
            .map(|_| random.random_range(-scale..scale))
            .collect()
    };
    match kind {
        Kind::Unit | Kind::Duplicate => normalised(noise(1.0)),
        Kind::Clustered => {
            let centre = vector(Kind::Unit, seed % 5);
            normalised(
                centre
                    .iter()
                    .zip(noise(0.002))
                    .map(|(c, n)| c + n)
                    .collect(),
            )
        }
        Kind::Axis => (0..GLOBAL_DIM)
            .map(|i| if i as u64 == seed % 256 { 1.0 } else { 0.0 })
            .collect(),
        Kind::Zero => vec![0.0; GLOBAL_DIM],
        Kind::Long => noise(10f32.powi((seed % 30) as i32 - 10)),
    }
}

fn normalised(vector: Vec<f32>) -> Vec<f32> {
    let length = vector.iter().map(|v| v * v).sum::<f32>().sqrt();
    vector.iter().map(|v| v / length).collect()
}

fn entry(number: u64, kind: Kind, seed: u64) -> IndexEntry {
    let located = !seed.is_multiple_of(4);
    let location = located.then(|| GeoPoint::new(51.0 + (seed % 97) as f64 * 1e-3, 7.0).unwrap());
    let timed = !seed.is_multiple_of(5);
    let captured_at =
        timed.then(|| Timestamp::from_unix_micros((seed % 89) as i64 * 1_000_000).unwrap());
    IndexEntry {
        id: id(number),
        global: vector(kind, seed),
        location,
        alt: None,
        heading: None,
        captured_at,
    }
}

fn brute_force<'a>(
    entries: impl Iterator<Item = &'a IndexEntry>,
    query: &[f32],
    k: usize,
    filter: &ReferenceFilter,
) -> Vec<Neighbour> {
    let mut all: Vec<(f32, ReferenceId)> = entries
        .filter(|entry| filter.accepts(entry.location, entry.captured_at))
        .map(|entry| (squared_distance(query, &entry.global), entry.id))
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all.truncate(k);
    all.into_iter()
        .map(|(square, id)| Neighbour {
            id,
            distance: square.sqrt(),
        })
        .collect()
}

fn filters() -> Vec<ReferenceFilter> {
    let near = Some(GeoCircle::new(GeoPoint::new(51.02, 7.0).unwrap(), 1500.0).unwrap());
    let after = Some(Timestamp::from_unix_micros(20 * 1_000_000).unwrap());
    let before = Some(Timestamp::from_unix_micros(40 * 1_000_000).unwrap());
    vec![
        ReferenceFilter::default(),
        ReferenceFilter {
            near,
            ..ReferenceFilter::default()
        },
        ReferenceFilter {
            captured_after: after,
            captured_before: before,
            ..ReferenceFilter::default()
        },
        ReferenceFilter {
            near,
            captured_after: after,
            captured_before: before,
        },
        ReferenceFilter {
            captured_after: before,
            captured_before: after,
            ..ReferenceFilter::default()
        },
    ]
}

fn assert_exact(index: &MapIndex, entries: &[IndexEntry], query: &[f32]) {
    for filter in filters() {
        for k in [0, 1, 3, 100, entries.len() + 10, usize::MAX] {
            assert_eq!(
                index.search(query, k, &filter),
                brute_force(entries.iter(), query, k, &filter),
                "{k} {filter:?}"
            );
        }
    }
}

#[test]
fn results_equal_a_plain_scan_for_every_kind_of_vector() {
    for kind in KINDS {
        for count in [0, 1, 63, 64, 65, 1000] {
            let entries: Vec<_> = (0..count)
                .map(|number| entry(number, kind, number))
                .collect();
            let index = MapIndex::build(entries.clone());
            assert_eq!(index.len(), entries.len());
            for seed in 0..3 {
                assert_exact(&index, &entries, &vector(kind, 10_000 + seed));
                assert_exact(&index, &entries, &vector(Kind::Unit, seed));
            }
        }
    }
}

#[test]
fn kinds_mixed_in_one_index_are_ranked_alike() {
    let entries: Vec<_> = (0..1200)
        .map(|number| entry(number, KINDS[number as usize % 6], number * 7))
        .collect();
    let index = MapIndex::default();
    entries
        .iter()
        .rev()
        .for_each(|entry| index.insert(entry.clone()));
    for seed in 0..12 {
        assert_exact(&index, &entries, &vector(KINDS[seed % 6], seed as u64));
    }
}

#[test]
fn vectors_beyond_f32_do_not_hide_the_others() {
    let mut entries: Vec<_> = (0..300)
        .map(|number| entry(number, Kind::Unit, number))
        .collect();
    for (number, entry) in entries.iter_mut().enumerate().step_by(3) {
        entry
            .global
            .fill(if number % 2 == 0 { 3e38 } else { -1e25 });
    }
    let index = MapIndex::build(entries.clone());
    let query = vector(Kind::Unit, 9);
    let found = index.search(&query, 300, &ReferenceFilter::default());
    assert_eq!(
        found,
        brute_force(entries.iter(), &query, 300, &ReferenceFilter::default())
    );
    let first = index.search(&query, 200, &ReferenceFilter::default());
    assert_eq!(first, found[..200]);
}

#[test]
fn of_equal_ids_the_last_counts() {
    let mut entries: Vec<_> = (0..200)
        .map(|number| entry(number % 50, Kind::Unit, number))
        .collect();
    let index = MapIndex::build(entries.clone());
    entries.drain(..150);
    assert_eq!(index.len(), 50);
    assert_exact(&index, &entries, &vector(Kind::Unit, 1));
}

#[derive(Debug, Clone)]
enum Operation {
    Insert(u64, usize, u64),
    Remove(u64),
    RemoveRange(u64, u64),
    Search(usize, u64, usize, usize),
}

fn operation() -> impl Strategy<Value = Operation> {
    prop_oneof![
        6 => (0u64..400, 0usize..6, any::<u64>())
            .prop_map(|(id, kind, seed)| Operation::Insert(id, kind, seed)),
        2 => (0u64..400).prop_map(Operation::Remove),
        1 => (0u64..400, 0u64..150)
            .prop_map(|(start, count)| Operation::RemoveRange(start, count)),
        1 => (0usize..6, any::<u64>(), 0usize..120, 0usize..5)
            .prop_map(|(kind, seed, k, filter)| Operation::Search(kind, seed, k, filter)),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn any_history_leaves_the_index_of_what_is_left(
        initial in 0u64..400,
        operations in prop::collection::vec(operation(), 0..300),
    ) {
        let mut model: BTreeMap<ReferenceId, IndexEntry> = (0..initial)
            .map(|number| (id(number), entry(number, Kind::Unit, number)))
            .collect();
        let index = MapIndex::build(model.values().cloned().collect());
        for operation in operations {
            match operation {
                Operation::Insert(number, kind, seed) => {
                    let entry = entry(number, KINDS[kind], seed);
                    index.insert(entry.clone());
                    model.insert(entry.id, entry);
                }
                Operation::Remove(number) => {
                    let was_there = model.remove(&id(number)).is_some();
                    prop_assert_eq!(index.remove(id(number)), was_there);
                }
                Operation::RemoveRange(start, count) => {
                    for number in start..start + count {
                        let was_there = model.remove(&id(number)).is_some();
                        prop_assert_eq!(index.remove(id(number)), was_there);
                    }
                }
                Operation::Search(kind, seed, k, filter) => {
                    let query = vector(KINDS[kind], seed);
                    let filter = filters()[filter];
                    let expected = brute_force(model.values(), &query, k, &filter);
                    prop_assert_eq!(index.search(&query, k, &filter), expected);
                }
            }
            prop_assert_eq!(index.len(), model.len());
        }
        let query = vector(Kind::Unit, 3);
        let filter = ReferenceFilter::default();
        let rebuilt = MapIndex::build(model.values().cloned().collect());
        let expected = rebuilt.search(&query, 1000, &filter);
        prop_assert_eq!(index.search(&query, 1000, &filter), expected);
        // At most one sealed block may be more than half empty.
        let limit = (model.len() * 2 + 3 * CAPACITY) * 1400;
        let bytes = index.memory_bytes();
        prop_assert!(bytes < limit, "{bytes} bytes for {}", model.len());
    }
}

#[test]
fn searches_during_changes_see_each_reference_whole() {
    let index = MapIndex::build(
        (0..500)
            .map(|number| entry(number, Kind::Unit, number))
            .collect(),
    );
    let steady: Vec<_> = (0..500)
        .step_by(2)
        .map(|number| entry(number, Kind::Unit, number))
        .collect();
    std::thread::scope(|scope| {
        let changers: Vec<_> = (0..2u64)
            .map(|part| {
                let index = &index;
                scope.spawn(move || {
                    for round in 0..20 {
                        for number in (1..500).step_by(2).filter(|number| number / 2 % 2 == part) {
                            match (number + round) % 3 {
                                0 => drop(index.remove(id(number))),
                                _ => index.insert(entry(number, Kind::Unit, number)),
                            }
                        }
                        // Replacing a reference by itself must never hide it.
                        (0..500)
                            .step_by(2)
                            .filter(|n| n / 2 % 2 == part)
                            .for_each(|number| {
                                index.insert(entry(number, Kind::Unit, number));
                            });
                    }
                })
            })
            .collect();
        let mut round = 0;
        while changers.iter().any(|changer| !changer.is_finished()) {
            round += 1;
            let query = vector(Kind::Unit, round % 7);
            let found = index.search(&query, 600, &ReferenceFilter::default());
            assert!(found.is_sorted_by(|a, b| (a.distance, a.id) < (b.distance, b.id)));
            let lasting: Vec<_> = found
                .iter()
                .copied()
                .filter(|n| steady.iter().any(|e| e.id == n.id))
                .collect();
            assert_eq!(
                lasting,
                brute_force(steady.iter(), &query, 600, &ReferenceFilter::default())
            );
        }
    });
}

proptest! {
    #[test]
    fn the_references_around_points_are_those_in_some_circle(
        places in prop::collection::vec(
            prop::option::weighted(0.9, (-0.02..0.02f64, -0.02..0.02f64)), 0..300),
        centres in prop::collection::vec((-0.02..0.02f64, -0.02..0.02f64), 0..20),
        radius in 1.0..2000.0f64,
        (lat, lon) in prop_oneof![Just((51.0, 7.0)), Just((0.0, 180.0)), Just((89.99, 0.0))],
        removed in 0usize..300,
    ) {
        let point = |(north, east): (f64, f64)| {
            let lon = (lon + east + 180.0).rem_euclid(360.0) - 180.0;
            GeoPoint::new((lat + north).min(90.0), lon).unwrap()
        };
        let entries: Vec<IndexEntry> = places.iter().enumerate().map(|(i, place)| IndexEntry {
            location: place.map(point),
            heading: Heading::new(i as f64).ok(),
            ..entry(i as u64, Kind::Zero, 0)
        }).collect();
        let index = MapIndex::build(entries.clone());
        index.remove(id(removed as u64));
        let circles: Vec<GeoCircle> = centres
            .into_iter()
            .map(|centre| GeoCircle::new(point(centre), radius).unwrap())
            .collect();
        let there = entries.iter().filter(|entry| entry.id != id(removed as u64));
        let expected: Vec<ReferenceId> = there
            .filter(|entry| {
                entry.location.is_some_and(|at| circles.iter().any(|circle| circle.contains(at)))
            })
            .map(|entry| entry.id)
            .collect();
        let found = index.near(&circles, &ReferenceFilter::default(), usize::MAX);
        let ids: Vec<ReferenceId> = found.iter().map(|located| located.id).collect();
        prop_assert_eq!(&ids, &expected);
        let located: Vec<LocatedReference> = index.located(&ids).into_iter().flatten().collect();
        prop_assert_eq!(&located, &found);
        let few = index.near(&circles, &ReferenceFilter::default(), 10);
        prop_assert_eq!(few.len(), found.len().min(10));
    }
}

#[test]
fn references_are_compared_by_name_as_a_search_does() {
    let entries: Vec<IndexEntry> = (0..200).map(|i| entry(i, Kind::Axis, i)).collect();
    let index = MapIndex::build(entries);
    let query = vector(Kind::Axis, 7);
    let all = index.search(&query, 200, &ReferenceFilter::default());
    let ids: Vec<ReferenceId> = all.iter().map(|neighbour| neighbour.id).collect();
    assert_eq!(index.compare(&query, &ids), all);
    assert_eq!(index.compare(&query, &[id(1_000)]), []);
    assert_eq!(index.located(&[id(0), id(1_000)]), [None, None]);
}

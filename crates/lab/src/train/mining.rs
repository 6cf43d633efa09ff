//! Hard negatives: the images that look most like a query although they show another place.
//!
//! A random negative is soon farther than the margin and teaches nothing. Before every cycle the
//! nearest descriptors among the allowed ones are found, by exact comparison, for each query the
//! cycle will ask; where the database is huge, among a random pool drawn anew each cycle. Nothing
//! else is embedded, so a cycle costs the same however large the data are, and every image gets its
//! turn.

use super::embed::Embeddings;
use super::error::TrainError;
use super::triplets::{Side, TripletSet};
use placeformer_vision::extract::squared_distance;
use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::collections::HashMap;

/// The `count` hardest negatives of every query of `queries` among the images of `pool`, hardest
/// first.
pub(super) fn hardest_negatives(
    set: &TripletSet,
    queries: &[u32],
    embeddings: &Embeddings,
    count: usize,
    pool: &[u32],
) -> Result<HashMap<u32, Vec<u32>>, TrainError> {
    let candidates = embeddings.of_database(pool)?;
    let order = |a: &(f32, u32), b: &(f32, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    let mine = |&query: &u32| {
        let descriptor = embeddings.of(Side::Query, query)?;
        let near = &set.near[query as usize];
        let allowed = candidates
            .iter()
            .filter(|(candidate, _)| near.binary_search(candidate).is_err());
        let mut scored: Vec<(f32, u32)> = allowed
            .map(|&(candidate, row)| (squared_distance(descriptor, row), candidate))
            .collect();
        if scored.len() > count {
            scored.select_nth_unstable_by(count, order);
            scored.truncate(count);
        }
        scored.sort_unstable_by(order);
        Ok((
            query,
            scored.into_iter().map(|(_, candidate)| candidate).collect(),
        ))
    };
    queries.par_iter().map(mine).collect()
}

/// Ascending indices into a database of `database` images: all, or `most` drawn at random.
pub(super) fn draw_pool(database: usize, most: usize, seed: u64) -> Vec<u32> {
    if database <= most {
        return (0..database as u32).collect();
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut drawn: Vec<u32> = index::sample(&mut rng, database, most)
        .into_iter()
        .map(|i| i as u32)
        .collect();
    drawn.sort_unstable();
    drawn
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::spots::Spots;
    use std::path::PathBuf;

    fn set(near: Vec<u32>, database: usize) -> TripletSet {
        let paths = |n: usize| (0..n).map(|i| PathBuf::from(i.to_string())).collect();
        TripletSet {
            queries: paths(1),
            database: paths(database),
            positives: vec![vec![0]],
            near: vec![near],
            spots: Spots::default(),
        }
    }

    /// One query at 0 and database images at `database`.
    fn embeddings(database: &[f32]) -> Embeddings {
        let rows = std::iter::once(0.0)
            .chain(database.iter().copied())
            .collect();
        let images = (0..database.len() as u32).map(|index| (Side::Database, index));
        Embeddings::new(
            1,
            rows,
            std::iter::once((Side::Query, 0))
                .chain(images)
                .zip(0..)
                .collect(),
        )
    }

    #[test]
    fn the_nearest_allowed_descriptors_come_first() {
        let embeddings = embeddings(&[0.1, 0.2, 5.0, 0.3, 0.2]);
        let mined =
            hardest_negatives(&set(vec![0], 5), &[0], &embeddings, 3, &[0, 1, 2, 3, 4]).unwrap();
        assert_eq!(mined[&0], [1, 4, 3]);
    }

    #[test]
    fn a_pool_bounds_the_work_and_still_never_offers_near_images() {
        let embeddings = embeddings(&(0..1000).map(|i| i as f32).collect::<Vec<_>>());
        let set = set((0..500).collect(), 1000);
        for seed in 0..5 {
            let pool = draw_pool(1000, 50, seed);
            assert_eq!((pool.len(), &pool), (50, &draw_pool(1000, 50, seed)));
            let mined = hardest_negatives(&set, &[0], &embeddings, 10, &pool).unwrap();
            assert!(
                mined[&0].iter().all(|i| *i >= 500 && pool.contains(i)) && !mined[&0].is_empty()
            );
        }
        assert_ne!(draw_pool(1000, 50, 1), draw_pool(1000, 50, 2));
        assert_eq!(draw_pool(3, 50, 1), [0, 1, 2]);
    }

    #[test]
    fn an_image_that_was_not_embedded_is_an_error() {
        assert!(
            hardest_negatives(&set(vec![0], 9), &[0], &embeddings(&[0.1, 0.2]), 3, &[1, 7])
                .is_err()
        );
    }
}

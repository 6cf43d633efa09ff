//! Hard negatives: the images that look most like a query although they show another place.
//!
//! A random negative is soon farther than the margin and teaches nothing. Before every cycle each query's nearest
//! descriptors among the allowed ones are found by exact comparison; where the database is huge, among a random pool
//! drawn anew each cycle, so that the cost stays bounded and every image gets its turn.

use super::triplets::TripletSet;
use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Descriptors of both sides, `[n, dim]` row-major.
pub(super) struct Embeddings {
    pub(super) dim: usize,
    pub(super) queries: Vec<f32>,
    pub(super) database: Vec<f32>,
}

/// The `count` hardest negatives of every query of `usable`, hardest first.
pub(super) fn hardest_negatives(
    set: &TripletSet,
    usable: &[usize],
    embeddings: &Embeddings,
    count: usize,
    pool: usize,
    seed: u64,
) -> Vec<Vec<u32>> {
    let candidates = pool_of(set.database.len(), pool, seed);
    usable
        .par_iter()
        .map(|&query| {
            let descriptor = row(&embeddings.queries, query, embeddings.dim);
            let mut scored: Vec<(f32, u32)> = candidates
                .iter()
                .filter(|candidate| set.near[query].binary_search(candidate).is_err())
                .map(|&candidate| {
                    (
                        squared_distance(descriptor, row(&embeddings.database, candidate as usize, embeddings.dim)),
                        candidate,
                    )
                })
                .collect();
            let order = |a: &(f32, u32), b: &(f32, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
            if scored.len() > count {
                scored.select_nth_unstable_by(count, order);
                scored.truncate(count);
            }
            scored.sort_unstable_by(order);
            scored.into_iter().map(|(_, candidate)| candidate).collect()
        })
        .collect()
}

/// Ascending indices: everything, or `pool` drawn at random.
fn pool_of(database: usize, pool: usize, seed: u64) -> Vec<u32> {
    if database <= pool {
        return (0..database as u32).collect();
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut drawn: Vec<u32> = index::sample(&mut rng, database, pool).into_iter().map(|i| i as u32).collect();
    drawn.sort_unstable();
    drawn
}

pub(super) fn row(rows: &[f32], index: usize, dim: usize) -> &[f32] {
    &rows[index * dim..(index + 1) * dim]
}

pub(super) fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    fn set(near: Vec<u32>, database: usize) -> TripletSet {
        let paths = |n: usize| (0..n).map(|i| PathBuf::from(i.to_string())).collect();
        TripletSet { queries: paths(1), database: paths(database), positives: vec![vec![0]], near: vec![near] }
    }

    #[test]
    fn the_nearest_allowed_descriptors_come_first() {
        let embeddings = Embeddings { dim: 1, queries: vec![0.0], database: vec![0.1, 0.2, 5.0, 0.3, 0.2] };
        let mined = hardest_negatives(&set(vec![0], 5), &[0], &embeddings, 3, 100, 1);
        assert_eq!(mined, [[1, 4, 3]]);
    }

    #[test]
    fn a_pool_bounds_the_work_and_still_never_offers_near_images() {
        let database: Vec<f32> = (0..1000).map(|i| i as f32).collect();
        let embeddings = Embeddings { dim: 1, queries: vec![0.0], database };
        let near: Vec<u32> = (0..500).collect();
        for seed in 0..5 {
            let mined = hardest_negatives(&set(near.clone(), 1000), &[0], &embeddings, 10, 50, seed);
            assert!(mined[0].iter().all(|&i| i >= 500) && !mined[0].is_empty());
            assert_eq!(mined, hardest_negatives(&set(near.clone(), 1000), &[0], &embeddings, 10, 50, seed));
        }
    }
}

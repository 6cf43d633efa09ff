//! Re-ranking with descriptors as the model gives them, in f32: what every codec is measured
//! against.
//!
//! The store, and so the cache of features, keeps no such descriptors: the candidates are described
//! once more and held in memory. The similarities are a plain matrix product; pairs are verified by
//! the same homographies.

use crate::datasets::{Dataset, Item};
use crate::eval::error::EvalError;
use crate::eval::features::Describe;
use crate::eval::run::{Answer, Candidate, Neighbour};
use nalgebra::DMatrix;
use placeformer_core::progress::Task;
use placeformer_core::types::{KeyPatches, SCALES, ScaleSet};
use placeformer_vision::rerank::{
    CombinationScore, PairFeatures, PairScore, RerankConfig, Reranker,
};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

/// Answers re-ranked in full precision.
pub(super) struct FullPrecision {
    pub(super) answers: Vec<Answer>,
    /// Mean seconds per query.
    pub(super) seconds: f64,
    /// Mean bytes of a reference's descriptors, codes replaced by f32 values.
    pub(super) extra_bytes: f64,
}

/// Re-ranks every answer; none if the candidates' descriptors need more than `memory_bytes`.
pub(super) fn rerank_all(
    describer: &dyn Describe,
    dataset: &Dataset,
    answers: &[Answer],
    config: &RerankConfig,
    memory_bytes: u64,
    task: &Task<'_>,
) -> Result<Option<FullPrecision>, EvalError> {
    let candidates: BTreeSet<usize> = answers
        .iter()
        .flat_map(|answer| &answer.global)
        .map(|n| n.index)
        .collect();
    let mut database = BTreeMap::new();
    let mut bytes = 0;
    for &index in &candidates {
        let whole = Whole::of(&describe(describer, &dataset.database[index])?);
        bytes += whole.bytes();
        // The first tells about all: no hours are spent on what would not fit in the end.
        let expected = bytes * candidates.len() as u64 / (database.len() as u64 + 1);
        if expected > memory_bytes {
            return Ok(None);
        }
        database.insert(index, whole);
    }
    let reranker = Reranker::new(config.clone());
    let mut seconds = 0.0;
    let mut reranked = Vec::new();
    for answer in answers {
        let query = Whole::of(&describe(describer, &dataset.queries[answer.query])?);
        let started = Instant::now();
        reranked.push(rerank(&reranker, &query, &database, answer));
        seconds += started.elapsed().as_secs_f64();
        task.add(1);
    }
    let mean = |sum: f64, count: usize| sum / count.max(1) as f64;
    let extra_bytes = mean(bytes as f64 * 0.75, database.len());
    Ok(Some(FullPrecision {
        seconds: mean(seconds, answers.len()),
        answers: reranked,
        extra_bytes,
    }))
}

fn describe(describer: &dyn Describe, item: &Item) -> Result<KeyPatches, EvalError> {
    let bytes = std::fs::read(&item.path).map_err(EvalError::io(&item.path))?;
    let unreadable = |reason| {
        EvalError::Setting(format!(
            "{} cannot be read any more: {reason}",
            item.path.display()
        ))
    };
    describer.key_patches(&describer.tensor(&bytes).map_err(unreadable)?)
}

fn rerank(
    reranker: &Reranker,
    query: &Whole,
    database: &BTreeMap<usize, Whole>,
    answer: &Answer,
) -> Answer {
    let rows = query.descriptors.transpose();
    let score = |neighbour: &Neighbour| {
        let score = query.score(&rows, &database[&neighbour.index], reranker);
        Candidate::by_inliers(*neighbour, score)
    };
    let mut reranked: Vec<Candidate> = answer.global.par_iter().map(score).collect();
    // Stable: ties stay in the global order, as in the service.
    reranked.sort_by_key(|candidate| std::cmp::Reverse(candidate.score.spatial_score));
    Answer {
        reranked,
        ..answer.clone()
    }
}

/// Key patches of all scales, one after the other.
struct Whole {
    /// A column per patch, `[dim, n]`.
    descriptors: DMatrix<f32>,
    counts: [usize; SCALES],
    /// In pixels of the model's input, `[n]`.
    centres: Vec<[f32; 2]>,
    /// Pixels.
    patch_px: f32,
}

impl Whole {
    fn of(patches: &KeyPatches) -> Self {
        let values = patches
            .scales
            .iter()
            .flat_map(|scale| scale.descriptors.iter().copied());
        let counts = patches.scales.each_ref().map(|scale| scale.index.len());
        let centres = (1..=SCALES).flat_map(|scale| {
            let centre = move |&index: &u32| patches.grid.centre(scale, index as usize);
            patches.scales[scale - 1].index.iter().map(centre)
        });
        Self {
            descriptors: DMatrix::from_iterator(patches.dim, counts.iter().sum(), values),
            counts,
            centres: centres.collect(),
            patch_px: f32::from(patches.grid.patch_px),
        }
    }

    fn bytes(&self) -> u64 {
        size_of_val(self.descriptors.as_slice()) as u64
    }

    /// Rows of the scales of a union, ascending.
    fn rows(&self, scales: ScaleSet) -> Vec<usize> {
        let of_scale = |scale: usize| {
            let start: usize = self.counts[..scale - 1].iter().sum();
            start..start + self.counts[scale - 1]
        };
        scales.scales().flat_map(of_scale).collect()
    }

    /// S of this query, whose descriptors are also `rows` `[n, dim]`, and a reference.
    fn score(&self, rows: &DMatrix<f32>, reference: &Self, reranker: &Reranker) -> PairScore {
        let similarity = rows * &reference.descriptors;
        let tolerance_px = reranker.config().tolerance_patches * reference.patch_px;
        let combination = |&scales: &ScaleSet| {
            let pairs = mutual_pairs(&similarity, &self.rows(scales), &reference.rows(scales));
            let points: Vec<[f32; 4]> = pairs
                .iter()
                .map(|&(i, j)| {
                    let ([x, y], [u, v]) = (self.centres[i], reference.centres[j]);
                    [x, y, u, v]
                })
                .collect();
            let inliers = reranker
                .homography(&points, tolerance_px)
                .map_or(0, |(_, inliers)| inliers);
            CombinationScore {
                scales,
                matches: pairs.len() as u32,
                inliers,
            }
        };
        let combinations: Vec<CombinationScore> =
            reranker.config().scales.iter().map(combination).collect();
        PairScore {
            spatial_score: combinations.iter().map(|c| c.inliers).sum(),
            combinations,
            // Only the counts: these answers are ordered by S.
            features: PairFeatures::default(),
        }
    }
}

/// Pairs that are each other's most similar among the rows and columns given; the lowest of equals.
fn mutual_pairs(
    similarity: &DMatrix<f32>,
    rows: &[usize],
    columns: &[usize],
) -> Vec<(usize, usize)> {
    let mut best_of_row = vec![(f32::NEG_INFINITY, usize::MAX); similarity.nrows()];
    let mut best_of_column = vec![(f32::NEG_INFINITY, usize::MAX); similarity.ncols()];
    for &column in columns {
        for &row in rows {
            let value = similarity[(row, column)];
            if value > best_of_row[row].0 {
                best_of_row[row] = (value, column);
            }
            if value > best_of_column[column].0 {
                best_of_column[column] = (value, row);
            }
        }
    }
    // A row that nothing was compared with has no partner.
    let partner =
        |&row: &usize| Some((row, best_of_row[row].1)).filter(|&(_, column)| column != usize::MAX);
    rows.iter()
        .filter_map(partner)
        .filter(|&(row, column)| best_of_column[column].1 == row)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::{PatchGrid, PoolingStride, ScaleKeyPatches};
    use placeformer_vision::extract::pack;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const DIM: usize = 64;

    fn unit(values: &[f32]) -> Vec<f32> {
        let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
        values.iter().map(|v| v / length).collect()
    }

    /// Patches of one place seen twice, `shift` columns apart, each with some noise of its own.
    fn seen(shift: u32, seed: u64) -> KeyPatches {
        let grid = PatchGrid {
            columns: 12,
            rows: 9,
            patch_px: 14,
            stride: PoolingStride::Kernel,
        };
        let mut place = ChaCha8Rng::seed_from_u64(5);
        let mut noise = ChaCha8Rng::seed_from_u64(seed);
        let mut scale = |columns: u32, count: u32, shift: u32| {
            let mut descriptors = Vec::new();
            for _ in 0..count {
                let values: Vec<f32> = (0..DIM)
                    .map(|_| place.random_range(-1f32..1.0) + 0.2 * noise.random_range(-1f32..1.0))
                    .collect();
                descriptors.extend(unit(&values));
            }
            let index = (0..count)
                .map(|n| n / (columns - 2) * columns + n % (columns - 2) + shift)
                .collect();
            ScaleKeyPatches {
                index,
                attention: vec![2.0; count as usize],
                descriptors,
            }
        };
        KeyPatches {
            grid,
            dim: DIM,
            scales: [scale(12, 50, shift), scale(6, 12, 0), scale(4, 4, 0)],
        }
    }

    #[test]
    fn full_precision_and_int8_agree_where_the_nearest_is_clear() {
        let query = seen(0, 1);
        let reference = seen(2, 2);
        let reranker = Reranker::new(RerankConfig::default());
        let a = Whole::of(&query);
        let b = Whole::of(&reference);
        let full = a.score(&a.descriptors.transpose(), &b, &reranker);
        let packed = reranker.score(&pack(&query), &pack(&reference));
        assert_eq!(full.combinations, packed.combinations);
        assert_eq!(full.spatial_score, packed.spatial_score);
        assert!(full.combinations[0].inliers >= 45, "{full:?}");
    }

    #[test]
    fn only_each_others_nearest_are_pairs_and_only_within_the_union() {
        let similarity =
            DMatrix::from_row_slice(3, 3, &[0.9, 0.1, 0.8, 0.95, 0.2, 0.1, 0.3, 0.2, 0.1]);
        assert_eq!(mutual_pairs(&similarity, &[0, 1, 2], &[0, 1, 2]), [(1, 0)]);
        assert_eq!(
            mutual_pairs(&similarity, &[0, 1, 2], &[1, 2]),
            [(0, 2), (1, 1)]
        );
        assert_eq!(mutual_pairs(&similarity, &[], &[0, 1, 2]), []);
    }
}

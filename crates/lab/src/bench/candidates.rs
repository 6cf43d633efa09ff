//! The rows of a query's candidates: loading their key patches from a store, and re-ranking them.

use super::baselines;
use super::context::{Bench, agree};
use super::error::BenchError;
use super::limits::Limits;
use super::measure::paired;
use super::row::BenchRow;
use super::scenes::{RerankScene, unit_vector};
use placeformer_core::types::{
    ContentHash, Descriptor, KeyPatches, MapName, ModelId, NewReference, PackedPatches,
    ReferenceFields, ReferenceId, SCALES, ScaleKeyPatches, ScaleSet,
};
use placeformer_store::{Inserted, ReadPlaces, SqliteStore, StoreConfig, WritePlaces};
use placeformer_vision::extract::pack;
use placeformer_vision::rerank::{RerankConfig, Reranked, Reranker};
use rayon::prelude::*;
use std::path::Path;

/// A new store in `folder` that holds the candidates of a scene, in their order.
///
/// # Errors
/// Storing fails.
pub fn store_scene(
    scene: &RerankScene,
    folder: &Path,
) -> Result<(SqliteStore, Vec<ReferenceId>), BenchError> {
    let store = SqliteStore::open(folder, &StoreConfig::default())?;
    // Proven by the name itself, which is within the allowed letters.
    let map: MapName = "candidates"
        .parse()
        .unwrap_or_else(|_| unreachable!("a constant name of letters"));
    let new = scene
        .candidates
        .iter()
        .zip(0u64..)
        .map(|(patches, number)| NewReference {
            map: map.clone(),
            fields: ReferenceFields::default(),
            content_hash: ContentHash::of(&number.to_le_bytes()),
            model: ModelId::new("scene"),
            descriptor: Descriptor {
                global: unit_vector(number),
                pooled: vec![1.0, 0.0],
                patches: pack(patches),
            },
        });
    let id = |inserted| match inserted {
        Inserted::Created(reference) | Inserted::AlreadyThere(reference) => reference.id,
    };
    let ids: Result<Vec<_>, _> = store
        .insert_many(new.collect())
        .into_iter()
        .map(|inserted| inserted.map(id))
        .collect();
    Ok((store, ids?))
}

/// Key patches in full precision, as far as the codes tell.
pub(super) fn dequantised(patches: &PackedPatches) -> KeyPatches {
    let scale = |scale: usize| {
        let rows = patches.rows(scale);
        let values = |row: usize| {
            let codes = &patches.codes[row * patches.dim..][..patches.dim];
            codes
                .iter()
                .map(move |&code| f32::from(code) * patches.factor[row])
        };
        ScaleKeyPatches {
            index: patches.index[rows.clone()]
                .iter()
                .map(|&index| u32::from(index))
                .collect(),
            attention: patches.attention[rows.clone()]
                .iter()
                .map(|attention| attention.to_f32())
                .collect(),
            descriptors: rows.flat_map(values).collect(),
        }
    };
    KeyPatches {
        grid: patches.grid,
        dim: patches.dim,
        scales: [1, 2, 3].map(scale),
    }
}

/// Multiply-adds, each counted as two operations, of comparing a query's key patches with each
/// candidate's: every pair of scales that occurs, once.
pub(super) fn matching_operations(query: &KeyPatches, candidates: &[KeyPatches]) -> f64 {
    let sets = ScaleSet::paper_default();
    let together = |a: usize, b: usize| sets.iter().any(|set| set.contains(a) && set.contains(b));
    let count = |patches: &KeyPatches, scale: usize| patches.scales[scale - 1].index.len();
    let products = |candidate: &KeyPatches| -> usize {
        let pairs = (1..=SCALES).flat_map(|a| (1..=SCALES).map(move |b| (a, b)));
        pairs
            .filter(|&(a, b)| together(a, b))
            .map(|(a, b)| count(query, a) * count(candidate, b))
            .sum()
    };
    2.0 * (candidates.iter().map(products).sum::<usize>() * query.dim) as f64
}

impl Limits {
    /// Milliseconds that loading and matching candidates take at least: their bytes are read and
    /// written once, and their products computed at int8 (at f32 where the CPU has no instruction
    /// for that).
    pub(super) fn candidates_ms(&self, query: &KeyPatches, candidates: &[KeyPatches]) -> f64 {
        let values: usize = candidates
            .iter()
            .flat_map(|c| &c.scales)
            .map(|scale| scale.descriptors.len())
            .sum();
        let giga = self.int8_gops.unwrap_or(self.f32_gflops);
        Self::milliseconds(matching_operations(query, candidates), giga)
            + self.memory_ms(2.0 * values as f64)
    }
}

impl Bench<'_> {
    /// Key patches from a store whose pages are in the system's cache, decoded.
    pub(super) fn load(&self) -> Result<BenchRow, BenchError> {
        let (store, ids) = self.store_of_streets()?;
        let files = self.new_folder("plain")?;
        let mut bytes = 0;
        for id in &ids {
            let patches = store.patches(*id)?;
            bytes += patches.heap_bytes();
            let values = dequantised(&patches)
                .scales
                .into_iter()
                .flat_map(|scale| scale.descriptors);
            let path = files.join(id.to_string());
            std::fs::write(
                &path,
                values.flat_map(f32::to_le_bytes).collect::<Vec<u8>>(),
            )
            .map_err(|source| BenchError::Io {
                path: path.clone(),
                source,
            })?;
        }
        let plain = |id: &ReferenceId| {
            let bytes = std::fs::read(files.join(id.to_string())).unwrap_or_default();
            bytes
                .as_chunks::<4>()
                .0
                .iter()
                .map(|value| f32::from_le_bytes(*value))
                .collect::<Vec<f32>>()
        };
        let times = paired(
            10 * self.rounds,
            || {
                ids.par_iter()
                    .map(|id| store.patches(*id).map_or(0, |patches| patches.len()))
                    .sum::<usize>()
            },
            || ids.par_iter().map(|id| plain(id).len()).sum::<usize>(),
        );
        BenchRow::new(
            "load_100",
            "one f32 file per reference",
            times,
            self.limits.memory_ms(2.0 * bytes as f64),
        )
    }

    /// Candidates from a store, loaded, decoded, matched and verified; the baseline has them in
    /// memory.
    pub(super) fn rerank(&self, name: &'static str, share: f64) -> Result<BenchRow, BenchError> {
        let scene = RerankScene::new(share);
        let query = pack(&scene.query);
        let (store, ids) = store_scene(&scene, &self.new_folder(name)?)?;
        let reranker = Reranker::new(RerankConfig::default());
        let load = |candidate: usize| store.patches(ids[candidate]).map(Box::new);
        let ours = || match reranker.rerank(&query, ids.len(), load, None) {
            Reranked::Complete { ranked, .. } => {
                ranked.iter().map(|r| r.score.spatial_score as usize).sum()
            }
            Reranked::DeadlinePassed => 0,
        };
        let our_inliers: usize = ours();
        let plain_inliers: usize = baselines::rerank(&scene)?;
        // Where every correspondence is false, the baseline finds more: it takes homographies that
        // no camera can cause.
        let all_are_false = share == 0.0;
        agree(
            name,
            all_are_false || our_inliers as f64 >= 0.97 * plain_inliers as f64,
            || format!("{our_inliers} inliers, the baseline finds {plain_inliers}"),
        )?;
        let times = paired(self.rounds, ours, || baselines::rerank(&scene));
        let limit = self.limits.candidates_ms(&scene.query, &scene.candidates);
        BenchRow::new(name, "f32 GEMM and plain RANSAC, in memory", times, limit)
    }
}

#[cfg(test)]
mod tests {
    use super::super::scenes::{CANDIDATES, CAPS, DIM};
    use super::*;
    use placeformer_core::types::{PatchGrid, PoolingStride};

    fn patches(counts: [usize; SCALES], dim: usize) -> KeyPatches {
        let grid = PatchGrid {
            columns: 46,
            rows: 34,
            patch_px: 14,
            stride: PoolingStride::Kernel,
        };
        let scale = |count: usize| ScaleKeyPatches {
            index: (0..count as u32).collect(),
            attention: vec![1.0; count],
            descriptors: (0..count * dim)
                .map(|i| ((i * 37 % 101) as f32 - 50.0) / 50.0)
                .collect(),
        };
        KeyPatches {
            grid,
            dim,
            scales: counts.map(scale),
        }
    }

    #[test]
    fn each_pair_of_scales_is_counted_once() {
        // 1x1, 1x2, 2x1, 2x2, 2x3, 3x2, 3x3.
        let pairs: usize = 400 * 400 + 2 * 400 * 200 + 200 * 200 + 2 * 200 * 50 + 50 * 50;
        let one = patches(CAPS, DIM);
        let all = vec![one.clone(); CANDIDATES];
        assert_eq!(
            matching_operations(&one, &all),
            2.0 * (100 * pairs * 384) as f64
        );
    }

    #[test]
    fn a_stored_scene_gives_back_its_patches_within_half_a_step() {
        let scene = RerankScene {
            query: patches([3, 2, 1], 8),
            candidates: vec![patches([2, 0, 4], 8), patches([1; 3], 8)],
        };
        let folder = tempfile::tempdir().unwrap();
        let (store, ids) = store_scene(&scene, folder.path()).unwrap();
        for (id, candidate) in ids.iter().zip(&scene.candidates) {
            let back = dequantised(&store.patches(*id).unwrap());
            for (ours, truth) in back.scales.iter().zip(&candidate.scales) {
                assert_eq!(ours.index, truth.index);
                assert!(
                    ours.descriptors
                        .iter()
                        .zip(&truth.descriptors)
                        .all(|(a, b)| (a - b).abs() < 0.005)
                );
            }
        }
    }
}

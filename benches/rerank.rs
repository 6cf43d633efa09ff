//! Re-ranking 100 candidates at the caps (400 + 200 + 50 key patches of 384 values), with 40%, 15%
//! and no planted inliers: ours against what one would write first, in the same run.
//!
//! Both use all cores. `ours_matching_only` is ours with no homography tried, `ours_from_store`
//! ours with the candidates in a store, to be loaded and decoded each time; `load` is that alone.
//! `ransac` is the homographies alone, on one thread.
//!
//! `PLACEFORMER_BENCH_EXPORT=DIR` writes the same data as safetensors for
//! `benches/peers/rerank_opencv.py`, along with our inlier counts, and stops.

use criterion::{BenchmarkId, Criterion};
use placeformer_core::types::{PackedPatches, ScaleSet};
use placeformer_kernels::simd;
use placeformer_lab::bench::baselines::{self, joined};
use placeformer_lab::bench::scenes::{CANDIDATES, CAPS, DIM, RerankScene};
use placeformer_lab::bench::store_scene;
use placeformer_store::ReadPlaces;
use placeformer_vision::extract::pack;
use placeformer_vision::rerank::{RerankConfig, Reranked, Reranker};
use rayon::prelude::*;
use std::hint::black_box;
use std::path::Path;

fn ours(reranker: &Reranker, query: &PackedPatches, candidates: &[PackedPatches]) -> u32 {
    match reranker.rerank(
        query,
        candidates.len(),
        |i| Ok::<_, ()>(&candidates[i]),
        None,
    ) {
        Reranked::Complete { ranked, .. } => ranked.iter().map(|r| r.score.spatial_score).sum(),
        Reranked::DeadlinePassed => unreachable!("no deadline was set"),
    }
}

/// Writes descriptors, centres and our scores, so that other programs can be measured on the same
/// data.
fn export(dir: &Path, percent: u32, scene: &RerankScene) {
    use safetensors::{Dtype, tensor::TensorView};
    let total: usize = CAPS.iter().sum();
    let all = ScaleSet::new(&[1, 2, 3]).unwrap();
    let mut bytes: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
    let images: Vec<_> = std::iter::once(&scene.query)
        .chain(&scene.candidates)
        .map(|p| joined(p, all))
        .collect();
    let f32s = |values: &mut dyn Iterator<Item = f32>| {
        values.flat_map(f32::to_le_bytes).collect::<Vec<u8>>()
    };
    let descriptors = f32s(&mut images.iter().flat_map(|(d, _)| d.iter().copied()));
    let centres = f32s(
        &mut images
            .iter()
            .flat_map(|(_, c)| c.iter().flatten().map(|&v| v as f32)),
    );
    let reranker = Reranker::new(RerankConfig::default());
    let query = pack(&scene.query);
    let scores = scene.candidates.iter().flat_map(|c| {
        let score = reranker.score(&query, &pack(c));
        score
            .combinations
            .into_iter()
            .flat_map(|c| [c.matches as f32, c.inliers as f32])
            .collect::<Vec<_>>()
    });
    let scores = f32s(&mut scores.into_iter());
    bytes.push((
        "descriptors".into(),
        vec![CANDIDATES + 1, total, DIM],
        descriptors,
    ));
    bytes.push(("centres".into(), vec![CANDIDATES + 1, total, 2], centres));
    bytes.push((
        "ours_matches_inliers".into(),
        vec![CANDIDATES, 3, 2],
        scores,
    ));
    let views = bytes.iter().map(|(name, shape, data)| {
        (
            name,
            TensorView::new(Dtype::F32, shape.clone(), data).unwrap(),
        )
    });
    let path = dir.join(format!("rerank_{percent}.safetensors"));
    std::fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
    println!("wrote {}", path.display());
}

/// Milliseconds of CPU time that all threads of this process spent on `work`: on a busy machine the
/// ratios of these mean more than those of wall time. Zero where the system does not tell.
fn cpu_ms<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let spent = || -> u64 {
        let tasks = std::fs::read_dir("/proc/self/task")
            .into_iter()
            .flatten()
            .flatten();
        let schedule =
            tasks.filter_map(|task| std::fs::read_to_string(task.path().join("schedstat")).ok());
        schedule
            .filter_map(|text| text.split(' ').next()?.parse::<u64>().ok())
            .sum()
    };
    let before = spent();
    let result = work();
    (spent().saturating_sub(before) as f64 / 1e6, result)
}

/// Correspondences of every candidate and combination.
fn matches(
    reranker: &Reranker,
    query: &PackedPatches,
    candidates: &[PackedPatches],
) -> Vec<Vec<[f32; 4]>> {
    let points = |candidate: &PackedPatches| {
        let of_pair = |from: u32, to: u32| {
            let ([x, y], [u, v]) = (query.centre(from as usize), candidate.centre(to as usize));
            [x, y, u, v]
        };
        let found = reranker.explain(query, candidate).into_iter();
        found
            .map(|found| {
                found
                    .correspondences
                    .iter()
                    .map(|pair| of_pair(pair.query, pair.reference))
                    .collect()
            })
            .collect::<Vec<_>>()
    };
    candidates.iter().flat_map(points).collect()
}

/// The homographies alone, on one thread, and what a store adds.
fn bench_parts(criterion: &mut Criterion, percent: u32, scene: &RerankScene) {
    let query = pack(&scene.query);
    let candidates: Vec<_> = scene.candidates.iter().map(pack).collect();
    let reranker = Reranker::new(RerankConfig::default());
    let problems = matches(&reranker, &query, &candidates);
    let mut group = criterion.benchmark_group("ransac");
    group.sample_size(10);
    group.bench_function(
        BenchmarkId::new("300 homographies", format!("{percent}%")),
        |b| {
            b.iter(|| {
                problems
                    .iter()
                    .filter_map(|points| reranker.homography(black_box(points), 21.0))
                    .count()
            });
        },
    );
    group.finish();

    let folder = tempfile::tempdir().unwrap();
    let (store, ids) = store_scene(scene, folder.path()).unwrap();
    let load = |i: usize| store.patches(ids[i]).map(Box::new);
    let mut group = criterion.benchmark_group("rerank_100");
    group.sample_size(10);
    group.bench_function(
        BenchmarkId::new("ours_from_store", format!("{percent}%")),
        |b| {
            b.iter(|| reranker.rerank(&query, ids.len(), load, None));
        },
    );
    group.bench_function(BenchmarkId::new("load", format!("{percent}%")), |b| {
        b.iter(|| {
            (0..ids.len())
                .into_par_iter()
                .filter_map(|i| load(i).ok())
                .map(|patches| patches.len())
                .sum::<usize>()
        });
    });
    group.finish();
}

fn bench(criterion: &mut Criterion, percent: u32, scene: &RerankScene) {
    let query = pack(&scene.query);
    let candidates: Vec<_> = scene.candidates.iter().map(pack).collect();
    let reranker = Reranker::new(RerankConfig::default());
    let matching = Reranker::new(RerankConfig {
        max_iterations: 0,
        ..RerankConfig::default()
    });
    ours(&reranker, &query, &candidates);
    let (ours_cpu, ours_inliers) = cpu_ms(|| ours(&reranker, &query, &candidates));
    let (matching_cpu, _) = cpu_ms(|| ours(&matching, &query, &candidates));
    let (baseline_cpu, baseline_inliers) = cpu_ms(|| baselines::rerank(scene).unwrap());
    println!("{percent}%: inliers ours {ours_inliers}, baseline {baseline_inliers}");
    println!(
        "{percent}%: CPU ms ours {ours_cpu:.0} (matching {matching_cpu:.0}), baseline {baseline_cpu:.0}"
    );
    let mut group = criterion.benchmark_group("rerank_100");
    group.sample_size(10);
    let name = |who: &str| BenchmarkId::new(who, format!("{percent}%"));
    group.bench_function(name("ours"), |b| {
        b.iter(|| ours(black_box(&reranker), &query, &candidates))
    });
    group.bench_function(name("ours_matching_only"), |b| {
        b.iter(|| ours(black_box(&matching), &query, &candidates))
    });
    group.bench_function(name("baseline"), |b| {
        b.iter(|| baselines::rerank(black_box(scene)))
    });
    group.finish();
}

fn main() {
    println!("SIMD level {}", simd::selected().level());
    let export_to = std::env::var_os("PLACEFORMER_BENCH_EXPORT");
    let mut criterion = Criterion::default().configure_from_args();
    for percent in [40, 15, 0] {
        let scene = RerankScene::new(f64::from(percent) / 100.0);
        match &export_to {
            Some(dir) => export(Path::new(dir), percent, &scene),
            None => {
                bench(&mut criterion, percent, &scene);
                bench_parts(&mut criterion, percent, &scene);
            }
        }
    }
    criterion.final_summary();
}

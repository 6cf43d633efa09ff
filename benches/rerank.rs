//! Re-ranking 100 candidates at the caps (400 + 200 + 50 key patches of 384 values), with 40%, 15% and no planted
//! inliers: ours against what one would write first, in the same run.
//!
//! The baseline multiplies f32 descriptors with candle's GEMM, takes the maxima of the matrix, and runs a plain
//! RANSAC (random samples, 8x8 solve, adaptive stop at the same confidence and at most 2000 samples). Both use all
//! cores. `ours_matching_only` is ours with no homography tried.
//!
//! `PLACEFORMER_BENCH_EXPORT=DIR` writes the same data as safetensors for `benches/peers/rerank_opencv.py`, along with
//! our inlier counts, and stops.

use candle_core::{Device, Tensor};
use criterion::{BenchmarkId, Criterion};
use nalgebra::{SMatrix, SVector};
use placeformer::kernels::simd;
use placeformer::rerank::{RerankConfig, Reranked, Reranker};
use placeformer::types::{KeyPatches, PackedPatches, PatchGrid, PoolingStride, ScaleKeyPatches, ScaleSet};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::hint::black_box;
use std::path::Path;

const CANDIDATES: usize = 100;
const CAPS: [usize; 3] = [400, 200, 50];
const DIM: usize = 384;
const GRID: PatchGrid = PatchGrid { columns: 46, rows: 34, patch_px: 14, stride: PoolingStride::Kernel };
const TOLERANCE: f64 = 21.0;

/// One query and its candidates.
struct Scene {
    query: KeyPatches,
    candidates: Vec<KeyPatches>,
}

fn gaussian(rng: &mut impl Rng) -> f32 {
    // Twelve uniforms: near enough to normal for descriptors.
    (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0
}

fn normalised(values: impl Iterator<Item = f32>) -> Vec<f32> {
    let values: Vec<f32> = values.collect();
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    values.into_iter().map(|v| v / norm).collect()
}

fn random_scale(scale: usize, rng: &mut impl Rng) -> ScaleKeyPatches {
    let (columns, rows) = GRID.pooled(scale);
    let index = (0..CAPS[scale - 1]).map(|_| rng.random_range(0..(columns * rows) as u32)).collect();
    let descriptors =
        (0..CAPS[scale - 1]).flat_map(|_| normalised((0..DIM).map(|_| gaussian(rng)).collect::<Vec<_>>().into_iter()));
    ScaleKeyPatches { index, attention: vec![1.0; CAPS[scale - 1]], descriptors: descriptors.collect() }
}

/// A view of the query in which `share` of the patches reappear under a homography, snapped to the grid.
fn candidate(query: &KeyPatches, share: f64, rng: &mut impl Rng) -> KeyPatches {
    let mut around = |middle: f64, spread: f64| middle + spread * (2.0 * rng.random::<f64>() - 1.0);
    let h = [
        around(1.0, 0.1),
        around(0.0, 0.05),
        around(0.0, 40.0),
        around(0.0, 0.05),
        around(1.0, 0.1),
        around(0.0, 40.0),
        around(0.0, 1e-4),
        around(0.0, 1e-4),
        1.0,
    ];
    let scales = [1, 2, 3].map(|scale| {
        let mut fresh = random_scale(scale, rng);
        let (columns, rows) = GRID.pooled(scale);
        let side = (scale * 14) as f64;
        for i in 0..CAPS[scale - 1] {
            let from = &query.scales[scale - 1];
            let [x, y] = GRID.centre(scale, from.index[i] as usize).map(f64::from);
            let w = h[6] * x + h[7] * y + h[8];
            let column = ((h[0] * x + h[1] * y + h[2]) / w / side).floor();
            let row = ((h[3] * x + h[4] * y + h[5]) / w / side).floor();
            let inside = (0.0..columns as f64).contains(&column) && (0.0..rows as f64).contains(&row);
            if rng.random::<f64>() < share && inside {
                fresh.index[i] = row as u32 * columns as u32 + column as u32;
                let old = &from.descriptors[i * DIM..][..DIM];
                let near = normalised(old.iter().map(|v| v + 0.03 * gaussian(rng)).collect::<Vec<_>>().into_iter());
                fresh.descriptors[i * DIM..][..DIM].copy_from_slice(&near);
            }
        }
        fresh
    });
    KeyPatches { grid: GRID, dim: DIM, scales }
}

fn scene(share: f64) -> Scene {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let query = KeyPatches { grid: GRID, dim: DIM, scales: [1, 2, 3].map(|scale| random_scale(scale, &mut rng)) };
    let candidates = (0..CANDIDATES).map(|_| candidate(&query, share, &mut rng)).collect();
    Scene { query, candidates }
}

fn ours(reranker: &Reranker, query: &PackedPatches, candidates: &[PackedPatches]) -> u32 {
    match reranker.rerank(query, candidates.len(), |i| Ok::<_, ()>(&candidates[i]), None) {
        Reranked::Complete { ranked, .. } => ranked.iter().map(|r| r.score.spatial_score).sum(),
        Reranked::DeadlinePassed => unreachable!("no deadline was set"),
    }
}

/// Descriptors and centres of a union of scales.
fn joined(patches: &KeyPatches, scales: ScaleSet) -> (Vec<f32>, Vec<[f64; 2]>) {
    let (mut descriptors, mut centres) = (Vec::new(), Vec::new());
    for scale in scales.scales() {
        let part = &patches.scales[scale - 1];
        descriptors.extend_from_slice(&part.descriptors);
        centres.extend(part.index.iter().map(|&i| patches.grid.centre(scale, i as usize).map(f64::from)));
    }
    (descriptors, centres)
}

fn baseline(scene: &Scene) -> usize {
    let score = |reference: &KeyPatches| -> usize {
        let combination = |scales| {
            let ((q, q_centres), (r, r_centres)) = (joined(&scene.query, scales), joined(reference, scales));
            let (n, m) = (q_centres.len(), r_centres.len());
            let q = Tensor::from_vec(q, (n, DIM), &Device::Cpu).unwrap();
            let r = Tensor::from_vec(r, (m, DIM), &Device::Cpu).unwrap();
            let similarity = q.matmul(&r.t().unwrap()).unwrap();
            let forth = similarity.argmax(1).unwrap().to_vec1::<u32>().unwrap();
            let back = similarity.argmax(0).unwrap().to_vec1::<u32>().unwrap();
            let mutual = (0..n).filter(|&i| back[forth[i] as usize] == i as u32);
            let points: Vec<_> = mutual.map(|i| (q_centres[i], r_centres[forth[i] as usize])).collect();
            plain_ransac(&points)
        };
        ScaleSet::paper_default().into_iter().map(combination).sum()
    };
    scene.candidates.par_iter().map(score).sum()
}

type PointPair = ([f64; 2], [f64; 2]);

fn plain_ransac(points: &[PointPair]) -> usize {
    let n = points.len();
    if n < 4 {
        return 0;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
    let (mut best, mut needed, mut drawn) = (0, 2000usize, 0);
    while drawn < needed {
        drawn += 1;
        let sample = rand::seq::index::sample(&mut rng, n, 4);
        let Some(h) = solve(sample.iter().map(|i| points[i])) else { continue };
        let count = points.iter().filter(|pair| agrees(&h, pair)).count();
        if count > best {
            best = count;
            let all = (best as f64 / n as f64).powi(4);
            let enough = ((1.0 - 0.995f64).ln() / (1.0 - all).ln()).ceil();
            needed = needed.min(if enough.is_finite() { enough.max(0.0) as usize } else { 2000 });
        }
    }
    best
}

fn solve(sample: impl Iterator<Item = PointPair>) -> Option<SVector<f64, 8>> {
    let (mut a, mut b) = (SMatrix::<f64, 8, 8>::zeros(), SVector::<f64, 8>::zeros());
    for (i, ([x, y], [u, v])) in sample.enumerate() {
        for (row, values, right) in [
            (2 * i, [x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y], u),
            (2 * i + 1, [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y], v),
        ] {
            values.into_iter().enumerate().for_each(|(column, value)| a[(row, column)] = value);
            b[row] = right;
        }
    }
    a.lu().solve(&b)
}

fn agrees(h: &SVector<f64, 8>, ([x, y], [u, v]): &PointPair) -> bool {
    let w = h[6] * x + h[7] * y + 1.0;
    let (dx, dy) = ((h[0] * x + h[1] * y + h[2]) / w - u, (h[3] * x + h[4] * y + h[5]) / w - v);
    w > 0.0 && dx * dx + dy * dy <= TOLERANCE * TOLERANCE
}

/// Writes descriptors, centres and our scores, so that other programs can be measured on the same data.
fn export(dir: &Path, percent: u32, scene: &Scene) {
    use safetensors::{Dtype, tensor::TensorView};
    let total: usize = CAPS.iter().sum();
    let all = ScaleSet::new(&[1, 2, 3]).unwrap();
    let mut bytes: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
    let images: Vec<_> = std::iter::once(&scene.query).chain(&scene.candidates).map(|p| joined(p, all)).collect();
    let f32s = |values: &mut dyn Iterator<Item = f32>| values.flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let descriptors = f32s(&mut images.iter().flat_map(|(d, _)| d.iter().copied()));
    let centres = f32s(&mut images.iter().flat_map(|(_, c)| c.iter().flatten().map(|&v| v as f32)));
    let reranker = Reranker::new(RerankConfig::default());
    let query = PackedPatches::quantise(&scene.query);
    let scores = scene.candidates.iter().flat_map(|c| {
        let score = reranker.score(&query, &PackedPatches::quantise(c));
        score.combinations.into_iter().flat_map(|c| [c.matches as f32, c.inliers as f32]).collect::<Vec<_>>()
    });
    let scores = f32s(&mut scores.into_iter());
    bytes.push(("descriptors".into(), vec![CANDIDATES + 1, total, DIM], descriptors));
    bytes.push(("centres".into(), vec![CANDIDATES + 1, total, 2], centres));
    bytes.push(("ours_matches_inliers".into(), vec![CANDIDATES, 3, 2], scores));
    let views =
        bytes.iter().map(|(name, shape, data)| (name, TensorView::new(Dtype::F32, shape.clone(), data).unwrap()));
    let path = dir.join(format!("rerank_{percent}.safetensors"));
    std::fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
    println!("wrote {}", path.display());
}

/// Milliseconds of CPU time that all threads of this process spent on `work`: on a busy machine the ratios of these
/// mean more than those of wall time. Zero where the system does not tell.
fn cpu_ms<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let spent = || -> u64 {
        let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
        let schedule = tasks.filter_map(|task| std::fs::read_to_string(task.path().join("schedstat")).ok());
        schedule.filter_map(|text| text.split(' ').next()?.parse::<u64>().ok()).sum()
    };
    let before = spent();
    let result = work();
    (spent().saturating_sub(before) as f64 / 1e6, result)
}

fn bench(criterion: &mut Criterion, percent: u32, scene: &Scene) {
    let query = PackedPatches::quantise(&scene.query);
    let candidates: Vec<_> = scene.candidates.iter().map(PackedPatches::quantise).collect();
    let reranker = Reranker::new(RerankConfig::default());
    let matching = Reranker::new(RerankConfig { max_iterations: 0, ..RerankConfig::default() });
    ours(&reranker, &query, &candidates);
    let (ours_cpu, ours_inliers) = cpu_ms(|| ours(&reranker, &query, &candidates));
    let (matching_cpu, _) = cpu_ms(|| ours(&matching, &query, &candidates));
    let (baseline_cpu, baseline_inliers) = cpu_ms(|| baseline(scene));
    println!("{percent}%: inliers ours {ours_inliers}, baseline {baseline_inliers}");
    println!("{percent}%: CPU ms ours {ours_cpu:.0} (matching {matching_cpu:.0}), baseline {baseline_cpu:.0}");
    let mut group = criterion.benchmark_group("rerank_100");
    group.sample_size(10);
    let name = |who: &str| BenchmarkId::new(who, format!("{percent}%"));
    group.bench_function(name("ours"), |b| b.iter(|| ours(black_box(&reranker), &query, &candidates)));
    group.bench_function(name("ours_matching_only"), |b| b.iter(|| ours(black_box(&matching), &query, &candidates)));
    group.bench_function(name("baseline"), |b| b.iter(|| baseline(black_box(scene))));
    group.finish();
}

fn main() {
    println!("SIMD level {}", simd::selected().level());
    let export_to = std::env::var_os("PLACEFORMER_BENCH_EXPORT");
    let mut criterion = Criterion::default().configure_from_args();
    for percent in [40, 15, 0] {
        let scene = scene(f64::from(percent) / 100.0);
        match &export_to {
            Some(dir) => export(Path::new(dir), percent, &scene),
            None => bench(&mut criterion, percent, &scene),
        }
    }
    criterion.final_summary();
}

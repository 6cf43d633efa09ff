//! The room against outputs of the reference implementation, planted geometry and hostile input.

mod parity;

use super::mutual_nn::{Matcher, PreparedQuery};
use super::ransac::{Estimate, Ransac, RansacSettings};
use super::*;
use crate::extract::pack;
use placeformer_core::types::{KeyPatches, PatchGrid, PoolingStride, ScaleKeyPatches};
use proptest::prelude::*;
use std::path::Path;

const SETTINGS: RansacSettings = RansacSettings {
    tolerance_px: 21.0,
    max_iterations: 2000,
    confidence: 0.995,
};

/// A file of the reference's outputs; see the README beside it.
fn golden(name: &str) -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/golden")
        .join(name);
    std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn floats(tensor: &safetensors::tensor::TensorView<'_>) -> Vec<f32> {
    tensor
        .data()
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
        .collect()
}

/// Key patches of the default path; descriptors only where the file has all of them.
fn golden_patches(image: &str, [width, height]: [u16; 2]) -> (Vec<Vec<[f32; 2]>>, KeyPatches) {
    let bytes = golden(&format!("{image}_{width}x{height}.safetensors"));
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let tensor = |scale: usize, name: &str| file.tensor(&format!("exit8_key{scale}_{name}"));
    let grid = PatchGrid {
        columns: width / 14,
        rows: height / 14,
        patch_px: 14,
        stride: PoolingStride::Kernel,
    };
    let scale = |scale: usize| {
        let index = tensor(scale, "index").unwrap();
        ScaleKeyPatches {
            index: index
                .data()
                .chunks_exact(8)
                .map(|b| i64::from_le_bytes(b.try_into().unwrap()) as u32)
                .collect(),
            attention: floats(&tensor(scale, "attention").unwrap()),
            descriptors: tensor(scale, "descriptor")
                .map(|t| floats(&t))
                .unwrap_or_default(),
        }
    };
    let centres = [1, 2, 3].map(|s| {
        floats(&tensor(s, "centre_xy").unwrap())
            .chunks_exact(2)
            .map(|c| [c[0], c[1]])
            .collect()
    });
    (
        centres.into(),
        KeyPatches {
            grid,
            dim: 384,
            scales: [scale(1), scale(2), scale(3)],
        },
    )
}

#[derive(serde::Deserialize)]
struct GoldenPair {
    query: String,
    reference: String,
    size: [u16; 2],
    scores: std::collections::BTreeMap<String, GoldenScore>,
}

#[derive(serde::Deserialize)]
struct GoldenScore {
    mutual_pairs: Vec<[usize; 2]>,
    opencv_inliers: u32,
}

fn golden_pairs() -> Vec<GoldenPair> {
    serde_json::from_slice(&golden("pairs.json")).unwrap()
}

fn estimate(points: &[[f32; 4]]) -> Option<Estimate> {
    Ransac::default().estimate(simd::selected(), points.iter().copied(), &SETTINGS)
}

#[test]
fn golden_matches_have_on_average_at_least_the_inliers_of_opencv() {
    let (mut ours, mut theirs, mut problems) = (0, 0, 0);
    for pair in golden_pairs() {
        for (scales, golden) in &pair.scores {
            let points = golden_points(&pair, scales, golden);
            let found = estimate(&points).map_or(0, |e| e.inliers);
            println!(
                "{} {} {:?} {scales}: {} of {} (OpenCV {})",
                pair.query,
                pair.reference,
                pair.size,
                found,
                points.len(),
                golden.opencv_inliers
            );
            (ours, theirs, problems) = (ours + found, theirs + golden.opencv_inliers, problems + 1);
        }
    }
    println!("{problems} problems: {ours} inliers, OpenCV {theirs}");
    assert!(problems >= 24 && ours >= theirs);
}

/// The matched centres of one scale combination.
fn golden_points(pair: &GoldenPair, scales: &str, golden: &GoldenScore) -> Vec<[f32; 4]> {
    let scales: ScaleSet = scales.parse().unwrap();
    let joined = |image: &str| -> Vec<[f32; 2]> {
        let (centres, _) = golden_patches(image, pair.size);
        scales
            .scales()
            .flat_map(|s| centres[s - 1].clone())
            .collect()
    };
    let (query, reference) = (joined(&pair.query), joined(&pair.reference));
    let point = |&[q, r]: &[usize; 2]| [query[q][0], query[q][1], reference[r][0], reference[r][1]];
    golden.mutual_pairs.iter().map(point).collect()
}

/// Where `street_a` must land in `street_a_dusk`, in pixels of a `width` x `height` input.
fn true_homography([width, height]: [u16; 2]) -> [f64; 9] {
    let bytes = golden("homography.json");
    let all: std::collections::BTreeMap<String, [[f64; 3]; 3]> =
        serde_json::from_slice(&bytes).unwrap();
    let at_640x480 = all["a_to_a_dusk_640x480"];
    let scale = [f64::from(width) / 640.0, f64::from(height) / 480.0, 1.0];
    std::array::from_fn(|i| at_640x480[i / 3][i % 3] * scale[i / 3] / scale[i % 3])
}

/// The same from a pair's query to its reference, where there is a true one.
fn truth_of(pair: &GoldenPair) -> Option<[f64; 9]> {
    let there = true_homography(pair.size);
    match (&*pair.query, &*pair.reference) {
        ("street_a", "street_a_dusk") => Some(there),
        ("street_a_dusk", "street_a") => {
            let back = nalgebra::Matrix3::from_row_slice(&there)
                .try_inverse()
                .unwrap();
            Some(std::array::from_fn(|i| back[(i / 3, i % 3)]))
        }
        ("street_a", "street_a") => Some([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        _ => None,
    }
}

/// Mean distance in pixels between where two homographies send `points`.
fn mean_deviation(found: &[f64; 9], truth: &[f64; 9], points: &[[f64; 2]]) -> f64 {
    let deviation = |&point: &[f64; 2]| {
        let ([u, v], [s, t]) = (project(found, point), project(truth, point));
        (u - s).hypot(v - t)
    };
    points.iter().map(deviation).sum::<f64>() / points.len() as f64
}

fn project(homography: &[f64; 9], [x, y]: [f64; 2]) -> [f64; 2] {
    let [u, v, w] =
        [0, 3, 6].map(|row| homography[row] * x + homography[row + 1] * y + homography[row + 2]);
    [u / w, v / w]
}

#[test]
fn homographies_of_golden_matches_agree_with_the_true_one_both_ways_and_at_both_sizes() {
    let mut compared = 0;
    for pair in golden_pairs() {
        let Some(truth) = truth_of(&pair) else {
            continue;
        };
        for (scales, golden) in &pair.scores {
            let points = golden_points(&pair, scales, golden);
            let found = estimate(&points).unwrap().homography;
            let inliers: Vec<[f64; 2]> = points
                .iter()
                .map(|point| point.map(f64::from))
                .filter(|&[x, y, u, v]| {
                    let [s, t] = project(&found, [x, y]);
                    (s - u).hypot(t - v) <= f64::from(SETTINGS.tolerance_px)
                })
                .map(|[x, y, ..]| [x, y])
                .collect();
            let mean = mean_deviation(&found, &truth, &inliers);
            println!(
                "{} {} {:?} {scales}: {mean:.2} px from the truth",
                pair.query, pair.reference, pair.size
            );
            assert!(mean < 14.0, "more than a patch from the truth: {mean}");
            compared += 1;
        }
    }
    assert!(compared >= 18, "only {compared} homographies were compared");
}

#[test]
fn explained_homographies_agree_with_the_true_one() {
    let mut compared = 0;
    // Only at this size are there all descriptors.
    for pair in golden_pairs()
        .into_iter()
        .filter(|pair| pair.size == [448, 336])
    {
        let Some(truth) = truth_of(&pair) else {
            continue;
        };
        let patches = |name: &str| pack(&golden_patches(name, pair.size).1);
        let (query, reference) = (patches(&pair.query), patches(&pair.reference));
        for combination in Reranker::new(RerankConfig::default()).explain(&query, &reference) {
            let found = combination.homography.unwrap();
            assert_eq!(found[8], 1.0);
            let inliers: Vec<[f64; 2]> = combination
                .correspondences
                .iter()
                .filter(|c| c.inlier)
                .map(|c| query.centre(c.query as usize).map(f64::from))
                .collect();
            assert_eq!(inliers.len() as u32, combination.score.inliers);
            let mean = mean_deviation(&found, &truth, &inliers);
            println!(
                "{} {} {}: {mean:.2} px",
                pair.query, pair.reference, combination.score.scales
            );
            assert!(mean < 14.0, "more than a patch from the truth: {mean}");
            compared += 1;
        }
    }
    assert_eq!(compared, 9);
}

/// Mutual nearest neighbours as the paper writes them: f32 descriptors, Euclidean distance, lowest
/// index on a tie.
fn plain_mutual_pairs(query: &[f32], reference: &[f32], dim: usize) -> Vec<[usize; 2]> {
    let (query, reference): (Vec<_>, Vec<_>) = (
        query.chunks_exact(dim).collect(),
        reference.chunks_exact(dim).collect(),
    );
    let distance = |a: &[f32], b: &[f32]| {
        a.iter()
            .zip(b)
            .map(|(a, b)| f64::from(a - b).powi(2))
            .sum::<f64>()
    };
    let nearest = |from: &[f32], among: &[&[f32]]| {
        let distances: Vec<f64> = among.iter().map(|to| distance(from, to)).collect();
        (0..among.len()).min_by(|&i, &j| distances[i].total_cmp(&distances[j]).then(i.cmp(&j)))
    };
    let back: Vec<_> = reference.iter().map(|r| nearest(r, &query)).collect();
    let mutual = |q: usize| {
        nearest(query[q], &reference)
            .filter(|&r| back[r] == Some(q))
            .map(|r| [q, r])
    };
    (0..query.len()).filter_map(mutual).collect()
}

#[test]
fn golden_descriptors_have_the_golden_mutual_pairs() {
    let (mut agree, mut total) = (0, 0);
    for pair in golden_pairs()
        .into_iter()
        .filter(|pair| pair.size == [448, 336])
    {
        let ((_, query), (_, reference)) = (
            golden_patches(&pair.query, pair.size),
            golden_patches(&pair.reference, pair.size),
        );
        let (packed_query, packed_reference) = (pack(&query), pack(&reference));
        for (name, golden) in &pair.scores {
            let scales: ScaleSet = name.parse().unwrap();
            let joined = |patches: &KeyPatches| -> Vec<f32> {
                scales
                    .scales()
                    .flat_map(|s| patches.scales[s - 1].descriptors.clone())
                    .collect()
            };
            assert_eq!(
                plain_mutual_pairs(&joined(&query), &joined(&reference), 384),
                golden.mutual_pairs
            );
            // Rows of a union of neighbouring scales count from its first scale.
            let first =
                |patches: &PackedPatches| patches.rows(scales.scales().next().unwrap()).start;
            let (q0, r0) = (first(&packed_query), first(&packed_reference));
            let int8: Vec<[usize; 2]> = mutual_pairs(&packed_query, &packed_reference, scales)
                .into_iter()
                .map(|(q, r)| [q as usize - q0, r as usize - r0])
                .collect();
            agree += golden
                .mutual_pairs
                .iter()
                .filter(|pair| int8.contains(pair))
                .count();
            total += golden.mutual_pairs.len();
        }
    }
    println!("int8 finds {agree} of {total} mutual pairs of the reference");
    assert!(
        total > 0 && agree as f64 > 0.97 * total as f64,
        "{agree} of {total}"
    );
}

fn mutual_pairs(
    query: &PackedPatches,
    reference: &PackedPatches,
    scales: ScaleSet,
) -> Vec<(u32, u32)> {
    let mut prepared = PreparedQuery::new(simd::selected());
    prepared.prepare(query);
    let (mut matcher, mut pairs) = (Matcher::default(), Vec::new());
    matcher.compare(&prepared, reference, &[scales]);
    matcher.mutual_pairs(&prepared, reference, scales, &mut pairs);
    pairs
}

/// A small generator for test data.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as u32
    }

    fn unit(&mut self) -> f32 {
        self.next() as f32 / (1u64 << 31) as f32
    }

    fn code(&mut self) -> i8 {
        (i64::from(self.next() % 255) - 127) as i8
    }
}

const GRID: PatchGrid = PatchGrid {
    columns: 32,
    rows: 24,
    patch_px: 14,
    stride: PoolingStride::Kernel,
};

/// Patches at different places of the grid with random descriptors.
fn random_patches(counts: [usize; 3], dim: usize, noise: &mut Noise) -> PackedPatches {
    let total: usize = counts.iter().sum();
    let mut index = Vec::new();
    for (scale, &count) in counts.iter().enumerate() {
        let (columns, rows) = GRID.pooled(scale + 1);
        let cells = columns * rows;
        assert!(count <= cells);
        let start = noise.next() as usize;
        // 7 shares no factor with the numbers of cells (768, 192, 80), so no cell comes twice.
        index.extend((0..count).map(|i| ((start + 7 * i) % cells) as u16));
    }
    PackedPatches {
        grid: GRID,
        dim,
        counts,
        index,
        attention: vec![half::f16::ONE; total],
        factor: (0..total).map(|_| (1.0 + noise.unit()) / 1000.0).collect(),
        codes: (0..total * dim).map(|_| noise.code()).collect(),
    }
}

/// The same patches with the rows of each scale in another order; `order[new] = old`.
fn permuted(patches: &PackedPatches, noise: &mut Noise) -> (PackedPatches, Vec<usize>) {
    let mut order: Vec<usize> = (0..patches.len()).collect();
    for scale in 1..=3 {
        let rows = patches.rows(scale);
        for i in (rows.start + 1..rows.end).rev() {
            order.swap(i, rows.start + noise.next() as usize % (i - rows.start + 1));
        }
    }
    let moved = PackedPatches {
        index: order.iter().map(|&row| patches.index[row]).collect(),
        factor: order.iter().map(|&row| patches.factor[row]).collect(),
        codes: order
            .iter()
            .flat_map(|&row| patches.codes[row * patches.dim..][..patches.dim].to_vec())
            .collect(),
        ..patches.clone()
    };
    (moved, order)
}

fn counts() -> impl Strategy<Value = [usize; 3]> {
    [0usize..60, 0usize..30, 0usize..12]
}

fn scale_sets() -> impl Strategy<Value = ScaleSet> {
    (1u8..8).prop_map(|bits| {
        ScaleSet::new(
            &[1, 2, 3]
                .into_iter()
                .filter(|s| bits >> (s - 1) & 1 == 1)
                .collect::<Vec<_>>(),
        )
        .unwrap()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn pairs_are_mutual_and_swapping_the_images_gives_the_same(a in counts(), b in counts(), dim in 1usize..70, scales in scale_sets(), seed: u64) {
        let mut noise = Noise(seed);
        let (query, reference) = (random_patches(a, dim, &mut noise), random_patches(b, dim, &mut noise));
        let there = mutual_pairs(&query, &reference, scales);
        let mut back: Vec<_> = mutual_pairs(&reference, &query, scales).into_iter().map(|(r, q)| (q, r)).collect();
        back.sort_unstable();
        prop_assert_eq!(&there, &back);
        let mut references: Vec<_> = there.iter().map(|pair| pair.1).collect();
        references.sort_unstable();
        references.dedup();
        prop_assert_eq!(references.len(), there.len(), "a reference patch was matched twice");
        for &(q, r) in &there {
            prop_assert!(scales.contains(query.scale_of(q as usize)) && scales.contains(reference.scale_of(r as usize)));
        }
    }

    #[test]
    fn the_order_of_the_rows_does_not_matter(a in counts(), b in counts(), seed: u64) {
        let mut noise = Noise(seed);
        // Long random descriptors do not tie.
        let (query, reference) = (random_patches(a, 64, &mut noise), random_patches(b, 64, &mut noise));
        let ((other_query, query_order), (other_reference, reference_order)) = (permuted(&query, &mut noise), permuted(&reference, &mut noise));
        let scales = ScaleSet::new(&[1, 2, 3]).unwrap();
        let mut moved: Vec<_> = mutual_pairs(&other_query, &other_reference, scales)
            .into_iter()
            .map(|(q, r)| (query_order[q as usize] as u32, reference_order[r as usize] as u32))
            .collect();
        moved.sort_unstable();
        prop_assert_eq!(moved, mutual_pairs(&query, &reference, scales));
        let reranker = Reranker::new(RerankConfig::default());
        prop_assert_eq!(reranker.score(&other_query, &other_reference), reranker.score(&query, &reference));
    }

    #[test]
    fn every_level_gives_the_same_score(a in counts(), b in counts(), seed: u64) {
        let mut noise = Noise(seed);
        let (query, reference) = (random_patches(a, 33, &mut noise), random_patches(b, 33, &mut noise));
        let score = |simd| Reranker::with_simd(RerankConfig::default(), simd).score(&query, &reference);
        for simd in Simd::all() {
            prop_assert_eq!(score(simd), score(Simd::SCALAR), "{:?}", simd.level());
        }
    }

    #[test]
    fn planted_homographies_are_recovered_among_outliers(n in 60usize..300, share in 0.35f64..1.0, seed: u64) {
        let (points, truth, planted) = planted(n, share, seed);
        let found = estimate(&points).unwrap();
        prop_assert!(found.inliers as usize >= planted, "{} of {} planted among {}", found.inliers, planted, n);
        for [x, y] in [[100.0, 100.0], [350.0, 100.0], [350.0, 250.0], [100.0, 250.0]] {
            let ([u, v], [s, t]) = (project(&found.homography, [x, y]), project(&truth, [x, y]));
            // An inlier lies within 21 px of its image under the one and within 7 px (5 px on each
            // axis) under the other.
            prop_assert!((u - s).hypot(v - t) < 28.1, "({}, {}) instead of ({}, {})", u, v, s, t);
        }
    }
}

/// `share` of `n` correspondences follow a homography to within 5 px, the others lie anywhere.
fn planted(n: usize, share: f64, seed: u64) -> (Vec<[f32; 4]>, [f64; 9], usize) {
    let mut noise = Noise(seed);
    let mut around =
        |middle: f64, spread: f64| middle + spread * (2.0 * f64::from(noise.unit()) - 1.0);
    let truth = [
        around(1.0, 0.2),
        around(0.0, 0.1),
        around(0.0, 30.0),
        around(0.0, 0.1),
        around(1.0, 0.2),
        around(0.0, 30.0),
        around(0.0, 3e-4),
        around(0.0, 3e-4),
        1.0,
    ];
    let inliers = (n as f64 * share).round() as usize;
    let points = (0..n)
        .map(|i| {
            let [x, y] = [around(224.0, 217.0), around(168.0, 161.0)];
            let [u, v] = if i < inliers {
                let [u, v] = project(&truth, [x, y]);
                [around(u, 3.5), around(v, 3.5)]
            } else {
                [around(224.0, 217.0), around(168.0, 161.0)]
            };
            [x, y, u, v].map(|value| value as f32)
        })
        .collect();
    (points, truth, inliers)
}

#[test]
fn degenerate_correspondences_are_survived() {
    let line: Vec<[f32; 4]> = (0..100)
        .map(|i| {
            [
                i as f32 * 4.0,
                i as f32 * 3.0,
                i as f32 * 4.0,
                i as f32 * 3.0,
            ]
        })
        .collect();
    assert_eq!(estimate(&line), None);
    assert_eq!(estimate(&[[50.0, 60.0, 70.0, 80.0]; 200]), None);
    assert_eq!(estimate(&[]), None);
    assert_eq!(estimate(&line[..3]), None);
    let square = [
        [7.0, 7.0, 7.0, 7.0],
        [77.0, 7.0, 77.0, 7.0],
        [77.0, 77.0, 77.0, 77.0],
        [7.0, 77.0, 7.0, 77.0],
    ];
    assert_eq!(estimate(&square).unwrap().inliers, 4);
    // Each corner many times over: most samples repeat one.
    let repeated: Vec<_> = (0..200).map(|i| square[i % 4]).collect();
    assert_eq!(estimate(&repeated).unwrap().inliers, 200);
    // All but one on a line: no four make a quadrilateral.
    let mut almost = line.clone();
    almost[0] = [300.0, 7.0, 300.0, 7.0];
    assert_eq!(estimate(&almost), None);
    // Everything lands in one spot.
    let collapsed: Vec<_> = line
        .iter()
        .enumerate()
        .map(|(i, p)| [p[0], (i * i % 97) as f32, 100.0, 100.0])
        .collect();
    assert_eq!(estimate(&collapsed), None);
}

#[test]
fn four_true_matches_among_four_hundred_false_ones_do_no_harm() {
    let (mut points, ..) = planted(400, 0.0, 3);
    points.extend([
        [7.0, 7.0, 7.0, 7.0],
        [77.0, 7.0, 77.0, 7.0],
        [77.0, 77.0, 77.0, 77.0],
        [7.0, 77.0, 7.0, 77.0],
    ]);
    let found = estimate(&points).unwrap();
    assert!((4..40).contains(&found.inliers), "{}", found.inliers);
}

#[test]
fn the_order_of_correspondences_does_not_matter() {
    let (mut points, ..) = planted(150, 0.3, 9);
    let expected = estimate(&points);
    points.reverse();
    assert_eq!(estimate(&points), expected);
    points.rotate_left(37);
    assert_eq!(estimate(&points), expected);
}

#[test]
fn an_image_matches_itself_completely() {
    let patches = random_patches([300, 120, 50], 384, &mut Noise(1));
    let score = Reranker::new(RerankConfig::default()).score(&patches, &patches);
    assert!(
        score.combinations.iter().all(|c| c.matches == c.inliers),
        "{score:?}"
    );
    assert_eq!(score.spatial_score, 300 + 420 + 170);
}

#[test]
fn identical_descriptors_match_the_lowest_row_only() {
    let mut patches = random_patches([40, 10, 5], 16, &mut Noise(1));
    patches.codes.fill(5);
    patches.factor.fill(0.01);
    for scales in ScaleSet::paper_default() {
        let first = patches.rows(scales.scales().next().unwrap()).start as u32;
        assert_eq!(mutual_pairs(&patches, &patches, scales), [(first, first)]);
    }
    assert_eq!(
        Reranker::new(RerankConfig::default())
            .score(&patches, &patches)
            .spatial_score,
        0
    );
}

#[test]
fn images_without_patches_score_nothing() {
    let (none, some) = (
        random_patches([0; 3], 384, &mut Noise(1)),
        random_patches([50, 20, 5], 384, &mut Noise(2)),
    );
    let reranker = Reranker::new(RerankConfig::default());
    for (query, reference) in [(&none, &some), (&some, &none), (&none, &none)] {
        let score = reranker.score(query, reference);
        assert_eq!((score.spatial_score, score.combinations.len()), (0, 3));
        assert!(
            reranker
                .explain(query, reference)
                .iter()
                .all(|c| c.correspondences.is_empty() && c.homography.is_none())
        );
    }
}

/// Candidates of which the third shows the query's place; the fifth cannot be loaded.
fn rerank_five(deadline: Option<Deadline>) -> Reranked<&'static str> {
    let query = random_patches([100, 40, 20], 64, &mut Noise(1));
    let load = |i: usize| match i {
        2 => Ok(std::sync::Arc::new(query.clone())),
        4 => Err("gone"),
        _ => Ok(std::sync::Arc::new(random_patches(
            [0; 3],
            64,
            &mut Noise(2),
        ))),
    };
    Reranker::new(RerankConfig::default()).rerank(&query, 5, load, deadline)
}

#[test]
fn candidates_are_ranked_by_score_then_global_order_and_failures_listed() {
    let Reranked::Complete { ranked, failed } =
        rerank_five(Some(Deadline::after(std::time::Duration::from_secs(600))))
    else {
        panic!("there was time")
    };
    assert_eq!(
        ranked.iter().map(|r| r.candidate).collect::<Vec<_>>(),
        [2, 0, 1, 3]
    );
    assert_eq!(ranked[0].score.spatial_score, 100 + 140 + 60);
    assert_eq!(failed, [(4, "gone")]);
}

#[test]
fn a_passed_deadline_leaves_the_global_order() {
    assert!(matches!(
        rerank_five(Some(Deadline::after(std::time::Duration::ZERO))),
        Reranked::DeadlinePassed
    ));
    assert!(matches!(rerank_five(None), Reranked::Complete { .. }));
}

#[test]
fn a_deadline_that_passes_midway_stops_the_loading() {
    let query = random_patches([10, 4, 2], 16, &mut Noise(1));
    let deadline = Deadline::after(std::time::Duration::from_millis(30));
    let loads = std::sync::atomic::AtomicUsize::new(0);
    let load = |_| -> Result<Box<PackedPatches>, ()> {
        loads.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        std::thread::sleep(std::time::Duration::from_millis(40));
        Ok(Box::new(query.clone()))
    };
    let reranked =
        Reranker::new(RerankConfig::default()).rerank(&query, 10_000, load, Some(deadline));
    assert!(matches!(reranked, Reranked::DeadlinePassed));
    assert!(loads.into_inner() < 1000);
}

#[test]
#[should_panic(expected = "different lengths")]
fn descriptors_of_another_model_are_refused() {
    let (a, b) = (
        random_patches([5; 3], 8, &mut Noise(1)),
        random_patches([5; 3], 16, &mut Noise(1)),
    );
    Reranker::new(RerankConfig::default()).score(&a, &b);
}

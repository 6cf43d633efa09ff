//! Several modules together, compared with outputs of the reference implementation.

use crate::extract::pack;
use crate::golden;
use crate::rerank::{CombinationMatch, RerankConfig, Reranker};
use placeformer_core::types::{KeyPatches, PackedPatches, ScaleSet};

/// The size at which the golden files have the descriptors of all key patches.
const SIZE_WITH_DESCRIPTORS: [u16; 2] = [448, 336];

fn pairs_with_descriptors() -> impl Iterator<Item = golden::GoldenPair> {
    let pairs = golden::pairs().into_iter();
    pairs.filter(|pair| pair.size == SIZE_WITH_DESCRIPTORS)
}

fn key_patches(image: &str) -> KeyPatches {
    golden::patches(image, SIZE_WITH_DESCRIPTORS).key_patches
}

#[test]
fn explained_homographies_agree_with_the_true_one() {
    let mut compared = 0;
    for pair in pairs_with_descriptors() {
        let Some(truth) = pair.true_homography() else {
            continue;
        };
        let query = pack(&key_patches(&pair.query));
        let reference = pack(&key_patches(&pair.reference));
        for combination in Reranker::new(RerankConfig::default()).explain(&query, &reference) {
            let found = combination.homography.unwrap();
            assert_eq!(found[8], 1.0);
            let inliers = query_centres_of_inliers(&query, &combination);
            assert_eq!(inliers.len() as u32, combination.score.inliers);
            let mean = golden::mean_deviation(&found, &truth, &inliers);
            let scales = combination.score.scales;
            println!("{} {scales}: {mean:.2} px", pair.describe());
            assert!(mean < 14.0, "more than a patch from the truth: {mean}");
            compared += 1;
        }
    }
    assert_eq!(compared, 9);
}

fn query_centres_of_inliers(
    query: &PackedPatches,
    combination: &CombinationMatch,
) -> Vec<[f64; 2]> {
    let correspondences = combination.correspondences.iter();
    correspondences
        .filter(|correspondence| correspondence.inlier)
        .map(|correspondence| query.centre(correspondence.query as usize).map(f64::from))
        .collect()
}

#[test]
fn golden_descriptors_have_the_golden_mutual_pairs() {
    let mut agree = 0;
    let mut total = 0;
    for pair in pairs_with_descriptors() {
        let query = key_patches(&pair.query);
        let reference = key_patches(&pair.reference);
        let packed_query = pack(&query);
        let packed_reference = pack(&reference);
        for (name, golden) in &pair.scores {
            let scales: ScaleSet = name.parse().unwrap();
            assert_eq!(
                plain_mutual_pairs(
                    &descriptors_of(&query, scales),
                    &descriptors_of(&reference, scales),
                    384
                ),
                golden.mutual_pairs
            );
            let int8 = int8_mutual_pairs(&packed_query, &packed_reference, scales);
            let found = golden
                .mutual_pairs
                .iter()
                .filter(|pair| int8.contains(pair));
            agree += found.count();
            total += golden.mutual_pairs.len();
        }
    }
    println!("int8 finds {agree} of {total} mutual pairs of the reference");
    assert!(total > 0);
    assert!(agree as f64 > 0.97 * total as f64, "{agree} of {total}");
}

fn descriptors_of(patches: &KeyPatches, scales: ScaleSet) -> Vec<f32> {
    let of_scales = scales.scales().map(|scale| &patches.scales[scale - 1]);
    of_scales
        .flat_map(|patches| patches.descriptors.iter().copied())
        .collect()
}

/// The mutual pairs that re-ranking finds, as positions among the patches of `scales`.
fn int8_mutual_pairs(
    query: &PackedPatches,
    reference: &PackedPatches,
    scales: ScaleSet,
) -> Vec<[usize; 2]> {
    let config = RerankConfig {
        scales: vec![scales],
        ..RerankConfig::default()
    };
    // The scales of each combination are neighbours, so their rows are contiguous.
    let first_scale = scales.scales().next().unwrap();
    let first_query = query.rows(first_scale).start;
    let first_reference = reference.rows(first_scale).start;
    let explained = Reranker::new(config).explain(query, reference);
    let correspondences = explained[0].correspondences.iter();
    correspondences
        .map(|pair| {
            let query_row = pair.query as usize - first_query;
            let reference_row = pair.reference as usize - first_reference;
            [query_row, reference_row]
        })
        .collect()
}

/// Mutual nearest neighbours as the paper defines them (III-D): f32 descriptors, Euclidean
/// distance, the lowest index of several that are equally near.
fn plain_mutual_pairs(query: &[f32], reference: &[f32], dim: usize) -> Vec<[usize; 2]> {
    let query: Vec<&[f32]> = query.chunks_exact(dim).collect();
    let reference: Vec<&[f32]> = reference.chunks_exact(dim).collect();
    let back: Vec<usize> = reference.iter().map(|r| nearest(r, &query)).collect();
    let mut pairs = Vec::new();
    for (q, descriptor) in query.iter().enumerate() {
        let r = nearest(descriptor, &reference);
        if back[r] == q {
            pairs.push([q, r]);
        }
    }
    pairs
}

fn nearest(from: &[f32], among: &[&[f32]]) -> usize {
    let distance = |to: &[f32]| -> f64 {
        let differences = from.iter().zip(to).map(|(a, b)| f64::from(a - b));
        differences.map(|difference| difference.powi(2)).sum()
    };
    let distances: Vec<f64> = among.iter().map(|to| distance(to)).collect();
    let indices = 0..among.len();
    let nearest = indices.min_by(|&i, &j| distances[i].total_cmp(&distances[j]).then(i.cmp(&j)));
    nearest.expect("there are patches")
}

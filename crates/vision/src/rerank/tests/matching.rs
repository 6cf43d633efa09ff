//! Mutual nearest neighbours and whole scores, on random patches.

use super::{Noise, mutual_pairs, random_patches};
use crate::rerank::{RerankConfig, Reranker};
use placeformer_core::types::{PackedPatches, ScaleSet};
use placeformer_kernels::Simd;
use proptest::prelude::*;

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
        let is_member = |scale: &usize| bits >> (scale - 1) & 1 == 1;
        let scales: Vec<usize> = [1, 2, 3].into_iter().filter(is_member).collect();
        ScaleSet::new(&scales).unwrap()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn pairs_are_mutual_and_swapping_the_images_gives_the_same(
        a in counts(),
        b in counts(),
        dim in 1usize..70,
        scales in scale_sets(),
        seed: u64,
    ) {
        let mut noise = Noise(seed);
        let query = random_patches(a, dim, &mut noise);
        let reference = random_patches(b, dim, &mut noise);
        let there = mutual_pairs(&query, &reference, scales);
        let swapped = mutual_pairs(&reference, &query, scales);
        let mut back: Vec<_> = swapped.into_iter().map(|(r, q)| (q, r)).collect();
        back.sort_unstable();
        prop_assert_eq!(&there, &back);
        let mut references: Vec<_> = there.iter().map(|pair| pair.1).collect();
        references.sort_unstable();
        references.dedup();
        prop_assert_eq!(references.len(), there.len(), "a reference patch was matched twice");
        for &(q, r) in &there {
            prop_assert!(scales.contains(query.scale_of(q as usize)));
            prop_assert!(scales.contains(reference.scale_of(r as usize)));
        }
    }

    #[test]
    fn the_order_of_the_rows_does_not_matter(a in counts(), b in counts(), seed: u64) {
        let mut noise = Noise(seed);
        // Random descriptors of this length have no equal similarities, so order decides nothing.
        let query = random_patches(a, 64, &mut noise);
        let reference = random_patches(b, 64, &mut noise);
        let (other_query, query_order) = permuted(&query, &mut noise);
        let (other_reference, reference_order) = permuted(&reference, &mut noise);
        let scales = ScaleSet::new(&[1, 2, 3]).unwrap();
        let mut moved: Vec<_> = mutual_pairs(&other_query, &other_reference, scales)
            .into_iter()
            .map(|(q, r)| {
                let query_row = query_order[q as usize] as u32;
                let reference_row = reference_order[r as usize] as u32;
                (query_row, reference_row)
            })
            .collect();
        moved.sort_unstable();
        prop_assert_eq!(moved, mutual_pairs(&query, &reference, scales));
        let reranker = Reranker::new(RerankConfig::default());
        prop_assert_eq!(
            reranker.score(&other_query, &other_reference),
            reranker.score(&query, &reference)
        );
    }

    #[test]
    fn every_level_gives_the_same_score(a in counts(), b in counts(), seed: u64) {
        let mut noise = Noise(seed);
        let query = random_patches(a, 33, &mut noise);
        let reference = random_patches(b, 33, &mut noise);
        let score = |simd| {
            let reranker = Reranker::with_simd(RerankConfig::default(), simd);
            reranker.score(&query, &reference)
        };
        for simd in Simd::all() {
            prop_assert_eq!(score(simd), score(Simd::SCALAR), "{:?}", simd.level());
        }
    }
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
    let score = Reranker::new(RerankConfig::default()).score(&patches, &patches);
    assert_eq!(score.spatial_score, 0);
}

#[test]
fn images_without_patches_score_nothing() {
    let none = random_patches([0; 3], 384, &mut Noise(1));
    let some = random_patches([50, 20, 5], 384, &mut Noise(2));
    let reranker = Reranker::new(RerankConfig::default());
    for (query, reference) in [(&none, &some), (&some, &none), (&none, &none)] {
        let score = reranker.score(query, reference);
        assert_eq!(score.spatial_score, 0);
        assert_eq!(score.combinations.len(), 3);
        for combination in reranker.explain(query, reference) {
            assert!(combination.correspondences.is_empty());
            assert_eq!(combination.homography, None);
        }
    }
}

#[test]
#[should_panic(expected = "different lengths")]
fn descriptors_of_another_model_are_refused() {
    let a = random_patches([5; 3], 8, &mut Noise(1));
    let b = random_patches([5; 3], 16, &mut Noise(1));
    Reranker::new(RerankConfig::default()).score(&a, &b);
}

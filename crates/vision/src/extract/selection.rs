//! Key patches: the patches that the CLS token attends to most, above a threshold (paper III-C).

use super::fusion::{attention_map, average_pool, average_window};
use super::global::l2_normalise;
use placeformer_core::types::{KeyPatches, PatchGrid, SCALES, ScaleKeyPatches};

/// Indices of the `cap` largest values among those strictly above `tau`: largest first, of equal
/// values the lower index first.
pub fn select(attention: &[f32], cap: usize, tau: f32) -> Vec<u32> {
    let mut order: Vec<u32> = (0..attention.len() as u32)
        .filter(|&i| attention[i as usize] > tau)
        .collect();
    order.sort_by(|&a, &b| {
        attention[b as usize]
            .total_cmp(&attention[a as usize])
            .then(a.cmp(&b))
    });
    order.truncate(cap);
    order
}

/// Key patches of all three scales, from tokens `[n, dim]` and CLS attention `[heads, n]`.
///
/// At each scale at most `caps[scale - 1]` patches are chosen, and only such whose attention
/// exceeds `tau` times the uniform level. Their descriptors are L2-normalised.
pub fn key_patches(
    tokens: &[f32],
    cls_attention: &[f32],
    heads: usize,
    grid: PatchGrid,
    caps: [usize; SCALES],
    tau: f32,
) -> KeyPatches {
    let base = attention_map(cls_attention, heads);
    let dim = tokens.len() / base.len().max(1);
    let scales = [1, 2, 3].map(|scale| {
        let attention = average_pool(&base, &grid, scale, 1);
        let index = select(&attention, caps[scale - 1], tau);
        let mut descriptors = vec![0f32; index.len() * dim];
        // Most windows are not chosen, so only the chosen ones are averaged.
        for (descriptor, &i) in descriptors.chunks_exact_mut(dim.max(1)).zip(&index) {
            average_window(tokens, &grid, scale, i as usize, descriptor);
            l2_normalise(descriptor);
        }
        let attention = index.iter().map(|&i| attention[i as usize]).collect();
        ScaleKeyPatches {
            index,
            attention,
            descriptors,
        }
    });
    KeyPatches { grid, dim, scales }
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::PoolingStride;
    use proptest::prelude::*;

    #[test]
    fn the_threshold_is_strict_and_ties_go_to_the_lower_index() {
        assert_eq!(select(&[1.0, 2.0, 3.0, 2.0, 1.0], 4, 1.0), [2, 1, 3]);
        assert_eq!(select(&[2.0, 2.0, 2.0], 2, 1.0), [0, 1]);
        assert!(select(&[], 4, 0.0).is_empty());
    }

    proptest! {
        #[test]
        fn selection_is_the_top_of_the_list(
            values in proptest::collection::vec(0u8..20, 0..200),
            cap in 0usize..50,
            tau in 0u8..20,
        ) {
            let values: Vec<f32> = values.into_iter().map(f32::from).collect();
            let chosen = select(&values, cap, tau as f32);
            let above = values.iter().filter(|&&v| v > tau as f32).count();
            prop_assert_eq!(chosen.len(), cap.min(above));
            for pair in chosen.windows(2) {
                let a = values[pair[0] as usize];
                let b = values[pair[1] as usize];
                prop_assert!(a > b || (a == b && pair[0] < pair[1]));
            }
            let least = chosen.last().map_or(f32::INFINITY, |&i| values[i as usize]);
            let left_out = (0..values.len() as u32).filter(|i| !chosen.contains(i));
            if chosen.len() == cap && cap > 0 {
                prop_assert!(left_out.into_iter().all(|i| values[i as usize] <= least));
            }
        }

        #[test]
        fn every_key_patch_is_a_unit_vector_of_its_own_window(seed in 0u64..1000) {
            let grid = PatchGrid {
                columns: 7,
                rows: 5,
                patch_px: 14,
                stride: PoolingStride::Kernel,
            };
            let noise = |i: usize| (((i as u64 + 1) * (seed * 2 + 7919)) % 101) as f32 / 101.0;
            let tokens: Vec<f32> = (0..35 * 4).map(noise).collect();
            let attention: Vec<f32> = (0..2 * 35).map(|i| noise(i + 999) / 17.0).collect();
            let keys = key_patches(&tokens, &attention, 2, grid, [400, 200, 50], 0.9);
            for (scale, patches) in (1..).zip(&keys.scales) {
                let (columns, rows) = grid.pooled(scale);
                let pooled = average_pool(&tokens, &grid, scale, 4);
                for (descriptor, &i) in patches.descriptors.chunks(4).zip(&patches.index) {
                    prop_assert!((i as usize) < columns * rows);
                    let mut expected = pooled[i as usize * 4..][..4].to_vec();
                    l2_normalise(&mut expected);
                    prop_assert_eq!(descriptor, &expected[..]);
                }
            }
        }
    }
}

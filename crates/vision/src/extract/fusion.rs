//! Multi-scale patches: tokens and attention, average-pooled over 2x2 and 3x3 windows (paper
//! III-B).

use placeformer_core::types::PatchGrid;

/// The attention of each patch, `[n]`: the CLS attention summed over heads, in multiples of the
/// uniform level heads/n.
///
/// `cls_attention` is `[heads, n]`. With the paper's 12 heads and 1200 patches the uniform level is
/// 12/1200, so a multiple of 1 is the paper's threshold of 0.01.
pub fn attention_map(cls_attention: &[f32], heads: usize) -> Vec<f32> {
    let patches = cls_attention.len() / heads;
    let inverse_level = patches as f32 / heads as f32;
    let sum_over_heads = |patch: usize| -> f32 {
        (0..heads)
            .map(|head| cls_attention[head * patches + patch])
            .sum()
    };
    (0..patches)
        .map(|patch| sum_over_heads(patch) * inverse_level)
        .collect()
}

/// Averages `values` `[rows, columns, channels]` over windows of `scale` x `scale` patches. Windows
/// that do not fit into the grid are left out.
pub fn average_pool(values: &[f32], grid: &PatchGrid, scale: usize, channels: usize) -> Vec<f32> {
    if scale == 1 {
        return values.to_vec();
    }
    let (columns, rows) = grid.pooled(scale);
    let mut out = vec![0f32; rows * columns * channels];
    for (index, pooled) in out.chunks_exact_mut(channels).enumerate() {
        average_window(values, grid, scale, index, pooled);
    }
    out
}

/// The average of one window, into `out` (`[channels]`). `index` is the row-major number of the
/// window among those of its scale.
pub fn average_window(
    values: &[f32],
    grid: &PatchGrid,
    scale: usize,
    index: usize,
    out: &mut [f32],
) {
    let channels = out.len();
    let stride = grid.stride.at(scale);
    let (windows_per_row, _) = grid.pooled(scale);
    let top = index / windows_per_row * stride;
    let left = index % windows_per_row * stride;

    out.fill(0.0);
    for row in top..top + scale {
        for column in left..left + scale {
            let patch = row * usize::from(grid.columns) + column;
            let token = &values[patch * channels..][..channels];
            for (sum, value) in out.iter_mut().zip(token) {
                *sum += value;
            }
        }
    }
    let area = (scale * scale) as f32;
    for sum in out {
        *sum /= area;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::PoolingStride;
    use proptest::prelude::*;

    fn grid(columns: u16, rows: u16, stride: PoolingStride) -> PatchGrid {
        PatchGrid {
            columns,
            rows,
            patch_px: 14,
            stride,
        }
    }

    #[test]
    fn uniform_attention_is_one_everywhere() {
        assert!(
            attention_map(&[1.0 / 8.0; 24], 3)
                .iter()
                .all(|a| (a - 1.0).abs() < 1e-6)
        );
    }

    #[test]
    fn windows_do_not_overlap_and_the_rest_is_dropped() {
        let values: Vec<f32> = (0..15).map(|i| i as f32).collect();
        assert_eq!(
            average_pool(&values, &grid(5, 3, PoolingStride::Kernel), 2, 1),
            [3.0, 5.0]
        );
        assert_eq!(
            average_pool(&values, &grid(5, 3, PoolingStride::Kernel), 3, 1),
            [6.0]
        );
        assert_eq!(
            average_pool(&values, &grid(5, 3, PoolingStride::One), 3, 1),
            [6.0, 7.0, 8.0]
        );
    }

    #[test]
    fn a_grid_smaller_than_the_kernel_has_no_windows() {
        assert!(average_pool(&[1.0; 4], &grid(2, 2, PoolingStride::Kernel), 3, 1).is_empty());
    }

    proptest! {
        #[test]
        fn channels_are_pooled_independently(
            columns in 2u16..9,
            rows in 2u16..9,
            scale in 1usize..4,
            dense: bool,
        ) {
            let stride = if dense { PoolingStride::One } else { PoolingStride::Kernel };
            let grid = grid(columns, rows, stride);
            let n = columns as usize * rows as usize;
            let plane = |seed: usize| -> Vec<f32> {
                (0..n).map(|i| ((i * 7 + seed * 13) % 11) as f32).collect()
            };
            let interleaved = |a: &[f32], b: &[f32]| -> Vec<f32> {
                a.iter().zip(b).flat_map(|(x, y)| [*x, *y]).collect()
            };
            let a = plane(1);
            let b = plane(2);
            let pooled_together = average_pool(&interleaved(&a, &b), &grid, scale, 2);
            let pooled_a = average_pool(&a, &grid, scale, 1);
            let pooled_b = average_pool(&b, &grid, scale, 1);
            prop_assert_eq!(pooled_together, interleaved(&pooled_a, &pooled_b));
        }
    }
}

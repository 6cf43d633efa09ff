//! Re-ranking compared with the reference implementation, on planted geometry, and on hostile
//! input.

mod golden_pairs;
mod homography;
mod matching;
mod parity;
mod ranking;

use super::mutual_nn::{Matcher, PreparedQuery};
use super::ransac::{Estimate, Ransac, RansacSettings};
use placeformer_core::types::{PackedPatches, PatchGrid, PoolingStride, ScaleSet};
use placeformer_kernels::simd;

const SETTINGS: RansacSettings = RansacSettings {
    tolerance_px: 21.0,
    max_iterations: 2000,
    confidence: 0.995,
};

fn estimate(points: &[[f32; 4]]) -> Option<Estimate> {
    Ransac::default().estimate(simd::selected(), points.iter().copied(), &SETTINGS)
}

fn mutual_pairs(
    query: &PackedPatches,
    reference: &PackedPatches,
    scales: ScaleSet,
) -> Vec<(u32, u32)> {
    let mut prepared = PreparedQuery::new(simd::selected());
    prepared.prepare(query);
    let mut matcher = Matcher::default();
    let mut pairs = Vec::new();
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

/// Patches at different places of the grid, with random descriptors.
fn random_patches(counts: [usize; 3], dim: usize, noise: &mut Noise) -> PackedPatches {
    let total: usize = counts.iter().sum();
    let mut index = Vec::new();
    for (scale, &count) in counts.iter().enumerate() {
        let (columns, rows) = GRID.pooled(scale + 1);
        let cells = columns * rows;
        assert!(count <= cells);
        let start = noise.next() as usize;
        // 7 has no factor in common with the numbers of cells (768, 192, 80), so no cell comes
        // twice.
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

//! The self-check: samples, solutions and counts of a level against the scalar reference.

use super::sampler::OneByOne;
use super::{LANES, PointPairs, Sample, Sampler, count_inliers, proper, scalar, solve};
use crate::Simd;

/// Compares a level with the scalar reference on small odd inputs, bit for bit.
pub(crate) fn check(simd: Simd) -> Result<(), String> {
    for (n, seed) in [(4, 1), (5, 2), (37, 3), (131, 4)] {
        let pairs = sample_pairs(n, seed);
        let mut reference = OneByOne::new(seed);
        let expected: [Sample; LANES] = std::array::from_fn(|_| reference.next(n));
        let mut samples = [[0; 4]; LANES];
        Sampler::new(seed).fill(simd, n, &mut samples);
        if samples != expected {
            return Err(format!("samples of {n} correspondences"));
        }
        let ours = proper(simd, &pairs, &samples, 1e-3);
        let are_proper = scalar::proper(&pairs, &samples, 1e-3);
        if ours != are_proper {
            return Err(format!(
                "which samples of {n} correspondences are proper: \
                 {ours:b} instead of {are_proper:b}"
            ));
        }
        let ours = solve(simd, &pairs, &samples);
        let reference = scalar::solve(&pairs, &samples);
        for lane in (0..LANES).filter(|lane| are_proper >> lane & 1 == 1) {
            if ours.get(lane).map(f32::to_bits) != reference.get(lane).map(f32::to_bits) {
                return Err(format!("four-point solutions among {n} correspondences"));
            }
            for floor in [0, n / 2, n] {
                let homography = reference.get(lane);
                let ours = count_inliers(simd, &pairs, &homography, floor);
                let reference = scalar::count_inliers(&pairs, &homography, floor);
                if ours != reference {
                    return Err(format!(
                        "{ours} instead of {reference} inliers among {n} correspondences"
                    ));
                }
            }
        }
    }
    Ok(())
}

/// Correspondences on a grid, half of them related by one map and half at random.
pub(super) fn sample_pairs(n: usize, seed: u64) -> PointPairs {
    let mut state = seed;
    let mut next = move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) % 64
    };
    let mut pairs = PointPairs::default();
    pairs.fill((0..n).map(|i| {
        let x = next() as f32 / 2.0;
        let y = next() as f32 / 2.0;
        if i % 2 == 0 {
            [x, y, x + 1.25, y * 1.1 - 2.0]
        } else {
            [x, y, next() as f32 / 2.0, next() as f32 / 2.0]
        }
    }));
    pairs
}

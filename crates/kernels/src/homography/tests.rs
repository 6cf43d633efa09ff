//! The kernels of homographies against planted geometry, and every level against the scalar
//! reference.

use super::check::sample_pairs;
use super::*;
use proptest::prelude::*;

fn project(h: &[f32; 9], x: f32, y: f32) -> [f32; 3] {
    [0, 3, 6].map(|row| h[row] * x + h[row + 1] * y + h[row + 2])
}

/// Four correspondences, and the sample that takes them in order, in every lane.
fn one_sample(corners: [[f32; 4]; 4]) -> (PointPairs, [Sample; LANES]) {
    let mut pairs = PointPairs::default();
    pairs.fill(corners);
    (pairs, [[0, 1, 2, 3]; LANES])
}

const TRUE: [f32; 9] = [1.1, 0.1, -3.0, -0.05, 0.9, 2.0, 0.004, -0.002, 1.0];

fn moved(points: [[f32; 2]; 4]) -> [[f32; 4]; 4] {
    points.map(|[x, y]| {
        let [u, v, w] = project(&TRUE, x, y);
        [x, y, u / w, v / w]
    })
}

#[test]
fn four_corners_give_their_homography_with_positive_scale() {
    let square = [[0.0, 0.0], [30.0, 2.0], [28.0, 25.0], [-3.0, 22.0]];
    for order in [[0, 1, 2, 3], [3, 2, 1, 0], [0, 2, 1, 3]] {
        let (pairs, samples) = one_sample(moved(order.map(|i| square[i])));
        assert_eq!(
            proper(Simd::SCALAR, &pairs, &samples, 0.01),
            0xffff,
            "{order:?}"
        );
        let h = solve(Simd::SCALAR, &pairs, &samples).get(0);
        assert!(h[8] > 0.0);
        for (ours, truth) in h.iter().zip(TRUE) {
            assert!((ours / h[8] - truth).abs() < 1e-4, "{h:?}");
        }
    }
}

#[test]
fn degenerate_twisted_and_mirrored_samples_are_not_proper() {
    let square = [[0.0, 0.0], [30.0, 0.0], [30.0, 25.0], [0.0, 25.0]];
    let straight = moved([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [5.0, 9.0]]);
    let repeated = moved([[0.0, 0.0], [0.0, 0.0], [20.0, 0.0], [5.0, 9.0]]);
    let mut twisted = moved(square);
    twisted[0][2..].copy_from_slice(&moved(square)[1][2..]);
    twisted[1][2..].copy_from_slice(&moved(square)[0][2..]);
    let mirrored = square.map(|[x, y]| [x, y, -x, y]);
    for simd in Simd::all() {
        for corners in [straight, repeated, twisted, mirrored] {
            let (pairs, samples) = one_sample(corners);
            assert_eq!(proper(simd, &pairs, &samples, 0.01), 0, "{corners:?}");
        }
    }
}

#[test]
fn each_sample_has_its_own_bit_and_lane() {
    let pairs = sample_pairs(64, 3);
    let mut samples = [[0; 4]; LANES];
    Sampler::new(5).fill(Simd::SCALAR, 64, &mut samples);
    for simd in Simd::all() {
        let bits = proper(simd, &pairs, &samples, 0.1);
        let solved = solve(simd, &pairs, &samples);
        for (lane, sample) in samples.iter().enumerate() {
            let alone = [*sample; LANES];
            assert_eq!(proper(simd, &pairs, &alone, 0.1) & 1, bits >> lane & 1);
            let alone = solve(simd, &pairs, &alone).get(0);
            assert!(bits >> lane & 1 == 0 || alone == solved.get(lane));
        }
    }
}

#[test]
fn inliers_lie_within_one_unit_and_in_front() {
    let mut pairs = PointPairs::default();
    pairs.fill([
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.01, 0.0],
        [5.0, 5.0, 5.6, 5.7],
        [9.0, 9.0, 9.8, 9.8],
    ]);
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let behind = identity.map(|entry: f32| -entry);
    for simd in Simd::all() {
        assert_eq!(count_inliers(simd, &pairs, &identity, 0), 2);
        assert_eq!(count_inliers(simd, &pairs, &behind, 0), 0);
    }
}

#[test]
fn counting_sees_every_correspondence_once_however_many_there_are() {
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    for n in 0..200usize {
        let mut pairs = PointPairs::default();
        pairs.fill((0..n).map(|i| {
            [
                i as f32,
                0.0,
                i as f32 + if i % 3 == 0 { 0.0 } else { 5.0 },
                0.0,
            ]
        }));
        for simd in Simd::all() {
            assert_eq!(
                count_inliers(simd, &pairs, &identity, 0),
                n.div_ceil(3),
                "{n}"
            );
        }
        let mut xs = pairs.axis(0)[..n].to_vec();
        xs.sort_by(f32::total_cmp);
        assert!(xs.iter().enumerate().all(|(i, &x)| x == i as f32), "{n}");
    }
}

#[test]
#[should_panic(expected = "a pair that is not there")]
fn positions_beyond_the_pairs_are_refused() {
    let pairs = sample_pairs(10, 1);
    let mut samples = [[0, 1, 2, 3]; LANES];
    samples[LANES - 1] = [0, 1, 2, 10];
    proper(Simd::best(), &pairs, &samples, 0.1);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]
    #[test]
    fn every_level_gives_the_bits_of_the_scalar_reference(
        n in 4usize..200,
        seed: u64,
        floor in 0usize..220,
    ) {
        let pairs = sample_pairs(n, seed);
        let mut samples = [[0; 4]; LANES];
        Sampler::new(seed >> 8).fill(Simd::SCALAR, n, &mut samples);
        let bits = scalar::proper(&pairs, &samples, 0.1);
        let reference = scalar::solve(&pairs, &samples);
        for simd in Simd::all() {
            prop_assert_eq!(proper(simd, &pairs, &samples, 0.1), bits);
            let ours = solve(simd, &pairs, &samples);
            for lane in (0..LANES).filter(|lane| bits >> lane & 1 == 1) {
                prop_assert_eq!(
                    ours.get(lane).map(f32::to_bits),
                    reference.get(lane).map(f32::to_bits)
                );
                prop_assert_eq!(
                    count_inliers(simd, &pairs, &ours.get(lane), floor),
                    scalar::count_inliers(&pairs, &ours.get(lane), floor)
                );
            }
        }
    }
}

//! The homography search, on planted and on degenerate correspondences.

use super::{Noise, estimate};
use crate::golden::project;

/// RANSAC draws its samples at random, so a few searches in a thousand end at a homography that
/// explains most of the planted correspondences, but not all. The draws are fixed, so that the test
/// says the same every time.
#[test]
fn planted_homographies_are_recovered_among_outliers() {
    let mut draw = Noise(7);
    let draws = 400;
    let mut incomplete = Vec::new();
    for seed in 0..draws {
        let n = 60 + (f64::from(draw.unit()) * 240.0) as usize;
        let share = 0.35 + f64::from(draw.unit()) * 0.65;
        let (points, truth, planted) = planted(n, share, seed);
        let found = estimate(&points).unwrap();
        let inliers = found.inliers as usize;
        assert!(
            inliers * 5 >= planted * 4,
            "{inliers} of {planted} planted among {n}"
        );
        if inliers < planted {
            incomplete.push((inliers, planted, n));
            continue;
        }
        for [x, y] in [
            [100.0, 100.0],
            [350.0, 100.0],
            [350.0, 250.0],
            [100.0, 250.0],
        ] {
            let [u, v] = project(&found.homography, [x, y]);
            let [s, t] = project(&truth, [x, y]);
            // A planted inlier is within 7 px of where the true homography maps it (5 px on each
            // axis), and within 21 px of where the found one does.
            let distance = (u - s).hypot(v - t);
            assert!(distance < 28.1, "({u}, {v}) instead of ({s}, {t})");
        }
    }
    let allowed = draws as usize / 50;
    assert!(incomplete.len() <= allowed, "{incomplete:?} of {draws}");
}

/// `n` correspondences, of which a `share` follow a homography to within 5 px on each axis, while
/// the others lie anywhere; the homography; and how many follow it.
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
    let on_line = |i: usize| {
        let x = i as f32 * 4.0;
        let y = i as f32 * 3.0;
        [x, y, x, y]
    };
    let line: Vec<[f32; 4]> = (0..100).map(on_line).collect();
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

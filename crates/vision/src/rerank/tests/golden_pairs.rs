//! Homographies of the matches that the reference implementation found.

use super::{SETTINGS, estimate};
use crate::golden::{self, project};

#[test]
fn golden_matches_have_on_average_at_least_the_inliers_of_opencv() {
    let mut ours = 0;
    let mut theirs = 0;
    let mut problems = 0;
    for pair in golden::pairs() {
        for (scales, golden) in &pair.scores {
            let points = pair.points(scales.parse().unwrap(), golden);
            let found = estimate(&points).map_or(0, |estimate| estimate.inliers);
            println!(
                "{} {scales}: {found} of {} (OpenCV {})",
                pair.describe(),
                points.len(),
                golden.opencv_inliers
            );
            ours += found;
            theirs += golden.opencv_inliers;
            problems += 1;
        }
    }
    println!("{problems} problems: {ours} inliers, OpenCV {theirs}");
    assert!(problems >= 24);
    assert!(ours >= theirs);
}

#[test]
fn homographies_of_golden_matches_agree_with_the_true_one_both_ways_and_at_both_sizes() {
    let mut compared = 0;
    for pair in golden::pairs() {
        let Some(truth) = pair.true_homography() else {
            continue;
        };
        for (scales, golden) in &pair.scores {
            let points = pair.points(scales.parse().unwrap(), golden);
            let found = estimate(&points).unwrap().homography;
            let mut inliers = Vec::new();
            for point in points {
                let [x, y, u, v] = point.map(f64::from);
                let [s, t] = project(&found, [x, y]);
                if (s - u).hypot(t - v) <= f64::from(SETTINGS.tolerance_px) {
                    inliers.push([x, y]);
                }
            }
            let mean = golden::mean_deviation(&found, &truth, &inliers);
            println!("{} {scales}: {mean:.2} px from the truth", pair.describe());
            assert!(mean < 14.0, "more than a patch from the truth: {mean}");
            compared += 1;
        }
    }
    assert!(compared >= 18, "only {compared} homographies were compared");
}

//! Inliers compared with those of OpenCV's RANSAC, on matches of real photographs.

use super::estimate;
use crate::golden;

/// What `benches/peers/verify_opencv.py` writes.
#[derive(serde::Deserialize)]
struct Matches {
    unit_px: f32,
    tolerance_px: f32,
    problems: Vec<Problem>,
}

#[derive(serde::Deserialize)]
struct Problem {
    same_place: bool,
    opencv_inliers: u32,
    /// x, y in the query, u, v in the reference, for each match.
    points: Vec<u16>,
}

/// Inliers of all problems of one kind: ours, and OpenCV's.
fn inliers(matches: &Matches, same_place: bool) -> (u32, u32) {
    let mut ours = 0;
    let mut theirs = 0;
    let mut problems = 0;
    let of_kind = |problem: &&Problem| problem.same_place == same_place;
    for problem in matches.problems.iter().filter(of_kind) {
        let (points, rest) = problem.points.as_chunks::<4>();
        assert!(rest.is_empty());
        let points: Vec<_> = points
            .iter()
            .map(|p| p.map(|value| f32::from(value) * matches.unit_px))
            .collect();
        ours += estimate(&points).map_or(0, |found| found.inliers);
        theirs += problem.opencv_inliers;
        problems += 1;
    }
    println!("same place {same_place}: {problems} problems, {ours} inliers, OpenCV {theirs}");
    assert!(problems > 50);
    (ours, theirs)
}

/// OpenCV takes any homography, also those that no camera can cause; and it is these that explain
/// matches of different places.
#[test]
fn photographs_of_one_place_have_at_least_the_inliers_of_opencv_and_others_fewer() {
    let matches: Matches = serde_json::from_slice(&golden::read("cmu_matches.json")).unwrap();
    assert_eq!(matches.tolerance_px, super::SETTINGS.tolerance_px);
    let (ours, theirs) = inliers(&matches, true);
    assert!(ours >= theirs, "{ours} inliers, OpenCV {theirs}");
    let (ours, theirs) = inliers(&matches, false);
    assert!(10 * ours < 9 * theirs, "{ours} inliers, OpenCV {theirs}");
}

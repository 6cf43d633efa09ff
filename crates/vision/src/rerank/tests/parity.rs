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

#[test]
fn matches_of_photographs_have_on_average_at_least_the_inliers_of_opencv() {
    let matches: Matches = serde_json::from_slice(&golden::read("cmu_matches.json")).unwrap();
    assert_eq!(matches.tolerance_px, super::SETTINGS.tolerance_px);
    for same_place in [true, false] {
        let mut ours = 0;
        let mut theirs = 0;
        let mut problems = 0;
        for problem in matches
            .problems
            .iter()
            .filter(|problem| problem.same_place == same_place)
        {
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
        assert!(
            problems > 50 && ours >= theirs,
            "same place {same_place}: {ours} inliers, OpenCV {theirs}"
        );
    }
}

//! How often the best match's pose is near enough (RobotCar Seasons).

use crate::datasets::Pose;
use serde::Serialize;

/// Metres and degrees: high, medium and coarse precision (paper IV).
pub const POSE_THRESHOLDS: [(f64, f64); 3] = [(0.25, 2.0), (0.5, 5.0), (5.0, 10.0)];

/// Share of queries within one pair of thresholds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseAccuracy {
    /// Largest distance.
    pub metres: f64,
    /// Largest angle.
    pub degrees: f64,
    /// Queries within both, in percent.
    pub percent: f64,
}

/// Pairs each query's pose with that of its best match (absent if nothing was found); both limits
/// are inclusive.
pub fn pose_accuracy(pairs: &[(Pose, Option<Pose>)]) -> [PoseAccuracy; 3] {
    POSE_THRESHOLDS.map(|(metres, degrees)| {
        let within = |(query, best): &&(Pose, Option<Pose>)| {
            best.is_some_and(|best| {
                let (distance, angle) = query.error(&best);
                distance <= metres && angle <= degrees
            })
        };
        let near = pairs.iter().filter(within).count();
        let percent = if pairs.is_empty() {
            0.0
        } else {
            100.0 * near as f64 / pairs.len() as f64
        };
        PoseAccuracy {
            metres,
            degrees,
            percent,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{UnitQuaternion, Vector3};

    fn pose(x: f64, degrees: f64) -> Pose {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), degrees.to_radians());
        Pose {
            rotation,
            centre: Vector3::new(x, 0.0, 0.0),
        }
    }

    #[test]
    fn both_limits_count() {
        let query = pose(0.0, 0.0);
        let pairs = [
            (query, Some(pose(0.2, 1.0))),
            (query, Some(pose(0.2, 4.0))),
            (query, Some(pose(4.0, 1.0))),
            (query, Some(pose(0.1, 90.0))),
            (query, None),
        ];
        assert_eq!(
            pose_accuracy(&pairs).map(|accuracy| accuracy.percent),
            [20.0, 40.0, 60.0]
        );
        assert_eq!(pose_accuracy(&[])[0].percent, 0.0);
    }
}

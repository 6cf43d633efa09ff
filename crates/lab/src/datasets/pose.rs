//! Poses of cameras, for the data sets that judge a match by them.

use nalgebra::{UnitQuaternion, Vector3};

/// Where a camera stood and how it was turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Rotation from world to camera.
    pub rotation: UnitQuaternion<f64>,
    /// Centre of the camera in world coordinates, metres.
    pub centre: Vector3<f64>,
}

impl Pose {
    /// Distance of the centres in metres and angle between the orientations in degrees.
    pub fn error(&self, other: &Self) -> (f64, f64) {
        (
            (self.centre - other.centre).norm(),
            self.rotation.angle_to(&other.rotation).to_degrees(),
        )
    }

    /// Translation of the world-to-camera transform, as the benchmark wants it.
    pub fn translation(&self) -> Vector3<f64> {
        -(self.rotation * self.centre)
    }
}

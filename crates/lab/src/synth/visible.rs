//! The rectangles that a camera sees, painted as finely as their distance asks for.

use super::paint::Painting;
use super::raster::{Camera, Quad, Surface, Vec3};
use super::texture::Texture;
use std::sync::Arc;

/// Collects what the camera sees; what it does not see is never painted.
pub(super) struct VisibleQuads<'a> {
    pub(super) camera: &'a Camera,
    pub(super) quads: Vec<Quad>,
}

impl VisibleQuads<'_> {
    /// Adds the rectangle at `[origin, across, down]`, painted as finely as its distance asks for.
    pub(super) fn add(
        &mut self,
        shape: [Vec3; 3],
        surface: Surface,
        cutout: bool,
        paint: impl FnOnce(f32) -> Painting,
    ) {
        if let Some(scale) = self.scale_for(shape) {
            let texture = Arc::new(Texture::new(&paint(scale)));
            self.add_painted(shape, surface, cutout, texture);
        }
    }

    /// Adds a rectangle whose texture is there already.
    pub(super) fn add_painted(
        &mut self,
        [origin, across, down]: [Vec3; 3],
        surface: Surface,
        cutout: bool,
        texture: Arc<Texture>,
    ) {
        self.quads.push(Quad {
            origin,
            across,
            down,
            texture,
            surface,
            cutout,
        });
    }

    /// Adds an upright rectangle from the first to the second foot (left to right as seen).
    pub(super) fn upright(
        &mut self,
        feet: [Vec3; 2],
        height: f32,
        surface: Surface,
        cutout: bool,
        paint: impl FnOnce(f32) -> Painting,
    ) {
        self.add(upright(feet, height), surface, cutout, paint);
    }

    /// Texels per metre that the rectangle deserves, or none if it is out of sight.
    pub(super) fn scale_for(&self, [origin, across, down]: [Vec3; 3]) -> Option<f32> {
        if !self.camera.sees(origin, across, down) {
            return None;
        }
        // The point of the rectangle nearest to the camera.
        let offset = self.camera.position - origin;
        let share = |side: &Vec3| (offset.dot(side) / side.norm_squared()).clamp(0.0, 1.0);
        let nearest = origin + across * share(&across) + down * share(&down);
        let distance = (nearest - self.camera.position).norm().max(1.0);
        let needed = self.camera.pixels_per_metre(distance);
        // Steps of a factor 2, so that small moves of the camera keep the same painting.
        let scales = [48.0, 24.0, 12.0];
        let fitting = scales.into_iter().rfind(|scale| *scale >= needed * 0.6);
        Some(fitting.unwrap_or(48.0))
    }
}

/// The origin and the two sides of an upright rectangle.
pub(super) fn upright([left, right]: [Vec3; 2], height: f32) -> [Vec3; 3] {
    [
        left + Vec3::new(0.0, height, 0.0),
        right - left,
        Vec3::new(0.0, -height, 0.0),
    ]
}

/// A painting of one colour.
pub(super) fn plain(width: f32, height: f32, scale: f32, colour: [u8; 3]) -> Painting {
    let mut painting = Painting::new(width, height, scale);
    painting.rect(0.0, 0.0, width, height, colour);
    painting
}

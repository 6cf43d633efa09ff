//! Textured rectangles in space to pixels, through a pinhole camera with a depth buffer.
//!
//! Every rectangle meets the image through one homography, so that two views of a facade are
//! related by a homography too, as in the world. The inverse of that homography maps a pixel to the
//! rectangle, which makes perspective exact, needs no clipping and gives the depth as a by-product.

use super::texture::Texture;
use nalgebra::{Matrix3, Vector3};
use std::sync::Arc;

/// A point or direction: x along the street, y up, z to the right of x. Metres.
pub(super) type Vec3 = Vector3<f32>;

/// Nothing nearer to the camera than this is drawn.
const NEAR_M: f32 = 0.15;

/// How light treats a rectangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Surface {
    /// A wall.
    Wall,
    /// The ground.
    Ground,
    /// Something standing in the street, lit alike from all sides.
    Prop,
}

/// A textured rectangle.
#[derive(Debug, Clone)]
pub(super) struct Quad {
    /// The corner where the texture's first row begins.
    pub origin: Vec3,
    /// Along the texture's rows, as long as the rectangle is wide.
    pub across: Vec3,
    /// Down the texture's columns, perpendicular to `across`.
    pub down: Vec3,
    pub texture: Arc<Texture>,
    pub surface: Surface,
    /// Whether the texture's alpha matters; such quads are drawn last, far to near.
    pub cutout: bool,
}

impl Quad {
    fn centre(&self) -> Vec3 {
        self.origin + (self.across + self.down) * 0.5
    }
}

/// A pinhole camera.
#[derive(Debug, Clone)]
pub(super) struct Camera {
    pub position: Vec3,
    forward: Vec3,
    right: Vec3,
    up: Vec3,
    pub width: usize,
    pub height: usize,
    focal: f32,
}

impl Camera {
    /// Looks along `yaw` (radians from x towards z), tilted up by `pitch`, turned about its axis by
    /// `roll`.
    pub(super) fn new(
        position: Vec3,
        yaw: f32,
        pitch: f32,
        roll: f32,
        width: usize,
        height: usize,
    ) -> Self {
        let forward = Vec3::new(
            yaw.cos() * pitch.cos(),
            pitch.sin(),
            yaw.sin() * pitch.cos(),
        );
        let level = Vec3::new(-yaw.sin(), 0.0, yaw.cos());
        let above = level.cross(&forward);
        let right = level * roll.cos() + above * roll.sin();
        let up = above * roll.cos() - level * roll.sin();
        // A horizontal field of view of 66 degrees, as on a phone or a dashboard camera.
        Self {
            position,
            forward,
            right,
            up,
            width,
            height,
            focal: width as f32 * 0.77,
        }
    }

    /// The direction of a pixel, one metre deep.
    pub(super) fn ray(&self, x: f32, y: f32) -> Vec3 {
        let (right, down) = self.offsets(x, y);
        self.forward + self.right * right - self.up * down
    }

    fn offsets(&self, x: f32, y: f32) -> (f32, f32) {
        (
            (x - self.width as f32 / 2.0) / self.focal,
            (y - self.height as f32 / 2.0) / self.focal,
        )
    }

    /// Right, down, depth.
    fn view(&self, point: Vec3) -> Vec3 {
        let offset = point - self.position;
        Vec3::new(
            offset.dot(&self.right),
            -offset.dot(&self.up),
            offset.dot(&self.forward),
        )
    }

    fn on_image(&self, view: Vec3) -> [f32; 2] {
        let scale = self.focal / view.z;
        [
            view.x * scale + self.width as f32 / 2.0,
            view.y * scale + self.height as f32 / 2.0,
        ]
    }

    /// Whether the rectangle may cover any pixel.
    pub(super) fn sees(&self, origin: Vec3, across: Vec3, down: Vec3) -> bool {
        self.bounds(origin, across, down).is_some()
    }

    /// How many pixels a metre spans at `distance`.
    pub(super) fn pixels_per_metre(&self, distance: f32) -> f32 {
        self.focal / distance
    }

    /// The pixels that a rectangle may cover: columns and rows, ends excluded.
    fn bounds(&self, origin: Vec3, across: Vec3, down: Vec3) -> Option<[usize; 4]> {
        let corners = [Vec3::zeros(), across, across + down, down];
        let corners = corners.map(|offset| self.view(origin + offset));
        let mut bounds = [f32::MAX, f32::MIN, f32::MAX, f32::MIN];
        let mut include = |view: Vec3| {
            let [x, y] = self.on_image(view);
            bounds = [
                bounds[0].min(x),
                bounds[1].max(x),
                bounds[2].min(y),
                bounds[3].max(y),
            ];
        };
        for (i, &corner) in corners.iter().enumerate() {
            let next = corners[(i + 1) % 4];
            if corner.z > NEAR_M {
                include(corner);
            }
            if (corner.z > NEAR_M) != (next.z > NEAR_M) {
                let along = (NEAR_M - corner.z) / (next.z - corner.z);
                let mut edge = corner + (next - corner) * along;
                edge.z = NEAR_M;
                include(edge);
            }
        }
        let clamp = |value: f32, limit: usize| value.clamp(0.0, limit as f32) as usize;
        let found = [
            clamp(bounds[0].floor(), self.width),
            clamp(bounds[1].ceil() + 1.0, self.width),
            clamp(bounds[2].floor(), self.height),
            clamp(bounds[3].ceil() + 1.0, self.height),
        ];
        (found[0] < found[1] && found[2] < found[3]).then_some(found)
    }
}

/// What a rectangle shows at one sample.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fragment {
    /// Linear albedo.
    pub albedo: [f32; 3],
    /// Share of light that the surface itself gives off at night.
    pub glow: f32,
    pub position: Vec3,
    /// Towards the camera.
    pub normal: Vec3,
    pub distance: f32,
    pub surface: Surface,
}

/// An image in the making: linear light and inverse depth per pixel.
pub(super) struct Frame {
    pub width: usize,
    pub light: Vec<[f32; 3]>,
    inverse_depth: Vec<f32>,
}

impl Frame {
    pub(super) fn new(camera: &Camera) -> Self {
        let area = camera.width * camera.height;
        Self {
            width: camera.width,
            light: vec![[0.0; 3]; area],
            inverse_depth: vec![0.0; area],
        }
    }

    /// Depth in metres, infinite where nothing was drawn.
    pub(super) fn depth(&self, at: usize) -> f32 {
        1.0 / self.inverse_depth[at]
    }

    /// Draws all of `quads`: opaque ones near to far, so that little is shaded in vain, then
    /// cutouts far to near.
    pub(super) fn draw(
        &mut self,
        camera: &Camera,
        quads: &[Quad],
        shade: &impl Fn(&Fragment) -> [f32; 3],
    ) {
        let distance = |quad: &Quad| (quad.centre() - camera.position).norm_squared();
        let (mut cutouts, mut opaque): (Vec<&Quad>, Vec<&Quad>) =
            quads.iter().partition(|quad| quad.cutout);
        opaque.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
        cutouts.sort_by(|a, b| distance(b).total_cmp(&distance(a)));
        opaque
            .into_iter()
            .chain(cutouts)
            .for_each(|quad| self.draw_quad(camera, quad, shade));
    }

    fn draw_quad(&mut self, camera: &Camera, quad: &Quad, shade: &impl Fn(&Fragment) -> [f32; 3]) {
        let Some([left, right, top, bottom]) = camera.bounds(quad.origin, quad.across, quad.down)
        else {
            return;
        };
        let Some(map) = PixelToQuad::new(camera, quad) else {
            return;
        };
        let mut normal = quad.across.cross(&quad.down).normalize();
        if normal.dot(&(camera.position - quad.origin)) < 0.0 {
            normal = -normal;
        }
        for y in top..bottom {
            for x in left..right {
                let Some((u, v, inverse_depth)) = map.at(x as f32 + 0.5, y as f32 + 0.5) else {
                    continue;
                };
                let at = y * self.width + x;
                if inverse_depth <= self.inverse_depth[at] {
                    continue;
                }
                let texel = quad.texture.sample(
                    u,
                    v,
                    map.footprint(u, v, inverse_depth, quad.texture.size()),
                );
                if texel.alpha < 0.02 {
                    continue;
                }
                let position = quad.origin + quad.across * u + quad.down * v;
                let distance = (position - camera.position).norm();
                let light = shade(&Fragment {
                    albedo: texel.colour,
                    glow: texel.glow,
                    position,
                    normal,
                    distance,
                    surface: quad.surface,
                });
                if quad.cutout {
                    let out = &mut self.light[at];
                    *out = std::array::from_fn(|c| out[c] + (light[c] - out[c]) * texel.alpha);
                } else {
                    self.light[at] = light;
                }
                if texel.alpha > 0.5 {
                    self.inverse_depth[at] = inverse_depth;
                }
            }
        }
    }
}

/// The homography from pixels to a rectangle's (u, v) in 0..1, with depth.
struct PixelToQuad {
    at_origin: Vec3,
    per_x: Vec3,
    per_y: Vec3,
}

impl PixelToQuad {
    /// None where the camera lies in the rectangle's plane.
    fn new(camera: &Camera, quad: &Quad) -> Option<Self> {
        let inverse =
            Matrix3::from_columns(&[quad.across, quad.down, quad.origin - camera.position])
                .try_inverse()?;
        let step = 1.0 / camera.focal;
        Some(Self {
            at_origin: inverse * camera.ray(0.0, 0.0),
            per_x: inverse * (camera.right * step),
            per_y: inverse * (camera.up * -step),
        })
    }

    /// (u, v, 1 / depth), if the pixel shows the rectangle.
    fn at(&self, x: f32, y: f32) -> Option<(f32, f32, f32)> {
        let mapped = self.at_origin + self.per_x * x + self.per_y * y;
        if mapped.z <= 0.0 || mapped.z > 1.0 / NEAR_M {
            return None;
        }
        let u = mapped.x / mapped.z;
        let v = mapped.y / mapped.z;
        ((0.0..=1.0).contains(&u) && (0.0..=1.0).contains(&v)).then_some((u, v, mapped.z))
    }

    /// Texels that a pixel spans: between the longer and the shorter axis of its footprint, so that
    /// grazing views are neither smeared nor sparkling.
    fn footprint(&self, u: f32, v: f32, inverse_depth: f32, size: [f32; 2]) -> f32 {
        let step = |per: Vec3| {
            let du = (per.x - u * per.z) / inverse_depth * size[0];
            let dv = (per.y - v * per.z) / inverse_depth * size[1];
            du.hypot(dv)
        };
        let a = step(self.per_x);
        let b = step(self.per_y);
        let long = a.max(b);
        let short = a.min(b);
        // long^(3/4) * short^(1/4)
        (long * (long * short).sqrt()).sqrt().max(1e-3)
    }
}

#[cfg(test)]
mod tests;

//! Weather and time of day: the sky, what light falls where, and what the lens makes of it.

use super::random::{Dice, fractal, lattice};
use super::raster::{Camera, Fragment, Frame, Surface, Vec3};
use super::scene::Street;
use placeformer_core::types::{ImageSize, InvalidValue};
use placeformer_vision::image::RgbImage;
use std::fmt;
use std::str::FromStr;

/// The light under which a scene is captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Condition {
    /// A clear day with hard shadows.
    Day,
    /// After sunset: lit windows, street lamps, noise.
    Dusk,
    /// A grey sky, no shadows.
    Overcast,
}

impl Condition {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Day, Self::Dusk, Self::Overcast];

    /// Its name on the command line.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Day => "day",
            Self::Dusk => "dusk",
            Self::Overcast => "overcast",
        }
    }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Condition {
    type Err = InvalidValue;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let known = Self::ALL
            .into_iter()
            .find(|condition| condition.as_str() == text);
        known.ok_or_else(|| {
            InvalidValue::new(
                "condition",
                format!("{text:?} is not day, dusk or overcast"),
            )
        })
    }
}

/// Everything that decides the light at a point.
pub(super) struct Light {
    condition: Condition,
    /// Towards the sun.
    sun: Vec3,
    sun_colour: Vec3,
    /// From above and from below.
    sky_colour: Vec3,
    bounce_colour: Vec3,
    haze: Vec3,
    /// Seed of the clouds.
    clouds: u64,
    half_width: f32,
    /// Skyline of the side the sun is on: start, end, height.
    skyline: Vec<(f32, f32, f32)>,
}

impl Light {
    /// The light in `street` around `eye`; `moment` moves the sun and the clouds.
    pub(super) fn new(condition: Condition, street: &Street, eye: Vec3, moment: u64) -> Self {
        let mut dice = Dice::new(&[moment, 0x11]);
        let azimuth = dice.real(0.0..std::f32::consts::TAU);
        let elevation = dice.real(0.6..1.05);
        let sun = Vec3::new(
            azimuth.cos() * elevation.cos(),
            elevation.sin(),
            azimuth.sin() * elevation.cos(),
        );
        let (sun_colour, sky_colour, bounce_colour, haze) = match condition {
            Condition::Day => (
                [2.3, 2.1, 1.75],
                [0.62, 0.74, 0.95],
                [0.34, 0.31, 0.27],
                [0.66, 0.76, 0.9],
            ),
            Condition::Overcast => (
                [0.0; 3],
                [1.02, 1.06, 1.1],
                [0.5, 0.5, 0.5],
                [0.74, 0.77, 0.8],
            ),
            Condition::Dusk => (
                [0.0; 3],
                [0.13, 0.16, 0.27],
                [0.06, 0.06, 0.09],
                [0.2, 0.2, 0.3],
            ),
        };
        Self {
            condition,
            sun,
            sun_colour: sun_colour.into(),
            sky_colour: sky_colour.into(),
            bounce_colour: bounce_colour.into(),
            haze: haze.into(),
            clouds: moment ^ 0xc10d,
            half_width: street.style.half_width,
            skyline: street.skyline(eye.x, sun.z.signum()),
        }
    }

    /// Light reaching the camera from a surface.
    pub(super) fn shade(&self, fragment: &Fragment) -> [f32; 3] {
        let Fragment {
            albedo,
            position,
            normal,
            ..
        } = *fragment;
        let albedo = Vec3::from(albedo);
        let facing = match fragment.surface {
            Surface::Wall | Surface::Ground => normal.dot(&self.sun).max(0.0),
            Surface::Prop => 0.55,
        };
        let sunlight = self.sun_colour * (facing * self.sunlit(position));
        let upward = normal.y * 0.5 + 0.5;
        let ambient = (self.bounce_colour * (1.0 - upward) + self.sky_colour * upward)
            * self.openness(position);
        let glow = fragment.glow
            * if self.condition == Condition::Dusk {
                1.0
            } else {
                0.03
            };
        let warm = Vec3::new(1.25, 0.86, 0.46);
        let own = (warm * 0.32 + albedo.component_mul(&warm) * 1.5) * glow;
        let lit = albedo.component_mul(&(sunlight + ambient + self.lamplight(position))) + own;
        let haze = 1.0 - (-fragment.distance / 260.0).exp();
        (lit + (self.haze - lit) * haze).into()
    }

    /// 1 in the sun, 0 in the shadow of the houses on the sun's side.
    fn sunlit(&self, point: Vec3) -> f32 {
        if self.sun_colour.x == 0.0 || self.sun.z.abs() < 1e-3 {
            return 1.0;
        }
        let wall = self.sun.z.signum() * self.half_width;
        let reach = (wall - point.z) / self.sun.z;
        if reach <= 0.0 {
            return 1.0;
        }
        let hit = point + self.sun * reach;
        let over = |lot: &&(f32, f32, f32)| hit.x >= lot.0 && hit.x < lot.1;
        let roof = self
            .skyline
            .iter()
            .find(over)
            .map_or(0.0, |lot| lot.2 + 0.6);
        // The sun is no point: shadows soften with the distance of what throws them.
        ((hit.y - roof) / (0.06 + 0.02 * reach) + 0.5).clamp(0.0, 1.0)
    }

    /// How much of the sky a point sees: less near the ground and in corners.
    fn openness(&self, point: Vec3) -> f32 {
        let above_ground = (point.y / 3.0).clamp(0.0, 1.0);
        let from_wall = ((self.half_width - point.z.abs()) / 2.5).clamp(0.0, 1.0);
        0.62 + 0.38 * above_ground.max(from_wall)
    }

    /// Pools of warm light along the kerbs at dusk.
    fn lamplight(&self, point: Vec3) -> Vec3 {
        if self.condition != Condition::Dusk {
            return Vec3::zeros();
        }
        let along = (point.x / 26.0 - (point.x / 26.0).round()) * 26.0;
        let across = point.z.abs() - self.half_width * 0.6;
        let up = (point.y - 4.6).abs();
        let distance2 = along * along + across * across + up * up;
        Vec3::new(1.9, 1.3, 0.68) * (5.0 / (6.0 + distance2))
    }

    /// Light from the sky in a direction.
    pub(super) fn sky(&self, direction: Vec3) -> [f32; 3] {
        let direction = direction.normalize();
        let up = direction.y.max(0.0);
        let (zenith, horizon) = match self.condition {
            Condition::Day => ([0.18, 0.36, 0.78], [0.72, 0.82, 0.95]),
            Condition::Overcast => ([0.66, 0.69, 0.73], [0.8, 0.82, 0.84]),
            Condition::Dusk => ([0.05, 0.08, 0.2], [0.5, 0.3, 0.26]),
        };
        let zenith = Vec3::from(zenith);
        let horizon = Vec3::from(horizon);
        let base = horizon + (zenith - horizon) * up.powf(0.55);
        let plane = 1.0 / (up + 0.12);
        let drift = fractal(
            self.clouds,
            direction.x * plane * 1.1,
            direction.z * plane * 1.1,
            4,
        );
        let (cover, white) = match self.condition {
            Condition::Day => (
                ((drift - 0.5) * 4.0).clamp(0.0, 0.9),
                Vec3::new(0.98, 0.98, 1.0),
            ),
            Condition::Overcast => (0.8, Vec3::repeat(0.6 + 0.55 * drift)),
            Condition::Dusk => (
                ((drift - 0.45) * 2.5).clamp(0.0, 0.6),
                Vec3::new(0.34, 0.22, 0.24),
            ),
        };
        (base + (white - base) * cover).into()
    }

    /// The end of the street: a hazy line of distant houses, as light and whether it covers the
    /// sky.
    pub(super) fn distance(&self, direction: Vec3, seed: u64) -> Option<[f32; 3]> {
        let direction = direction.normalize();
        let bearing = direction.z.atan2(direction.x);
        let step = (bearing * 40.0).floor() as i32;
        let top =
            0.03 + 0.045 * lattice(seed, step, 0) + 0.02 * fractal(seed, bearing * 90.0, 0.0, 3);
        let wall = Vec3::repeat(0.25 + 0.2 * lattice(seed, step, 1));
        let ground = Vec3::new(0.2, 0.21, 0.18);
        let tint = if direction.y < 0.0 { ground } else { wall };
        let lit = tint.component_mul(&(self.sky_colour + self.sun_colour * 0.3));
        (direction.y < top).then(|| (lit + (self.haze - lit) * 0.5).into())
    }
}

/// What the lens and the sensor make of a frame at twice the size: blur, vignette, exposure, noise,
/// 8 bits.
pub(super) fn develop(
    frame: &Frame,
    camera: &Camera,
    condition: Condition,
    moment: u64,
) -> RgbImage {
    let mut dice = Dice::new(&[moment, 0x1e5]);
    let width = camera.width / 2;
    let height = camera.height / 2;
    let exposure = dice.real(0.85..1.15)
        * match condition {
            Condition::Day => 0.95,
            Condition::Overcast => 1.5,
            Condition::Dusk => 1.9,
        };
    let balance = Vec3::new(dice.real(0.96..1.04), 1.0, dice.real(0.96..1.04));
    let grain = if condition == Condition::Dusk {
        0.03
    } else {
        0.011
    };
    let half = frame_halved(frame, width, height);
    let mut pixels = Vec::with_capacity(width * height * 3);
    for y in 0..height {
        for x in 0..width {
            let dx = x as f32 / width as f32 - 0.5;
            let dy = y as f32 / height as f32 - 0.5;
            let vignette = 1.0 - 0.42 * (dx * dx + dy * dy);
            let light = Vec3::from(softened(&half, width, height, x, y));
            let exposed = light.component_mul(&balance) * (exposure * vignette);
            // Two lattice values make a rounder distribution than one.
            let random = |salt: u64| lattice(moment ^ salt, x as i32, y as i32) - 0.5;
            let luma = (random(1) + random(2)) * grain;
            for channel in 0..3 {
                let value = exposed[channel];
                // Filmic shoulder: highlights roll off instead of clipping.
                let mapped = (value * (1.0 + value * 0.16)) / (1.0 + value * 0.86);
                let encoded = mapped.clamp(0.0, 1.0).powf(1.0 / 2.2)
                    + luma
                    + random(3 + channel as u64) * grain * 0.5;
                pixels.push((encoded * 255.0).round().clamp(0.0, 255.0) as u8);
            }
        }
    }
    RgbImage {
        size: ImageSize {
            width: width as u32,
            height: height as u32,
        },
        pixels,
    }
}

fn frame_halved(frame: &Frame, width: usize, height: usize) -> Vec<[f32; 3]> {
    let mut half = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let at = 2 * y * frame.width + 2 * x;
            let four =
                [at, at + 1, at + frame.width, at + frame.width + 1].map(|at| frame.light[at]);
            // Bright lamps must not swamp their neighbours before exposure.
            half.push(std::array::from_fn(|c| {
                four.iter().map(|light| light[c].min(4.0)).sum::<f32>() / 4.0
            }));
        }
    }
    half
}

/// A lens is never perfectly sharp: each pixel takes a little of its four neighbours.
fn softened(light: &[[f32; 3]], width: usize, height: usize, x: usize, y: usize) -> [f32; 3] {
    const LEAK: f32 = 0.07;
    let at = |x: usize, y: usize| light[y * width + x];
    let near = [
        at(x.saturating_sub(1), y),
        at((x + 1).min(width - 1), y),
        at(x, y.saturating_sub(1)),
        at(x, (y + 1).min(height - 1)),
    ];
    let here = at(x, y);
    std::array::from_fn(|c| {
        here[c] * (1.0 - 4.0 * LEAK) + near.iter().map(|light| light[c]).sum::<f32>() * LEAK
    })
}

//! The endless town: where its places lie, and how one of them is pictured.

use super::light::{Condition, Light, develop};
use super::random::{Dice, seed_of};
use super::raster::{Camera, Frame, Vec3};
use super::scene::{Street, Traffic};
use placeformer_core::types::{GeoPoint, Heading, ImageSize};
use placeformer_vision::image::RgbImage;

/// Places along one street before the next begins.
pub(super) const PLACES_PER_STREET: u64 = 8;
/// Distance between neighbouring places of a street in metres: farther than any match may lie.
const PLACE_SPACING_M: f64 = 45.0;
/// Distance between streets in metres.
const STREET_SPACING_M: f64 = 160.0;
/// South-west corner of the world: latitude and longitude in degrees.
const ORIGIN: [f64; 2] = [51.0, 7.0];
/// Metres in a degree of latitude.
const METRES_PER_DEGREE: f64 = 111_195.08;

/// Where a camera stands at a place and where it looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Viewpoint {
    /// Metres along the street from the place, positive eastwards.
    pub along_m: f64,
    /// Metres across the street from its middle line, positive southwards; clamped to the
    /// carriageway.
    pub across_m: f64,
    /// Degrees clockwise from the street's direction (east).
    pub turn_deg: f64,
}

/// How a scene is captured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capture {
    /// The light.
    pub condition: Condition,
    /// 0 an empty street, 1 usual traffic, 2 a crowd and vans close to the camera.
    pub traffic: f32,
    /// Decides traffic, clouds, exposure and noise: two captures of one viewpoint differ by this
    /// alone.
    pub moment: u64,
}

impl Capture {
    /// Usual traffic under `condition`.
    pub fn new(condition: Condition, moment: u64) -> Self {
        Self {
            condition,
            traffic: 1.0,
            moment,
        }
    }
}

/// An endless town.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StreetWorld {
    pub(super) seed: u64,
}

impl StreetWorld {
    /// The town of `seed`.
    pub fn new(seed: u64) -> Self {
        Self { seed }
    }

    /// The picture of `place` from `viewpoint` in usual traffic; the same arguments give the same
    /// bytes.
    pub fn render(
        &self,
        place: u64,
        viewpoint: Viewpoint,
        condition: Condition,
        size: ImageSize,
    ) -> RgbImage {
        let bits = [viewpoint.along_m, viewpoint.across_m, viewpoint.turn_deg].map(f64::to_bits);
        let moment = seed_of(&[self.seed, place, bits[0], bits[1], bits[2]]);
        self.render_capture(place, viewpoint, Capture::new(condition, moment), size)
    }

    /// The picture of `place` from `viewpoint` as captured at a moment.
    pub fn render_capture(
        &self,
        place: u64,
        viewpoint: Viewpoint,
        capture: Capture,
        size: ImageSize,
    ) -> RgbImage {
        let street = self.street(place);
        let camera = self.camera(&street, place, viewpoint, capture, size);
        let light = Light::new(capture.condition, &street, camera.position, capture.moment);
        let mut frame = Frame::new(&camera);
        let traffic = Traffic {
            seed: capture.moment,
            density: capture.traffic,
        };
        let quads = street.quads(&camera, traffic);
        frame.draw(&camera, &quads, &|fragment| light.shade(fragment));
        let horizon = seed_of(&[self.seed, place / PLACES_PER_STREET, 0x5c7]);
        for at in 0..frame.light.len() {
            if frame.depth(at).is_infinite() {
                let x = at % camera.width;
                let y = at / camera.width;
                let ray = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
                frame.light[at] = light
                    .distance(ray, horizon)
                    .unwrap_or_else(|| light.sky(ray));
            }
        }
        develop(&frame, &camera, capture.condition, capture.moment)
    }

    /// Where the camera of `viewpoint` stands.
    pub fn position(&self, place: u64, viewpoint: Viewpoint) -> GeoPoint {
        let [east, north] = self.metres(place, viewpoint);
        let lat = ORIGIN[0] + north / METRES_PER_DEGREE;
        let lon = ORIGIN[1] + east / (METRES_PER_DEGREE * ORIGIN[0].to_radians().cos());
        // A town of even 10^9 places spans whole degrees, so wrap rather than fail.
        let wrap = |value: f64, limit: f64| (value + limit).rem_euclid(2.0 * limit) - limit;
        GeoPoint::new(wrap(lat, 90.0), wrap(lon, 180.0))
            .unwrap_or_else(|_| unreachable!("wrapped into range"))
    }

    /// Where it looks: streets run east, so this is the turn from there.
    pub fn heading(&self, viewpoint: Viewpoint) -> Heading {
        let degrees = (90.0 + viewpoint.turn_deg).rem_euclid(360.0);
        Heading::new(degrees).unwrap_or_else(|_| unreachable!("folded into 0..360"))
    }

    /// East and north of the origin.
    fn metres(&self, place: u64, viewpoint: Viewpoint) -> [f64; 2] {
        let along = (place % PLACES_PER_STREET) as f64 * PLACE_SPACING_M + viewpoint.along_m;
        [
            along,
            (place / PLACES_PER_STREET) as f64 * STREET_SPACING_M - viewpoint.across_m,
        ]
    }

    fn street(&self, place: u64) -> Street {
        Street::new(self.seed, place / PLACES_PER_STREET)
    }

    fn camera(
        &self,
        street: &Street,
        place: u64,
        viewpoint: Viewpoint,
        capture: Capture,
        size: ImageSize,
    ) -> Camera {
        let mut shake = Dice::new(&[capture.moment, 0x5a4e]);
        let along = (place % PLACES_PER_STREET) as f64 * PLACE_SPACING_M + viewpoint.along_m;
        let lane = street.style.half_width - street.style.pavement_width;
        let across = (viewpoint.across_m as f32).clamp(-lane, lane);
        let position = Vec3::new(along as f32, 1.65 + shake.real(-0.12..0.12), across);
        let yaw = (viewpoint.turn_deg as f32).to_radians();
        let pitch = 0.11 + shake.real(-0.03..0.03);
        let roll = shake.real(-0.02..0.02);
        // Twice the size, for antialiasing.
        Camera::new(
            position,
            yaw,
            pitch,
            roll,
            size.width as usize * 2,
            size.height as usize * 2,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: ImageSize = ImageSize {
        width: 96,
        height: 72,
    };
    const OBLIQUE: Viewpoint = Viewpoint {
        along_m: 0.0,
        across_m: -1.0,
        turn_deg: 50.0,
    };

    fn mean(image: &RgbImage) -> f32 {
        image
            .pixels
            .iter()
            .map(|&value| f32::from(value))
            .sum::<f32>()
            / image.pixels.len() as f32
    }

    /// Mean absolute difference of two images of one size.
    fn difference(a: &RgbImage, b: &RgbImage) -> f32 {
        a.pixels
            .iter()
            .zip(&b.pixels)
            .map(|(a, b)| f32::from(a.abs_diff(*b)))
            .sum::<f32>()
            / a.pixels.len() as f32
    }

    #[test]
    fn the_same_arguments_give_the_same_bytes_on_any_thread() {
        let world = StreetWorld::new(5);
        let alone = world.render(3, OBLIQUE, Condition::Day, SIZE);
        let dusk = || world.render_capture(4, OBLIQUE, Capture::new(Condition::Dusk, 2), SIZE);
        let here = dusk();
        assert_eq!(world.render(3, OBLIQUE, Condition::Day, SIZE), alone);
        // Neither what was drawn before nor the thread matters.
        assert_eq!(rayon::join(dusk, dusk), (here.clone(), here));
    }

    #[test]
    fn places_seeds_and_sides_differ_more_than_moments() {
        let day = Capture {
            traffic: 0.0,
            ..Capture::new(Condition::Overcast, 1)
        };
        let later = Capture { moment: 2, ..day };
        let world = StreetWorld::new(5);
        let here = world.render_capture(3, OBLIQUE, day, SIZE);
        let again = difference(&here, &world.render_capture(3, OBLIQUE, later, SIZE));
        assert!(again > 0.5, "another moment is another picture");
        let left = Viewpoint {
            turn_deg: -50.0,
            ..OBLIQUE
        };
        for other in [
            world.render_capture(4, OBLIQUE, day, SIZE),
            world.render_capture(3, left, day, SIZE),
            StreetWorld::new(6).render_capture(3, OBLIQUE, day, SIZE),
        ] {
            assert!(difference(&here, &other) > again + 4.0);
        }
    }

    #[test]
    fn dusk_is_darker_and_pictures_are_never_flat() {
        let world = StreetWorld::new(9);
        let [day, dusk, overcast] =
            Condition::ALL.map(|condition| world.render(1, OBLIQUE, condition, SIZE));
        assert!(mean(&dusk) + 20.0 < mean(&day).min(mean(&overcast)));
        for image in [day, dusk, overcast] {
            assert_eq!((image.size, image.pixels.len()), (SIZE, 96 * 72 * 3));
            let centre = mean(&image);
            let spread = image
                .pixels
                .iter()
                .map(|&v| (f32::from(v) - centre).powi(2))
                .sum::<f32>();
            assert!((spread / image.pixels.len() as f32).sqrt() > 15.0);
        }
    }

    #[test]
    fn positions_follow_the_metres_and_headings_the_turn() {
        let world = StreetWorld::new(1);
        let ahead = Viewpoint {
            along_m: 0.0,
            across_m: 0.0,
            turn_deg: 0.0,
        };
        let metres = |a: u64, b: u64| {
            world
                .position(a, ahead)
                .distance_m(world.position(b, ahead))
        };
        assert!((metres(0, 1) - 45.0).abs() < 0.1, "{}", metres(0, 1));
        assert!((metres(0, 8) - 160.0).abs() < 0.5, "{}", metres(0, 8));
        let south = Viewpoint {
            across_m: 2.0,
            ..ahead
        };
        assert!(world.position(0, south).lat() < world.position(0, ahead).lat());
        assert_eq!(world.heading(ahead).degrees(), 90.0);
        assert_eq!(
            world
                .heading(Viewpoint {
                    turn_deg: -100.0,
                    ..ahead
                })
                .degrees(),
            350.0
        );
        assert!(world.position(u64::MAX, ahead).lat().is_finite());
    }
}

//! Single objects of a street: chimneys, awnings and boards, trees, people, vehicles.

use super::paint::{Painting, shaded};
use super::props;
use super::random::Dice;
use super::raster::{Surface, Vec3};
use super::style::HouseStyle;
use super::texture::Texture;
use super::vehicle::{CAR, Outline, VAN, paint_end, paint_flank};
use super::visible::{VisibleQuads, plain, upright};
use std::sync::Arc;

/// Which side of the street, as the sign of z.
pub(super) type Side = f32;

/// A chimney of four brick walls.
pub(super) fn add_chimney(quads: &mut VisibleQuads, house: &HouseStyle, top: Vec3) {
    let foot = |dx: f32, dz: f32| top + Vec3::new(dx, -0.7, dz);
    let corners = [
        foot(0.0, -0.4),
        foot(0.9, -0.4),
        foot(0.9, 0.4),
        foot(0.0, 0.4),
    ];
    for (i, &corner) in corners.iter().enumerate() {
        quads.upright(
            [corner, corners[(i + 1) % 4]],
            1.5,
            Surface::Wall,
            false,
            |scale| {
                let mut brick = plain(0.9, 1.5, scale, shaded(house.roof, 1.1));
                brick.rect(0.0, 0.0, 0.9, 0.16, [90, 84, 80]);
                brick
            },
        );
    }
}

/// An awning over the show windows and a board hung out across the pavement.
pub(super) fn add_shop_extras(
    quads: &mut VisibleQuads,
    house: &HouseStyle,
    side: Side,
    [start, end, front]: [f32; 3],
    seed: u64,
) {
    let mut dice = Dice::new(&[seed, 13]);
    let lintel = house.ground_height - 0.9;
    if dice.chance(0.5) {
        let width = end - start - 0.6;
        let stripe = dice.real(0.25..0.6);
        let origin = Vec3::new(start + 0.3, lintel + 0.1, front);
        let shape = [
            origin,
            Vec3::new(width, 0.0, 0.0),
            Vec3::new(0.0, -0.55, -side * 1.3),
        ];
        quads.add(shape, Surface::Prop, false, |scale| {
            let mut cloth = plain(width, 1.4, scale, [232, 226, 212]);
            let stripes = (width / stripe).ceil() as usize;
            for i in (0..stripes).step_by(2) {
                cloth.rect(i as f32 * stripe, 0.0, stripe, 1.4, house.accent);
            }
            cloth.tint(0.0, 1.2, width, 0.03, [0, 0, 0], 0.4);
            cloth
        });
    }
    if dice.chance(0.8) {
        let foot = Vec3::new(
            dice.pick(&[start + 0.6, end - 0.6]),
            lintel + 0.2,
            front - side * 0.15,
        );
        let ends = [foot, foot - Vec3::new(0.0, 0.0, side * 0.9)];
        quads.upright(ends, 0.9, Surface::Prop, true, |scale| {
            props::paint_hanging_sign(house.accent, scale, seed)
        });
    }
}

/// Two crossed cards, so that a tree has depth from everywhere.
pub(super) fn add_tree(quads: &mut VisibleQuads, foot: Vec3, height: f32, seed: u64) {
    let width = height * 0.72;
    let cards = [
        Vec3::new(width / 2.0, 0.0, 0.0),
        Vec3::new(0.0, 0.0, width / 2.0),
    ];
    let cards = cards.map(|half| upright([foot - half, foot + half], height));
    let Some(scale) = cards.iter().find_map(|card| quads.scale_for(*card)) else {
        return;
    };
    let painting = props::paint_tree([width, height], scale.min(32.0), seed);
    let texture = Arc::new(Texture::new(&painting));
    for card in cards {
        quads.add_painted(card, Surface::Prop, true, texture.clone());
    }
}

/// A card that faces the camera.
pub(super) fn add_person(quads: &mut VisibleQuads, foot: Vec3, seed: u64) {
    let mut towards = quads.camera.position - foot;
    towards.y = 0.0;
    if towards.norm() > 1.0 {
        let half = towards.cross(&Vec3::new(0.0, 1.0, 0.0)).normalize() * 0.4;
        let feet = [foot - half, foot + half];
        quads.upright(feet, 1.8, Surface::Prop, true, |scale| {
            props::paint_person(scale, seed)
        });
    }
}

/// What distinguishes one vehicle from another.
struct Vehicle {
    outline: &'static Outline,
    colour: [u8; 3],
    length: f32,
    width: f32,
    height: f32,
}

impl Vehicle {
    fn new(van: bool, dice: &mut Dice) -> Self {
        const CARS: [[u8; 3]; 8] = [
            [196, 198, 200],
            [34, 36, 40],
            [120, 124, 130],
            [150, 30, 34],
            [34, 62, 116],
            [222, 222, 218],
            [60, 88, 70],
            [184, 150, 96],
        ];
        const VANS: [[u8; 3]; 4] = [
            [232, 232, 228],
            [176, 36, 36],
            [226, 180, 40],
            [44, 74, 130],
        ];
        if van {
            Self {
                outline: VAN,
                colour: dice.pick(&VANS),
                length: 5.2,
                width: 1.95,
                height: 2.3,
            }
        } else {
            // The length is drawn before the colour: another order would draw another town.
            let length = dice.real(3.8..4.7);
            Self {
                outline: CAR,
                colour: dice.pick(&CARS),
                length,
                width: 1.75,
                height: 1.48,
            }
        }
    }
}

/// A car or van parallel to the street: two flanks, panels across from tail to nose, and its
/// shadow.
pub(super) fn add_vehicle(
    quads: &mut VisibleQuads,
    centre: Vec3,
    side: Side,
    van: bool,
    seed: u64,
    dice: &mut Dice,
) {
    let vehicle = Vehicle::new(van, dice);
    // Traffic keeps to the right: noses point along x on the right side of the street.
    let along = Vec3::new(side * vehicle.length, 0.0, 0.0);
    let half_width = Vec3::new(0.0, 0.0, vehicle.width / 2.0);
    let tail = centre - along * 0.5;
    add_flanks(quads, &vehicle, [tail, along, half_width], seed);
    add_panels(quads, &vehicle, [tail, along, half_width], seed);
    let shadow = [
        tail - along * 0.04 + Vec3::new(0.0, 0.02, 0.0) - half_width * 1.2,
        along * 1.08,
        half_width * 2.4,
    ];
    quads.add(shadow, Surface::Prop, true, |_| {
        let mut dark = Painting::new(vehicle.length, vehicle.width, 12.0);
        let (length, width) = (vehicle.length - 0.2, vehicle.width - 0.2);
        dark.tint(0.1, 0.1, length, width, [8, 8, 10], 0.7);
        dark
    });
}

/// Both flanks, which share a painting.
fn add_flanks(
    quads: &mut VisibleQuads,
    vehicle: &Vehicle,
    [tail, along, half_width]: [Vec3; 3],
    seed: u64,
) {
    let flanks = [half_width, -half_width]
        .map(|offset| upright([tail + offset, tail + along + offset], vehicle.height));
    let Some(scale) = flanks.iter().find_map(|shape| quads.scale_for(*shape)) else {
        return;
    };
    let size = [vehicle.length, vehicle.height];
    let painting = paint_flank(vehicle.outline, size, vehicle.colour, scale, seed);
    let body = Arc::new(Texture::new(&painting));
    for shape in flanks {
        quads.add_painted(shape, Surface::Prop, true, body.clone());
    }
}

/// The panels across the vehicle, one between each two points of its outline.
fn add_panels(
    quads: &mut VisibleQuads,
    vehicle: &Vehicle,
    [tail, along, half_width]: [Vec3; 3],
    seed: u64,
) {
    let colour = vehicle.colour;
    let last = vehicle.outline.len() - 2;
    for (i, pair) in vehicle.outline.windows(2).enumerate() {
        let is_glass = pair[0].1;
        let [from, to] = [pair[0].0, pair[1].0].map(|[x, y]| {
            let up = Vec3::new(0.0, (1.0 - y) * vehicle.height, 0.0);
            tail + along * x + up
        });
        let (upper, lower) = if from.y >= to.y {
            (from, to)
        } else {
            (to, from)
        };
        let shape = [upper - half_width, half_width * 2.0, lower - upper];
        let size = [vehicle.width, (upper - lower).norm()];
        let lamps = if i == 0 {
            [176, 28, 30]
        } else {
            [238, 236, 214]
        };
        quads.add(shape, Surface::Prop, false, |scale| {
            if i == 0 || i == last {
                paint_end(size, colour, lamps, scale, seed)
            } else if is_glass {
                plain(size[0], size[1], 8.0, [50, 60, 70])
            } else {
                plain(size[0], size[1], 8.0, shaded(colour, 0.95))
            }
        });
    }
}

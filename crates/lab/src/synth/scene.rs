//! Which house, tree and van stands where, as rectangles around a camera.
//!
//! A street is an endless row of lots. What stands on a lot follows from the seed of its street and
//! its number alone, so that every camera anywhere along it sees the same houses. Traffic belongs
//! to the moment of capture instead.

use super::facade::{paint_front, paint_roof, paint_side};
use super::objects::{Side, add_chimney, add_person, add_shop_extras, add_tree, add_vehicle};
use super::paint::{Painting, shaded};
use super::props;
use super::random::{Dice, lattice, seed_of};
use super::raster::{Camera, Quad, Surface, Vec3};
use super::style::{HouseStyle, StreetStyle};
use super::visible::{VisibleQuads, plain};

/// Mean width of a lot in metres.
const LOT_M: f32 = 11.0;
/// Houses farther along the street than this are lost in the haze.
const VIEW_M: f32 = 120.0;
/// How deep a house is.
const DEPTH_M: f32 = 9.0;

/// A street with everything that does not move.
pub(super) struct Street {
    seed: u64,
    pub style: StreetStyle,
}

/// What passes or parks at the moment of capture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Traffic {
    /// Decides who is there.
    pub seed: u64,
    /// 0 empty, 1 usual, 2 crowded with something close to the camera.
    pub density: f32,
}

impl Street {
    pub(super) fn new(world: u64, street: u64) -> Self {
        let seed = seed_of(&[world, 0x57ee7, street]);
        Self {
            seed,
            style: StreetStyle::new(&mut Dice::new(&[seed])),
        }
    }

    /// Where lot `index` on `side` begins, metres along the street.
    fn boundary(&self, side: Side, index: i32) -> f32 {
        index as f32 * LOT_M + self.dice(side, index, 1).real(-2.6..2.6)
    }

    fn dice(&self, side: Side, index: i32, purpose: u64) -> Dice {
        Dice::new(&[self.lot_seed(side, index), purpose])
    }

    fn lot_seed(&self, side: Side, index: i32) -> u64 {
        seed_of(&[self.seed, u64::from(side > 0.0), index as u32 as u64])
    }

    /// The house on lot `index`; about one lot in nine is a gap.
    fn house(&self, side: Side, index: i32) -> Option<HouseStyle> {
        let mut dice = self.dice(side, index, 2);
        (!dice.chance(0.11)).then(|| self.style.house(&mut dice))
    }

    /// Height of the skyline on `side` at `along`.
    pub(super) fn skyline(&self, along: f32, side: Side) -> Vec<(f32, f32, f32)> {
        let first = ((along - VIEW_M) / LOT_M).floor() as i32;
        let last = ((along + VIEW_M) / LOT_M).ceil() as i32;
        let lots = first..last;
        lots.map(|lot| {
            let height = self.house(side, lot).map_or(0.0, |house| house.height());
            (
                self.boundary(side, lot),
                self.boundary(side, lot + 1),
                height,
            )
        })
        .collect()
    }

    /// Everything that `camera` sees, including `traffic`.
    pub(super) fn quads(&self, camera: &Camera, traffic: Traffic) -> Vec<Quad> {
        let mut quads = VisibleQuads {
            camera,
            quads: Vec::new(),
        };
        let along = camera.position.x;
        self.add_ground(&mut quads, along);
        for side in [-1.0, 1.0] {
            let first = ((along - VIEW_M) / LOT_M).floor() as i32;
            let last = ((along + VIEW_M) / LOT_M).ceil() as i32;
            for lot in first..last {
                self.add_lot(&mut quads, side, lot);
            }
            self.add_furniture(&mut quads, side, along);
            self.add_parked(&mut quads, side, traffic);
        }
        self.add_people(&mut quads, traffic);
        if traffic.density > 1.5 {
            self.add_passing_van(&mut quads, traffic);
        }
        quads.quads
    }

    fn add_ground(&self, quads: &mut VisibleQuads, along: f32) {
        const TILE: f32 = 12.0;
        let half = self.style.half_width;
        let pavement = self.style.pavement_width;
        let first = ((along - VIEW_M) / TILE).floor() as i32;
        let last = ((along + VIEW_M) / TILE).ceil() as i32;
        for tile in first..last {
            let start = tile as f32 * TILE;
            let across = Vec3::new(TILE, 0.0, 0.0);
            let strip = |from: f32, to: f32| {
                [
                    Vec3::new(start, 0.0, from),
                    across,
                    Vec3::new(0.0, 0.0, to - from),
                ]
            };
            let seeds = [
                self.seed,
                seed_of(&[self.seed, 0x6709d, tile as u32 as u64]),
            ];
            let road = props::GroundPlan {
                start,
                length: TILE,
                half_width: half,
                pavement,
                cobbles: self.style.cobbles,
            };
            quads.add(strip(-half, half), Surface::Ground, false, |scale| {
                props::paint_ground(&road, scale, seeds)
            });
            // Yards behind the gaps.
            for (from, to) in [(-half - 30.0, -half), (half, half + 30.0)] {
                quads.add(strip(from, to), Surface::Ground, false, |_| {
                    plain(TILE, to - from, 2.0, [104, 112, 78])
                });
            }
        }
    }

    /// The house of a lot, or what is in its place.
    fn add_lot(&self, quads: &mut VisibleQuads, side: Side, lot: i32) {
        let start = self.boundary(side, lot);
        let end = self.boundary(side, lot + 1);
        let seed = self.lot_seed(side, lot);
        let Some(style) = self.house(side, lot) else {
            self.add_gap(quads, side, [start, end], seed);
            return;
        };
        let mut dice = self.dice(side, lot, 3);
        let front = side * (self.style.half_width + dice.real(0.0..0.5));
        let house = House {
            style,
            side,
            start,
            end,
            front,
            seed,
        };
        house.add_walls(quads);
        let slope = if house.style.pitched {
            dice.real(2.2..3.6)
        } else {
            0.4
        };
        house.add_roof(quads, slope);
        if house.style.pitched && dice.chance(0.7) {
            let x = dice.real(0.2..0.8) * (end - start) + start;
            let top = Vec3::new(x, house.style.height() + slope, front + side * 3.6);
            add_chimney(quads, &house.style, top);
        }
        if house.style.shop {
            add_shop_extras(quads, &house.style, side, [start, end, front], seed);
        }
    }

    /// A garden wall with trees behind.
    fn add_gap(&self, quads: &mut VisibleQuads, side: Side, [start, end]: [f32; 2], seed: u64) {
        let line = side * (self.style.half_width + 0.2);
        let foot = |x: f32| Vec3::new(x, 0.0, line);
        quads.upright(
            [foot(start), foot(end)],
            1.9,
            Surface::Wall,
            false,
            |scale| {
                let mut wall = plain(end - start, 1.9, scale, [150, 128, 110]);
                wall.rect(0.0, 0.0, end - start, 0.14, [176, 170, 160]);
                wall.modulate(|x, y| 0.8 + 0.4 * lattice(seed, (x * 4.0) as i32, (y * 9.0) as i32));
                wall
            },
        );
        let mut dice = Dice::new(&[seed, 12]);
        for i in 0..2 {
            let x = start + (end - start) * dice.real(0.25..0.75);
            let foot = Vec3::new(x, 0.0, line + side * dice.real(2.5..6.0));
            add_tree(quads, foot, dice.real(6.0..9.0), seed ^ i);
        }
    }

    /// Trees, lamps and road signs along the kerb.
    fn add_furniture(&self, quads: &mut VisibleQuads, side: Side, along: f32) {
        const STEP: f32 = 13.0;
        let kerb = side * (self.style.half_width - self.style.pavement_width + 0.45);
        let first = ((along - VIEW_M * 0.7) / STEP).floor() as i32;
        let last = ((along + VIEW_M * 0.7) / STEP).ceil() as i32;
        for index in first..last {
            let seed = seed_of(&[self.seed, 0xf02, u64::from(side > 0.0), index as u32 as u64]);
            let mut dice = Dice::new(&[seed]);
            let at = |x: f32| Vec3::new(index as f32 * STEP + x, 0.0, kerb);
            if self.style.trees && dice.chance(0.42) {
                add_tree(quads, at(dice.real(0.0..5.0)), dice.real(4.6..7.2), seed);
            }
            if dice.chance(0.6) {
                let foot = at(dice.real(6.0..9.0));
                // The head hangs over the road, and is at the texture's left edge.
                let out = foot - Vec3::new(0.0, 0.0, side * 1.2);
                quads.upright([out, foot], 5.0, Surface::Prop, true, |scale| {
                    props::paint_lamp(scale, seed)
                });
            }
            if dice.chance(0.3) {
                let foot = at(dice.real(9.5..12.0));
                let ends = [foot, foot + Vec3::new(0.0, 0.0, 0.7)];
                quads.upright(ends, 2.6, Surface::Prop, true, |scale| {
                    props::paint_road_sign(scale, seed)
                });
            }
        }
    }

    fn add_parked(&self, quads: &mut VisibleQuads, side: Side, traffic: Traffic) {
        const STEP: f32 = 6.4;
        let eye = quads.camera.position;
        let lane = side * (self.style.half_width - self.style.pavement_width - 1.25);
        let first = ((eye.x - 60.0) / STEP).floor() as i32;
        let last = ((eye.x + 60.0) / STEP).ceil() as i32;
        for slot in first..last {
            let seed = seed_of(&[
                traffic.seed,
                0xca5,
                u64::from(side > 0.0),
                slot as u32 as u64,
            ]);
            let mut dice = Dice::new(&[seed]);
            let centre = Vec3::new(slot as f32 * STEP + dice.real(0.0..1.0), 0.0, lane);
            // Nobody parks on the camera.
            if dice.chance(0.3 * traffic.density.min(1.5)) && (centre - eye).norm() > 5.0 {
                let van = dice.chance(0.2);
                add_vehicle(quads, centre, side, van, seed, &mut dice);
            }
        }
    }

    fn add_people(&self, quads: &mut VisibleQuads, traffic: Traffic) {
        let mut dice = Dice::new(&[traffic.seed, 0x9e0]);
        let count = (dice.real(2.0..9.0) * traffic.density) as u64;
        for i in 0..count {
            let side = dice.pick(&[-1.0, 1.0]);
            let away = dice.real(4.0..38.0) * dice.pick(&[-1.0, 1.0]);
            let z =
                side * (self.style.half_width - self.style.pavement_width * dice.real(0.2..0.8));
            add_person(
                quads,
                Vec3::new(quads.camera.position.x + away, 0.0, z),
                seed_of(&[traffic.seed, i]),
            );
        }
    }

    /// Vans in the lane before the camera.
    fn add_passing_van(&self, quads: &mut VisibleQuads, traffic: Traffic) {
        let mut dice = Dice::new(&[traffic.seed, 0x7a4]);
        let eye = quads.camera.position;
        let side = if eye.z > 0.0 { -1.0 } else { 1.0 };
        for direction in [-1.0, 1.0] {
            let x = eye.x + direction * dice.real(5.5..10.0);
            let centre = Vec3::new(x, 0.0, side * dice.real(1.6..2.4));
            add_vehicle(
                quads,
                centre,
                side,
                true,
                traffic.seed ^ u64::from(x.to_bits()),
                &mut dice,
            );
        }
    }
}

/// A house on its lot.
struct House {
    style: HouseStyle,
    side: Side,
    /// Where the lot begins and ends, metres along the street.
    start: f32,
    end: f32,
    /// Where the front stands, metres across the street.
    front: f32,
    seed: u64,
}

impl House {
    /// The front from left to right as seen from the street: along x on the left side, against it
    /// on the right.
    fn left_to_right(&self) -> [f32; 2] {
        if self.side < 0.0 {
            [self.start, self.end]
        } else {
            [self.end, self.start]
        }
    }

    fn add_walls(&self, quads: &mut VisibleQuads) {
        let back = self.front + self.side * DEPTH_M;
        let height = self.style.height();
        let width = self.end - self.start;
        let at = |x: f32, z: f32| Vec3::new(x, 0.0, z);
        let front_feet = self.left_to_right().map(|x| at(x, self.front));
        quads.upright(front_feet, height, Surface::Wall, false, |scale| {
            paint_front(&self.style, width, scale, self.seed)
        });
        for x in [self.start, self.end] {
            let feet = [at(x, self.front), at(x, back)];
            let seed = self.seed ^ u64::from(x.to_bits());
            quads.upright(feet, height, Surface::Wall, false, |scale| {
                paint_side(&self.style, DEPTH_M, scale.min(14.0), seed)
            });
        }
    }

    /// The roof, which rises by `slope` metres, and the gables of a pitched one.
    fn add_roof(&self, quads: &mut VisibleQuads, slope: f32) {
        let height = self.style.height();
        let width = self.end - self.start;
        let [from, to] = self.left_to_right();
        let roof = [
            Vec3::new(from, height + slope, self.front + self.side * 4.0),
            Vec3::new(to - from, 0.0, 0.0),
            Vec3::new(0.0, -slope, -self.side * 4.0),
        ];
        quads.add(roof, Surface::Wall, false, |scale| {
            paint_roof(&self.style, width, 5.0, scale.min(20.0), self.seed)
        });
        if !self.style.pitched {
            return;
        }
        for x in [self.start, self.end] {
            let eaves = [0.0, 8.0].map(|away| Vec3::new(x, height, self.front + self.side * away));
            quads.upright(eaves, slope, Surface::Wall, true, |scale| {
                let mut wall = Painting::new(8.0, slope, scale.min(14.0));
                let triangle = [[0.0, slope], [4.0, 0.0], [8.0, slope]];
                wall.polygon(&triangle, shaded(self.style.wall, 0.86));
                wall
            });
        }
    }
}

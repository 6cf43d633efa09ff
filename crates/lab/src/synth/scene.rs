//! Which house, tree and van stands where, as rectangles around a camera.
//!
//! A street is an endless row of lots, each settled by the seed of its street and number alone, so
//! that every camera anywhere along it sees the same houses. Traffic belongs to the moment of
//! capture instead.

use super::facade::{paint_front, paint_roof, paint_side};
use super::paint::{Painting, shaded};
use super::props;
use super::random::{Dice, lattice, seed_of};
use super::raster::{Camera, Quad, Surface, Vec3};
use super::style::{HouseStyle, StreetStyle};
use super::texture::Texture;
use std::sync::Arc;

/// Mean width of a lot in metres.
const LOT_M: f32 = 11.0;
/// Houses farther along the street than this are lost in the haze.
const VIEW_M: f32 = 120.0;
/// How deep a house is.
const DEPTH_M: f32 = 9.0;

/// One side of the street, as the sign of z.
type Side = f32;

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
        let mut stage = Stage {
            camera,
            quads: Vec::new(),
        };
        let along = camera.position.x;
        self.add_ground(&mut stage, along);
        for side in [-1.0, 1.0] {
            let first = ((along - VIEW_M) / LOT_M).floor() as i32;
            let last = ((along + VIEW_M) / LOT_M).ceil() as i32;
            (first..last).for_each(|lot| self.add_lot(&mut stage, side, lot));
            self.add_furniture(&mut stage, side, along);
            self.add_parked(&mut stage, side, traffic);
        }
        self.add_people(&mut stage, traffic);
        if traffic.density > 1.5 {
            self.add_passing_van(&mut stage, traffic);
        }
        stage.quads
    }

    fn add_ground(&self, stage: &mut Stage, along: f32) {
        const TILE: f32 = 12.0;
        let (half, pavement) = (self.style.half_width, self.style.pavement_width);
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
            stage.add(strip(-half, half), Surface::Ground, false, |scale| {
                props::paint_ground(&road, scale, seeds)
            });
            // Yards behind the gaps.
            for (from, to) in [(-half - 30.0, -half), (half, half + 30.0)] {
                stage.add(strip(from, to), Surface::Ground, false, |_| {
                    plain(TILE, to - from, 2.0, [104, 112, 78])
                });
            }
        }
    }

    fn add_lot(&self, stage: &mut Stage, side: Side, lot: i32) {
        let (start, end) = (self.boundary(side, lot), self.boundary(side, lot + 1));
        let seed = self.lot_seed(side, lot);
        let Some(house) = self.house(side, lot) else {
            self.add_gap(stage, side, [start, end], seed);
            return;
        };
        let mut dice = self.dice(side, lot, 3);
        let front = side * (self.style.half_width + dice.real(0.0..0.5));
        let back = front + side * DEPTH_M;
        let (height, width) = (house.height(), end - start);
        let at = |x: f32, z: f32| Vec3::new(x, 0.0, z);
        // Seen from the street, a front runs from left to right: along x on the left side, against
        // it on the right.
        let (from, to) = if side < 0.0 {
            (start, end)
        } else {
            (end, start)
        };
        stage.upright(
            [at(from, front), at(to, front)],
            height,
            Surface::Wall,
            false,
            |scale| paint_front(&house, width, scale, seed),
        );
        for x in [start, end] {
            stage.upright(
                [at(x, front), at(x, back)],
                height,
                Surface::Wall,
                false,
                |scale| {
                    paint_side(
                        &house,
                        DEPTH_M,
                        scale.min(14.0),
                        seed ^ u64::from(x.to_bits()),
                    )
                },
            );
        }
        let slope = if house.pitched {
            dice.real(2.2..3.6)
        } else {
            0.4
        };
        let ridge = Vec3::new(from, height + slope, front + side * 4.0);
        let roof = [
            ridge,
            Vec3::new(to - from, 0.0, 0.0),
            Vec3::new(0.0, -slope, -side * 4.0),
        ];
        stage.add(roof, Surface::Wall, false, |scale| {
            paint_roof(&house, width, 5.0, scale.min(20.0), seed)
        });
        if house.pitched {
            let gable = |x: f32| {
                [at(x, front), at(x, front + side * 8.0)]
                    .map(|foot| foot + Vec3::new(0.0, height, 0.0))
            };
            for x in [start, end] {
                stage.upright(gable(x), slope, Surface::Wall, true, |scale| {
                    let mut wall = Painting::new(8.0, slope, scale.min(14.0));
                    wall.polygon(
                        &[[0.0, slope], [4.0, 0.0], [8.0, slope]],
                        shaded(house.wall, 0.86),
                    );
                    wall
                });
            }
        }
        if house.pitched && dice.chance(0.7) {
            add_chimney(
                stage,
                &house,
                Vec3::new(
                    dice.real(0.2..0.8) * width + start,
                    height + slope,
                    front + side * 3.6,
                ),
            );
        }
        if house.shop {
            add_shop_extras(stage, &house, side, [start, end, front], seed);
        }
    }

    /// A garden wall with trees behind.
    fn add_gap(&self, stage: &mut Stage, side: Side, [start, end]: [f32; 2], seed: u64) {
        let line = side * (self.style.half_width + 0.2);
        let foot = |x: f32| Vec3::new(x, 0.0, line);
        stage.upright(
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
            add_tree(stage, foot, dice.real(6.0..9.0), seed ^ i);
        }
    }

    /// Trees, lamps and road signs along the kerb.
    fn add_furniture(&self, stage: &mut Stage, side: Side, along: f32) {
        const STEP: f32 = 13.0;
        let kerb = side * (self.style.half_width - self.style.pavement_width + 0.45);
        let first = ((along - VIEW_M * 0.7) / STEP).floor() as i32;
        let last = ((along + VIEW_M * 0.7) / STEP).ceil() as i32;
        for index in first..last {
            let seed = seed_of(&[self.seed, 0xf02, u64::from(side > 0.0), index as u32 as u64]);
            let mut dice = Dice::new(&[seed]);
            let at = |x: f32| Vec3::new(index as f32 * STEP + x, 0.0, kerb);
            if self.style.trees && dice.chance(0.42) {
                add_tree(stage, at(dice.real(0.0..5.0)), dice.real(4.6..7.2), seed);
            }
            if dice.chance(0.6) {
                let foot = at(dice.real(6.0..9.0));
                // The head hangs over the road, and is at the texture's left edge.
                let out = foot - Vec3::new(0.0, 0.0, side * 1.2);
                stage.upright([out, foot], 5.0, Surface::Prop, true, |scale| {
                    props::paint_lamp(scale, seed)
                });
            }
            if dice.chance(0.3) {
                let foot = at(dice.real(9.5..12.0));
                let ends = [foot, foot + Vec3::new(0.0, 0.0, 0.7)];
                stage.upright(ends, 2.6, Surface::Prop, true, |scale| {
                    props::paint_road_sign(scale, seed)
                });
            }
        }
    }

    fn add_parked(&self, stage: &mut Stage, side: Side, traffic: Traffic) {
        const STEP: f32 = 6.4;
        let eye = stage.camera.position;
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
                add_vehicle(stage, centre, side, van, seed, &mut dice);
            }
        }
    }

    fn add_people(&self, stage: &mut Stage, traffic: Traffic) {
        let mut dice = Dice::new(&[traffic.seed, 0x9e0]);
        let count = (dice.real(2.0..9.0) * traffic.density) as u64;
        for i in 0..count {
            let side = dice.pick(&[-1.0, 1.0]);
            let away = dice.real(4.0..38.0) * dice.pick(&[-1.0, 1.0]);
            let z =
                side * (self.style.half_width - self.style.pavement_width * dice.real(0.2..0.8));
            add_person(
                stage,
                Vec3::new(stage.camera.position.x + away, 0.0, z),
                seed_of(&[traffic.seed, i]),
            );
        }
    }

    /// Vans in the lane before the camera.
    fn add_passing_van(&self, stage: &mut Stage, traffic: Traffic) {
        let mut dice = Dice::new(&[traffic.seed, 0x7a4]);
        let eye = stage.camera.position;
        let side = if eye.z > 0.0 { -1.0 } else { 1.0 };
        for direction in [-1.0, 1.0] {
            let x = eye.x + direction * dice.real(5.5..10.0);
            let centre = Vec3::new(x, 0.0, side * dice.real(1.6..2.4));
            add_vehicle(
                stage,
                centre,
                side,
                true,
                traffic.seed ^ u64::from(x.to_bits()),
                &mut dice,
            );
        }
    }
}

/// Collects what the camera sees; what it does not see is never painted.
struct Stage<'a> {
    camera: &'a Camera,
    quads: Vec<Quad>,
}

impl Stage<'_> {
    /// Adds the rectangle at `[origin, across, down]`, painted as finely as its distance asks for.
    fn add(
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

    /// The same with a texture at hand.
    fn add_painted(
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
    fn upright(
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
    fn scale_for(&self, [origin, across, down]: [Vec3; 3]) -> Option<f32> {
        if !self.camera.sees(origin, across, down) {
            return None;
        }
        // The point of the rectangle nearest to the camera.
        let offset = self.camera.position - origin;
        let share = |side: &Vec3| (offset.dot(side) / side.norm_squared()).clamp(0.0, 1.0);
        let nearest = origin + across * share(&across) + down * share(&down);
        let needed = self
            .camera
            .pixels_per_metre((nearest - self.camera.position).norm().max(1.0));
        // Steps of a factor 2, so that small moves of the camera keep the same painting.
        Some(
            [48.0, 24.0, 12.0]
                .into_iter()
                .rfind(|scale| *scale >= needed * 0.6)
                .unwrap_or(48.0),
        )
    }
}

fn upright([left, right]: [Vec3; 2], height: f32) -> [Vec3; 3] {
    [
        left + Vec3::new(0.0, height, 0.0),
        right - left,
        Vec3::new(0.0, -height, 0.0),
    ]
}

fn plain(width: f32, height: f32, scale: f32, colour: [u8; 3]) -> Painting {
    let mut painting = Painting::new(width, height, scale);
    painting.rect(0.0, 0.0, width, height, colour);
    painting
}

fn add_chimney(stage: &mut Stage, house: &HouseStyle, top: Vec3) {
    let foot = |dx: f32, dz: f32| top + Vec3::new(dx, -0.7, dz);
    let corners = [
        foot(0.0, -0.4),
        foot(0.9, -0.4),
        foot(0.9, 0.4),
        foot(0.0, 0.4),
    ];
    for (i, &corner) in corners.iter().enumerate() {
        stage.upright(
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
fn add_shop_extras(
    stage: &mut Stage,
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
        stage.add(shape, Surface::Prop, false, |scale| {
            let mut cloth = plain(width, 1.4, scale, [232, 226, 212]);
            let stripes = (width / stripe).ceil() as usize;
            (0..stripes)
                .step_by(2)
                .for_each(|i| cloth.rect(i as f32 * stripe, 0.0, stripe, 1.4, house.accent));
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
        stage.upright(ends, 0.9, Surface::Prop, true, |scale| {
            props::paint_hanging_sign(house.accent, scale, seed)
        });
    }
}

/// Two crossed cards, so that a tree has depth from everywhere.
fn add_tree(stage: &mut Stage, foot: Vec3, height: f32, seed: u64) {
    let width = height * 0.72;
    let cards = [
        Vec3::new(width / 2.0, 0.0, 0.0),
        Vec3::new(0.0, 0.0, width / 2.0),
    ];
    let cards = cards.map(|half| upright([foot - half, foot + half], height));
    let Some(scale) = cards.iter().find_map(|card| stage.scale_for(*card)) else {
        return;
    };
    let texture = Arc::new(Texture::new(&props::paint_tree(
        [width, height],
        scale.min(32.0),
        seed,
    )));
    for card in cards {
        stage.add_painted(card, Surface::Prop, true, texture.clone());
    }
}

/// A card that faces the camera.
fn add_person(stage: &mut Stage, foot: Vec3, seed: u64) {
    let mut towards = stage.camera.position - foot;
    towards.y = 0.0;
    if towards.norm() > 1.0 {
        let half = towards.cross(&Vec3::new(0.0, 1.0, 0.0)).normalize() * 0.4;
        let feet = [foot - half, foot + half];
        stage.upright(feet, 1.8, Surface::Prop, true, |scale| {
            props::paint_person(scale, seed)
        });
    }
}

/// A car or van parallel to the street: two flanks, panels across from tail to nose, and its
/// shadow.
fn add_vehicle(stage: &mut Stage, centre: Vec3, side: Side, van: bool, seed: u64, dice: &mut Dice) {
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
    let [length, width, height] = if van {
        [5.2, 1.95, 2.3]
    } else {
        [dice.real(3.8..4.7), 1.75, 1.48]
    };
    let (outline, colour) = if van {
        (props::VAN, dice.pick(&VANS))
    } else {
        (props::CAR, dice.pick(&CARS))
    };
    // Traffic keeps to the right: noses point along x on the right side of the street.
    let along = Vec3::new(side * length, 0.0, 0.0);
    let flank = Vec3::new(0.0, 0.0, width / 2.0);
    let tail = centre - along * 0.5;
    let flanks =
        [flank, -flank].map(|offset| upright([tail + offset, tail + along + offset], height));
    if let Some(scale) = flanks.iter().find_map(|shape| stage.scale_for(*shape)) {
        let body = Arc::new(Texture::new(&props::paint_flank(
            outline,
            [length, height],
            colour,
            scale,
            seed,
        )));
        flanks
            .into_iter()
            .for_each(|shape| stage.add_painted(shape, Surface::Prop, true, body.clone()));
    }
    for (i, pair) in outline.windows(2).enumerate() {
        let [from, to] = [pair[0].0, pair[1].0]
            .map(|[x, y]| tail + along * x + Vec3::new(0.0, (1.0 - y) * height, 0.0));
        let (upper, lower) = if from.y >= to.y {
            (from, to)
        } else {
            (to, from)
        };
        let shape = [upper - flank, flank * 2.0, lower - upper];
        let size = [width, (upper - lower).norm()];
        let lamps = if i == 0 {
            [176, 28, 30]
        } else {
            [238, 236, 214]
        };
        stage.add(shape, Surface::Prop, false, |scale| match (i, pair[0].1) {
            (0, _) => props::paint_end(size, colour, lamps, scale, seed),
            (last, _) if last + 2 == outline.len() => {
                props::paint_end(size, colour, lamps, scale, seed)
            }
            (_, true) => plain(size[0], size[1], 8.0, [50, 60, 70]),
            (_, false) => plain(size[0], size[1], 8.0, shaded(colour, 0.95)),
        });
    }
    let shadow = [
        tail - along * 0.04 + Vec3::new(0.0, 0.02, 0.0) - flank * 1.2,
        along * 1.08,
        flank * 2.4,
    ];
    stage.add(shadow, Surface::Prop, true, |_| {
        let mut dark = Painting::new(length, width, 12.0);
        dark.tint(0.1, 0.1, length - 0.2, width - 0.2, [8, 8, 10], 0.7);
        dark
    });
}

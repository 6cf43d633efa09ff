//! Which house, tree and van stands where, as rectangles around a camera.
//!
//! A street is an endless row of lots, each settled by the seed of its street and number alone, so that every camera
//! anywhere along it sees the same houses. Traffic belongs to the moment of capture instead.

use super::facade::{paint_front, paint_roof, paint_side};
use super::props;
use super::random::{Dice, seed_of};
use super::raster::{Quad, Surface, Vec3};
use super::style::{HouseStyle, StreetStyle};
use super::texture::Texture;
use std::sync::Arc;

/// Mean width of a lot in metres.
const LOT_M: f32 = 11.0;
/// Houses farther along the street than this are lost in the haze.
const VIEW_M: f32 = 120.0;
/// Houses nearer than this are painted in full detail.
const DETAIL_M: f32 = 34.0;
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
        Self { seed, style: StreetStyle::new(&mut Dice::new(&[seed])) }
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
            (self.boundary(side, lot), self.boundary(side, lot + 1), height)
        })
        .collect()
    }

    /// Everything seen from `along`, including `traffic`.
    pub(super) fn quads(&self, camera: Vec3, traffic: Traffic) -> Vec<Quad> {
        let mut quads = Vec::new();
        self.add_ground(&mut quads, camera.x);
        for side in [-1.0, 1.0] {
            let first = ((camera.x - VIEW_M) / LOT_M).floor() as i32;
            let last = ((camera.x + VIEW_M) / LOT_M).ceil() as i32;
            (first..last).for_each(|lot| self.add_lot(&mut quads, side, lot, camera));
            self.add_furniture(&mut quads, side, camera.x);
            self.add_parked(&mut quads, side, camera, traffic);
        }
        self.add_people(&mut quads, camera, traffic);
        if traffic.density > 1.5 {
            self.add_passing_van(&mut quads, camera, traffic);
        }
        quads
    }

    fn add_ground(&self, quads: &mut Vec<Quad>, along: f32) {
        const TILE: f32 = 24.0;
        let (half, pavement) = (self.style.half_width, self.style.pavement_width);
        let first = ((along - VIEW_M) / TILE).floor() as i32;
        let last = ((along + VIEW_M) / TILE).ceil() as i32;
        for tile in first..last {
            let start = tile as f32 * TILE;
            let near = (start + TILE / 2.0 - along).abs() < DETAIL_M;
            let seed = seed_of(&[self.seed, 0x6709d, tile as u32 as u64]);
            let scale = if near { 40.0 } else { 12.0 };
            let painting = props::paint_ground(TILE, half, pavement, self.style.cobbles, scale, seed);
            quads.push(Quad {
                origin: Vec3::new(start, 0.0, -half),
                across: Vec3::new(TILE, 0.0, 0.0),
                down: Vec3::new(0.0, 0.0, 2.0 * half),
                texture: Arc::new(Texture::new(&painting)),
                surface: Surface::Ground,
                cutout: false,
            });
            // Yards behind the gaps.
            for (from, to) in [(-half - 30.0, -half), (half, half + 30.0)] {
                let mut yard = super::paint::Painting::new(TILE, to - from, 2.0);
                yard.rect(0.0, 0.0, TILE, to - from, [104, 112, 78]);
                quads.push(Quad {
                    origin: Vec3::new(start, 0.0, from),
                    across: Vec3::new(TILE, 0.0, 0.0),
                    down: Vec3::new(0.0, 0.0, to - from),
                    texture: Arc::new(Texture::new(&yard)),
                    surface: Surface::Ground,
                    cutout: false,
                });
            }
        }
    }

    fn add_lot(&self, quads: &mut Vec<Quad>, side: Side, lot: i32, camera: Vec3) {
        let (start, end) = (self.boundary(side, lot), self.boundary(side, lot + 1));
        let seed = self.lot_seed(side, lot);
        let line = side * self.style.half_width;
        let Some(house) = self.house(side, lot) else {
            self.add_gap(quads, side, [start, end], seed);
            return;
        };
        let mut dice = self.dice(side, lot, 3);
        let front = line + side * dice.real(0.0..0.5);
        let back = front + side * DEPTH_M;
        let near = (start.max(camera.x) - end.min(camera.x)).abs().min((start - camera.x).abs()) < DETAIL_M;
        let scale = if near { 40.0 } else { 14.0 };
        let (height, width) = (house.height(), end - start);
        let shared = |painting| Arc::new(Texture::new(&painting));
        let at = |x: f32, z: f32| Vec3::new(x, 0.0, z);
        // Seen from the street, a front runs from left to right: along x on the left side, against it on the right.
        let (from, to) = if side < 0.0 { (start, end) } else { (end, start) };
        let texture = shared(paint_front(&house, width, scale, seed));
        quads.push(Quad::upright(at(from, front), at(to, front), height, texture, Surface::Wall));
        for x in [start, end] {
            let texture = shared(paint_side(&house, DEPTH_M, 12.0, seed ^ x.to_bits() as u64));
            quads.push(Quad::upright(at(x, front), at(x, back), height, texture, Surface::Wall));
        }
        let slope = if house.pitched { dice.real(2.2..3.6) } else { 0.4 };
        let texture = shared(paint_roof(&house, width, 5.0, scale * 0.5, seed));
        quads.push(Quad {
            origin: Vec3::new(from, height + slope, front + side * 4.0),
            across: Vec3::new(to - from, 0.0, 0.0),
            down: Vec3::new(0.0, -slope, -side * 4.0),
            texture,
            surface: Surface::Wall,
            cutout: false,
        });
        if house.pitched && dice.chance(0.7) {
            self.add_chimney(quads, &house, [dice.real(0.2..0.8) * width + start, height + slope, front + side * 3.6]);
        }
        if house.shop {
            self.add_shop_extras(quads, &house, side, [start, end, front], seed);
        }
    }

    fn add_gap(&self, quads: &mut Vec<Quad>, side: Side, [start, end]: [f32; 2], seed: u64) {
        // A garden wall with trees behind.
        let line = side * (self.style.half_width + 0.2);
        let mut wall = super::paint::Painting::new(end - start, 1.9, 24.0);
        wall.rect(0.0, 0.0, end - start, 1.9, [150, 128, 110]);
        wall.rect(0.0, 0.0, end - start, 0.14, [176, 170, 160]);
        wall.modulate(|x, y| 0.8 + 0.4 * super::random::lattice(seed, (x * 4.0) as i32, (y * 9.0) as i32));
        let texture = Arc::new(Texture::new(&wall));
        let foot = |x: f32| Vec3::new(x, 0.0, line);
        quads.push(Quad::upright(foot(start), foot(end), 1.9, texture, Surface::Wall));
        let mut dice = Dice::new(&[seed, 12]);
        for i in 0..2 {
            let at = Vec3::new(start + (end - start) * dice.real(0.25..0.75), 0.0, line + side * dice.real(2.5..6.0));
            add_tree(quads, at, dice.real(6.0..9.0), seed ^ i);
        }
    }

    fn add_chimney(&self, quads: &mut Vec<Quad>, house: &HouseStyle, [x, y, z]: [f32; 3]) {
        let mut brick = super::paint::Painting::new(0.9, 1.5, 24.0);
        brick.rect(0.0, 0.0, 0.9, 1.5, super::paint::shaded(house.roof, 1.1));
        brick.rect(0.0, 0.0, 0.9, 0.16, [90, 84, 80]);
        let texture = Arc::new(Texture::new(&brick));
        let base = y - 0.7;
        let foot = |dx: f32, dz: f32| Vec3::new(x + dx, base, z + dz);
        for (a, b) in [
            (foot(0.0, -0.4), foot(0.9, -0.4)),
            (foot(0.0, 0.4), foot(0.9, 0.4)),
            (foot(0.0, -0.4), foot(0.0, 0.4)),
            (foot(0.9, -0.4), foot(0.9, 0.4)),
        ] {
            quads.push(Quad::upright(a, b, 1.5, texture.clone(), Surface::Wall));
        }
    }

    /// An awning over the show windows and a board hung out across the pavement.
    fn add_shop_extras(
        &self,
        quads: &mut Vec<Quad>,
        house: &HouseStyle,
        side: Side,
        [start, end, front]: [f32; 3],
        seed: u64,
    ) {
        let mut dice = Dice::new(&[seed, 13]);
        let lintel = house.ground_height - 0.9;
        if dice.chance(0.5) {
            let width = end - start - 0.6;
            let mut cloth = super::paint::Painting::new(width, 1.4, 24.0);
            let stripe = dice.real(0.25..0.6);
            for i in 0..(width / stripe).ceil() as usize {
                let colour = if i % 2 == 0 { house.accent } else { [232, 226, 212] };
                cloth.rect(i as f32 * stripe, 0.0, stripe, 1.4, colour);
            }
            cloth.tint(0.0, 1.2, width, 0.03, [0, 0, 0], 0.4);
            quads.push(Quad {
                origin: Vec3::new(start + 0.3, lintel + 0.1, front),
                across: Vec3::new(width, 0.0, 0.0),
                down: Vec3::new(0.0, -0.55, -side * 1.3),
                texture: Arc::new(Texture::new(&cloth)),
                surface: Surface::Prop,
                cutout: false,
            });
        }
        if dice.chance(0.8) {
            let sign = props::paint_hanging_sign(house.accent, 48.0, seed);
            let x = dice.pick(&[start + 0.6, end - 0.6]);
            let foot = Vec3::new(x, lintel + 0.2, front - side * 0.15);
            let texture = Arc::new(Texture::new(&sign));
            let out = foot - Vec3::new(0.0, 0.0, side * 0.9);
            quads.push(Quad::upright(foot, out, 0.9, texture, Surface::Prop).with_cutout());
        }
    }

    /// Trees, lamps and road signs along the kerb.
    fn add_furniture(&self, quads: &mut Vec<Quad>, side: Side, along: f32) {
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
                let texture = Arc::new(Texture::new(&props::paint_lamp(40.0, seed)));
                let out = foot - Vec3::new(0.0, 0.0, side * 1.2);
                // The head hangs over the road, so the texture's left edge does too.
                quads.push(Quad::upright(out, foot, 5.0, texture, Surface::Prop).with_cutout());
            }
            if dice.chance(0.3) {
                let foot = at(dice.real(9.5..12.0));
                let texture = Arc::new(Texture::new(&props::paint_road_sign(48.0, seed)));
                quads.push(
                    Quad::upright(foot, foot + Vec3::new(0.0, 0.0, 0.7), 2.6, texture, Surface::Prop).with_cutout(),
                );
            }
        }
    }

    fn add_parked(&self, quads: &mut Vec<Quad>, side: Side, camera: Vec3, traffic: Traffic) {
        const STEP: f32 = 6.4;
        let lane = side * (self.style.half_width - self.style.pavement_width - 1.25);
        let first = ((camera.x - 60.0) / STEP).floor() as i32;
        let last = ((camera.x + 60.0) / STEP).ceil() as i32;
        for slot in first..last {
            let seed = seed_of(&[traffic.seed, 0xca5, u64::from(side > 0.0), slot as u32 as u64]);
            let mut dice = Dice::new(&[seed]);
            let centre = Vec3::new(slot as f32 * STEP + dice.real(0.0..1.0), 0.0, lane);
            // Nobody parks on the camera.
            if dice.chance(0.3 * traffic.density.min(1.5)) && (centre - camera).norm() > 5.0 {
                add_vehicle(quads, centre, side, dice.chance(0.2), seed, &mut dice);
            }
        }
    }

    fn add_people(&self, quads: &mut Vec<Quad>, camera: Vec3, traffic: Traffic) {
        let mut dice = Dice::new(&[traffic.seed, 0x9e0]);
        let count = (dice.real(2.0..9.0) * traffic.density) as u64;
        for i in 0..count {
            let side = dice.pick(&[-1.0, 1.0]);
            let away = dice.real(4.0..38.0) * dice.pick(&[-1.0, 1.0]);
            let z = side * (self.style.half_width - self.style.pavement_width * dice.real(0.2..0.8));
            let foot = Vec3::new(camera.x + away, 0.0, z);
            add_billboard(quads, foot, camera, 0.8, 1.8, props::paint_person(64.0, seed_of(&[traffic.seed, i])));
        }
    }

    /// A van in the lane before the camera.
    fn add_passing_van(&self, quads: &mut Vec<Quad>, camera: Vec3, traffic: Traffic) {
        let mut dice = Dice::new(&[traffic.seed, 0x7a4]);
        let side = if camera.z > 0.0 { -1.0 } else { 1.0 };
        for direction in [-1.0, 1.0] {
            let x = camera.x + direction * dice.real(5.5..10.0);
            let centre = Vec3::new(x, 0.0, side * dice.real(1.6..2.4));
            add_vehicle(quads, centre, side, true, traffic.seed ^ x.to_bits() as u64, &mut dice);
        }
    }
}

/// Two crossed cards, so that a tree has depth from everywhere.
fn add_tree(quads: &mut Vec<Quad>, foot: Vec3, height: f32, seed: u64) {
    let width = height * 0.72;
    let texture = Arc::new(Texture::new(&props::paint_tree([width, height], 28.0, seed)));
    for half in [Vec3::new(width / 2.0, 0.0, 0.0), Vec3::new(0.0, 0.0, width / 2.0)] {
        quads.push(Quad::upright(foot - half, foot + half, height, texture.clone(), Surface::Prop).with_cutout());
    }
}

fn add_billboard(
    quads: &mut Vec<Quad>,
    foot: Vec3,
    camera: Vec3,
    width: f32,
    height: f32,
    painting: super::paint::Painting,
) {
    let mut towards = camera - foot;
    towards.y = 0.0;
    if towards.norm() < 1.0 {
        return;
    }
    let half = towards.cross(&Vec3::new(0.0, 1.0, 0.0)).normalize() * (width / 2.0);
    let texture = Arc::new(Texture::new(&painting));
    quads.push(Quad::upright(foot - half, foot + half, height, texture, Surface::Prop).with_cutout());
}

/// A car or van parallel to the street, as four cards and a roof.
fn add_vehicle(quads: &mut Vec<Quad>, centre: Vec3, side: Side, van: bool, seed: u64, dice: &mut Dice) {
    let [length, width, height] = if van { [5.2, 1.95, 2.3] } else { [dice.real(3.8..4.7), 1.75, 1.48] };
    let colour = dice.pick(&[
        [196, 198, 200],
        [34, 36, 40],
        [120, 124, 130],
        [150, 30, 34],
        [34, 62, 116],
        [222, 222, 218],
        [60, 88, 70],
        [184, 150, 96],
    ]);
    let colour = if van { dice.pick(&[[232, 232, 228], [176, 36, 36], [226, 180, 40], [44, 74, 130]]) } else { colour };
    let body = Arc::new(Texture::new(&props::paint_vehicle_side(length, height, van, colour, 44.0, seed)));
    let end = Arc::new(Texture::new(&props::paint_vehicle_end(width, height, van, colour, 44.0, seed)));
    // Traffic keeps to the right: noses point along x on the right side of the street.
    let nose = Vec3::new(side * length / 2.0, 0.0, 0.0);
    let flank = Vec3::new(0.0, 0.0, width / 2.0);
    for offset in [flank, -flank] {
        let (back, front) = (centre - nose + offset, centre + nose + offset);
        quads.push(Quad::upright(back, front, height, body.clone(), Surface::Prop).with_cutout());
    }
    for tip in [nose * 0.93, -nose * 0.96] {
        let (a, b) = (centre + tip - flank, centre + tip + flank);
        quads.push(Quad::upright(a, b, height, end.clone(), Surface::Prop).with_cutout());
    }
    let mut dark = super::paint::Painting::new(length + 0.5, width + 0.4, 12.0);
    dark.tint(0.1, 0.1, length + 0.3, width + 0.2, [8, 8, 10], 0.7);
    let mut roof = super::paint::Painting::new(1.0, 1.0, 8.0);
    roof.rect(0.0, 0.0, 1.0, 1.0, super::paint::shaded(colour, 0.95));
    let (roof_from, roof_to) = if van { (-0.5, 0.2) } else { (-0.2, 0.12) };
    let flat = |from: f32, to: f32, y: f32, half: f32, painting| Quad {
        origin: centre + nose * (2.0 * from) + Vec3::new(0.0, y, -half),
        across: nose * (2.0 * (to - from)),
        down: Vec3::new(0.0, 0.0, 2.0 * half),
        texture: Arc::new(Texture::new(painting)),
        surface: Surface::Prop,
        cutout: true,
    };
    quads.push(flat(roof_from, roof_to, height - 0.06, width / 2.0, &roof));
    quads.push(flat(-0.55, 0.55, 0.02, width / 2.0 + 0.2, &dark));
}

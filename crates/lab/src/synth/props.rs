//! What stands in the street: trees, lamps, signs, and the vans, cars and people that come and go.

use super::lettering::paint_lettering;
use super::paint::{Painting, shaded};
use super::random::{Dice, fractal, lattice};

/// A tree of `size` metres width and height.
pub(super) fn paint_tree(size: [f32; 2], scale: f32, seed: u64) -> Painting {
    let [width, height] = size;
    let mut tree = Painting::new(width, height, scale);
    let mut dice = Dice::new(&[seed, 3]);
    let middle = width / 2.0;
    let bark = [84, 68, 56];
    let lean = dice.real(-0.25..0.25);
    tree.polygon(
        &[
            [middle - 0.17, height],
            [middle + 0.17, height],
            [middle + 0.08 + lean, height * 0.35],
            [middle - 0.08 + lean, height * 0.35],
        ],
        bark,
    );
    for _ in 0..6 {
        let tip = [
            middle + dice.real(-0.38..0.38) * width,
            height * dice.real(0.12..0.5),
        ];
        tree.line(&[[middle + lean * 0.7, height * 0.55], tip], 0.09, bark);
    }
    let green = dice.pick(&[[72, 104, 50], [88, 116, 54], [64, 92, 56], [110, 118, 52]]);
    // Clumps from the shaded inside out to the lit top.
    for layer in 0..5 {
        let light = 0.62 + 0.14 * layer as f32;
        for _ in 0..90 {
            let angle = dice.real(0.0..std::f32::consts::TAU);
            let reach = dice.real(0.0..1.0f32).sqrt();
            let spread = 0.46 - 0.035 * layer as f32;
            let centre = [
                middle + angle.cos() * reach * spread * width,
                height * (0.36 - 0.02 * layer as f32) + angle.sin() * reach * height * 0.31,
            ];
            let radius = dice.real(0.12..0.34);
            let shade = light * (1.25 - centre[1] / height * 0.7);
            tree.ellipse(
                centre,
                [radius, radius * 0.8],
                dice.vary(shaded(green, shade), 9.0),
                0.96,
            );
        }
    }
    tree.modulate(|x, y| 0.75 + 0.5 * lattice(seed, (x * 22.0) as i32, (y * 22.0) as i32));
    tree
}

/// A street lamp, 5 m high and 1.2 m wide, its head at the top left.
pub(super) fn paint_lamp(scale: f32, seed: u64) -> Painting {
    let mut lamp = Painting::new(1.2, 5.0, scale);
    let iron = Dice::new(&[seed, 4]).pick(&[[52, 56, 58], [40, 62, 54], [92, 94, 96]]);
    lamp.rect(0.86, 0.3, 0.1, 4.7, iron);
    lamp.rect(0.8, 4.3, 0.22, 0.7, iron);
    lamp.line(&[[0.9, 0.4], [0.7, 0.14], [0.3, 0.14]], 0.08, iron);
    lamp.polygon(&[[0.1, 0.1], [0.5, 0.1], [0.6, 0.32], [0.0, 0.32]], iron);
    lamp.rect(0.06, 0.3, 0.48, 0.14, [240, 232, 200]);
    lamp.glow(0.0, 0.26, 0.6, 0.2, 1.0);
    lamp
}

/// A traffic sign on a post, 2.6 m high and 0.7 m wide.
pub(super) fn paint_road_sign(scale: f32, seed: u64) -> Painting {
    let mut sign = Painting::new(0.7, 2.6, scale);
    let mut dice = Dice::new(&[seed, 5]);
    sign.rect(0.32, 0.3, 0.06, 2.3, [130, 132, 134]);
    let white = [236, 236, 232];
    match dice.whole(0..4) {
        0 => {
            sign.ellipse([0.35, 0.35], [0.33, 0.33], [190, 30, 36], 1.0);
            sign.rect(0.12, 0.29, 0.46, 0.12, white);
        }
        1 => {
            sign.ellipse([0.35, 0.35], [0.33, 0.33], [190, 30, 36], 1.0);
            sign.ellipse([0.35, 0.35], [0.25, 0.25], white, 1.0);
            paint_lettering(
                &mut sign,
                [0.2, 0.24],
                [0.32, 0.22],
                [20, 20, 20],
                2,
                &mut dice,
            );
        }
        2 => {
            sign.rect(0.04, 0.04, 0.62, 0.62, [24, 82, 160]);
            paint_lettering(&mut sign, [0.18, 0.16], [0.36, 0.38], white, 1, &mut dice);
        }
        _ => {
            sign.polygon(&[[0.35, 0.02], [0.68, 0.62], [0.02, 0.62]], [190, 30, 36]);
            sign.polygon(&[[0.35, 0.15], [0.57, 0.55], [0.13, 0.55]], white);
        }
    }
    sign
}

/// A board hung out over the pavement, 0.9 m square.
pub(super) fn paint_hanging_sign(accent: [u8; 3], scale: f32, seed: u64) -> Painting {
    let mut sign = Painting::new(0.9, 0.9, scale);
    let mut dice = Dice::new(&[seed, 6]);
    sign.rect(0.0, 0.0, 0.9, 0.05, [40, 40, 42]);
    let ink = dice.pick(&[[250, 246, 230], [250, 214, 110], [30, 30, 34]]);
    if dice.chance(0.5) {
        sign.rect(0.06, 0.12, 0.78, 0.72, accent);
    } else {
        sign.ellipse([0.45, 0.5], [0.38, 0.37], accent, 1.0);
    }
    paint_lettering(
        &mut sign,
        [0.2, 0.32],
        [0.52, 0.32],
        ink,
        dice.whole(1..4),
        &mut dice,
    );
    sign.glow(0.06, 0.12, 0.78, 0.72, 0.5);
    sign
}

/// A person, 1.8 m high and 0.8 m wide, walking.
pub(super) fn paint_person(scale: f32, seed: u64) -> Painting {
    let mut person = Painting::new(0.8, 1.8, scale);
    let mut dice = Dice::new(&[seed, 9]);
    let cloth = [
        [150, 50, 50],
        [50, 70, 110],
        [70, 90, 70],
        [190, 180, 160],
        [40, 40, 46],
        [190, 140, 50],
    ];
    let coat = dice.pick(&cloth);
    let coat = dice.vary(coat, 14.0);
    let trousers = dice.pick(&[[40, 44, 60], [70, 62, 54], [30, 30, 32], [96, 100, 108]]);
    let skin = dice.pick(&[
        [224, 184, 156],
        [164, 116, 86],
        [104, 72, 54],
        [236, 200, 176],
    ]);
    let stride = dice.real(0.04..0.18);
    person.line(&[[0.4, 0.95], [0.4 - stride, 1.72]], 0.15, trousers);
    person.line(
        &[[0.42, 0.95], [0.42 + stride, 1.72]],
        0.15,
        shaded(trousers, 0.8),
    );
    person.rect(0.34 - stride, 1.7, 0.2, 0.09, [30, 28, 28]);
    person.rect(0.36 + stride, 1.7, 0.2, 0.09, [30, 28, 28]);
    person.polygon(
        &[[0.24, 0.36], [0.56, 0.36], [0.6, 1.02], [0.22, 1.02]],
        coat,
    );
    person.line(&[[0.27, 0.42], [0.2, 0.95]], 0.1, shaded(coat, 0.82));
    person.line(&[[0.53, 0.42], [0.6, 0.92]], 0.1, shaded(coat, 0.9));
    person.ellipse([0.4, 0.2], [0.1, 0.13], skin, 1.0);
    person.ellipse(
        [0.4, 0.13],
        [0.11, 0.09],
        dice.pick(&[[40, 30, 26], [110, 76, 44], [160, 150, 140]]),
        1.0,
    );
    if dice.chance(0.4) {
        person.rect(0.58, 0.85, 0.18, 0.3, dice.vary([120, 80, 60], 40.0));
    }
    person
}

/// A stretch of road with its pavements; metres.
pub(super) struct GroundPlan {
    /// Where it begins along the street.
    pub start: f32,
    pub length: f32,
    pub half_width: f32,
    pub pavement: f32,
    pub cobbles: bool,
}

/// Paints a stretch of road, x along the street; `seeds` are the street's and the stretch's own.
pub(super) fn paint_ground(plan: &GroundPlan, scale: f32, [street, stretch]: [u64; 2]) -> Painting {
    let GroundPlan {
        start,
        length,
        half_width,
        pavement,
        cobbles,
    } = *plan;
    let width = half_width * 2.0;
    let mut ground = Painting::new(length, width, scale);
    let mut dice = Dice::new(&[stretch, 11]);
    ground.rect(0.0, 0.0, length, width, [92, 92, 94]);
    for top in [0.0, width - pavement] {
        ground.rect(0.0, top, length, pavement, [150, 146, 138]);
    }
    for top in [pavement - 0.14, width - pavement] {
        ground.rect(0.0, top, length, 0.14, [178, 174, 166]);
    }
    for _ in 0..dice.whole(0..3) {
        let x = dice.real(0.0..length - 4.0);
        let y = dice.real(pavement + 0.5..width - pavement - 1.5);
        ground.tint(
            x,
            y,
            dice.real(0.8..4.0),
            dice.real(0.5..1.4),
            [40, 40, 42],
            0.45,
        );
    }
    if !cobbles {
        // Stretches are as long as two dashes with their gaps.
        [0.0, length / 2.0]
            .into_iter()
            .for_each(|x| ground.rect(x, half_width - 0.06, length / 4.0, 0.12, [206, 204, 196]));
    }
    if dice.chance(0.7) {
        let at = [
            dice.real(1.0..length - 1.0),
            dice.real(pavement + 0.5..width - pavement - 0.5),
        ];
        ground.ellipse(at, [0.35, 0.35], [62, 60, 58], 1.0);
        ground.ellipse(at, [0.28, 0.28], [78, 76, 74], 1.0);
    }
    ground.modulate(|x, y| {
        let x = x + start;
        let on_road = y > pavement && y < width - pavement;
        let wear = 0.82 + 0.36 * fractal(street, x * 0.4, y * 0.8, 3);
        let grain = 0.88 + 0.24 * lattice(street ^ 1, (x * 24.0) as i32, (y * 24.0) as i32);
        let joints = match (on_road, cobbles) {
            (true, false) => 1.0,
            (true, true) => paving(street, x, y, 0.22),
            (false, _) => paving(street, x, y, 0.6),
        };
        wear * grain * joints
    });
    ground
}

fn paving(seed: u64, x: f32, y: f32, side: f32) -> f32 {
    let row = (y / side).floor();
    let along = x / side + if row as i32 % 2 == 0 { 0.0 } else { 0.5 };
    let joint = along.fract() < 0.07 || (y / side).fract() < 0.07;
    if joint {
        0.7
    } else {
        0.9 + 0.2 * lattice(seed ^ 2, along.floor() as i32, row as i32)
    }
}

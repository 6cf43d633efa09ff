//! What stands in the street: trees, lamps, signs, and the vans, cars and people that come and go.

use super::facade::paint_lettering;
use super::paint::{Painting, shaded};
use super::random::{Dice, fractal, lattice};

/// A tree of `size` metres width and height.
pub(super) fn paint_tree(size: [f32; 2], scale: f32, seed: u64) -> Painting {
    let [width, height] = size;
    let mut tree = Painting::new(width, height, scale);
    let mut dice = Dice::new(&[seed, 3]);
    let (middle, bark) = (width / 2.0, [84, 68, 56]);
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
        let tip = [middle + dice.real(-0.38..0.38) * width, height * dice.real(0.12..0.5)];
        tree.line(&[[middle + lean * 0.7, height * 0.55], tip], 0.09, bark);
    }
    let green = dice.pick(&[[72, 104, 50], [88, 116, 54], [64, 92, 56], [110, 118, 52]]);
    // Clumps from the shaded inside out to the lit top.
    for layer in 0..5 {
        let light = 0.62 + 0.14 * layer as f32;
        for _ in 0..90 {
            let (angle, reach) = (dice.real(0.0..std::f32::consts::TAU), dice.real(0.0..1.0f32).sqrt());
            let spread = 0.46 - 0.035 * layer as f32;
            let centre = [
                middle + angle.cos() * reach * spread * width,
                height * (0.36 - 0.02 * layer as f32) + angle.sin() * reach * height * 0.31,
            ];
            let radius = dice.real(0.12..0.34);
            let shade = light * (1.25 - centre[1] / height * 0.7);
            tree.ellipse(centre, [radius, radius * 0.8], dice.vary(shaded(green, shade), 9.0), 0.96);
        }
    }
    tree.modulate(|x, y| 0.75 + 0.5 * lattice(seed, (x * 9.0) as i32, (y * 9.0) as i32));
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
            paint_lettering(&mut sign, [0.2, 0.24], [0.32, 0.22], [20, 20, 20], 2, &mut dice);
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
    paint_lettering(&mut sign, [0.2, 0.32], [0.52, 0.32], ink, dice.whole(1..4), &mut dice);
    sign.glow(0.06, 0.12, 0.78, 0.72, 0.5);
    sign
}

/// The side of a car or van, nose to the right; metres.
pub(super) fn paint_vehicle_side(
    length: f32,
    height: f32,
    van: bool,
    colour: [u8; 3],
    scale: f32,
    seed: u64,
) -> Painting {
    let mut side = Painting::new(length, height, scale);
    let mut dice = Dice::new(&[seed, 7]);
    let sill = height - 0.32;
    let glass = [48, 58, 68];
    if van {
        side.polygon(
            &[
                [0.05, 0.1],
                [length * 0.72, 0.05],
                [length * 0.86, height * 0.42],
                [length - 0.05, height * 0.52],
                [length, sill],
                [0.0, sill],
            ],
            colour,
        );
        side.polygon(
            &[
                [length * 0.66, 0.25],
                [length * 0.73, 0.25],
                [length * 0.83, height * 0.44],
                [length * 0.66, height * 0.44],
            ],
            glass,
        );
        if dice.chance(0.7) {
            let ink = dice.pick(&[[240, 240, 240], [30, 40, 90], [180, 40, 40]]);
            paint_lettering(
                &mut side,
                [length * 0.12, height * 0.25],
                [length * 0.45, height * 0.2],
                ink,
                dice.whole(4..9),
                &mut dice,
            );
        }
    } else {
        side.polygon(
            &[
                [0.0, height * 0.5],
                [length * 0.16, height * 0.42],
                [length * 0.28, 0.03],
                [length * 0.62, 0.03],
                [length * 0.76, height * 0.42],
                [length * 0.97, height * 0.52],
                [length, sill],
                [0.0, sill],
            ],
            colour,
        );
        side.polygon(
            &[
                [length * 0.21, height * 0.42],
                [length * 0.31, 0.12],
                [length * 0.45, 0.12],
                [length * 0.45, height * 0.42],
            ],
            glass,
        );
        side.polygon(
            &[
                [length * 0.48, 0.12],
                [length * 0.6, 0.12],
                [length * 0.71, height * 0.42],
                [length * 0.48, height * 0.42],
            ],
            glass,
        );
    }
    side.tint(0.0, height * 0.56, length, 0.04, [0, 0, 0], 0.3);
    side.rect(0.02, sill - 0.16, length - 0.04, 0.16, shaded(colour, 0.55));
    for axle in [length * 0.19, length * 0.81] {
        side.ellipse([axle, height - 0.31], [0.31, 0.31], [26, 26, 28], 1.0);
        side.ellipse([axle, height - 0.31], [0.17, 0.17], [140, 142, 146], 1.0);
    }
    side.rect(length - 0.14, height * 0.58, 0.12, 0.12, [240, 236, 210]);
    side.rect(0.02, height * 0.56, 0.1, 0.14, [170, 24, 28]);
    side
}

/// The front or back of a vehicle.
pub(super) fn paint_vehicle_end(
    width: f32,
    height: f32,
    van: bool,
    colour: [u8; 3],
    scale: f32,
    seed: u64,
) -> Painting {
    let mut end = Painting::new(width, height, scale);
    let mut dice = Dice::new(&[seed, 8]);
    let top = if van { 0.08 } else { 0.03 };
    end.polygon(
        &[
            [0.2, top],
            [width - 0.2, top],
            [width - 0.03, height * 0.45],
            [width, height - 0.2],
            [0.0, height - 0.2],
            [0.03, height * 0.45],
        ],
        colour,
    );
    end.polygon(
        &[[0.28, height * 0.12], [width - 0.28, height * 0.12], [width - 0.14, height * 0.42], [0.14, height * 0.42]],
        [52, 62, 72],
    );
    end.rect(0.04, height * 0.54, 0.22, 0.14, [186, 30, 32]);
    end.rect(width - 0.26, height * 0.54, 0.22, 0.14, [186, 30, 32]);
    end.rect(width / 2.0 - 0.26, height * 0.66, 0.52, 0.12, [236, 236, 230]);
    paint_lettering(&mut end, [width / 2.0 - 0.22, height * 0.66 + 0.02], [0.44, 0.08], [20, 20, 24], 6, &mut dice);
    end.rect(0.02, height - 0.32, width - 0.04, 0.14, shaded(colour, 0.45));
    for left in [0.08, width - 0.3] {
        end.rect(left, height - 0.26, 0.22, 0.26, [24, 24, 26]);
    }
    end
}

/// A person, 1.8 m high and 0.8 m wide, walking.
pub(super) fn paint_person(scale: f32, seed: u64) -> Painting {
    let mut person = Painting::new(0.8, 1.8, scale);
    let mut dice = Dice::new(&[seed, 9]);
    let cloth = [[150, 50, 50], [50, 70, 110], [70, 90, 70], [190, 180, 160], [40, 40, 46], [190, 140, 50]];
    let coat = dice.pick(&cloth);
    let coat = dice.vary(coat, 14.0);
    let trousers = dice.pick(&[[40, 44, 60], [70, 62, 54], [30, 30, 32], [96, 100, 108]]);
    let skin = dice.pick(&[[224, 184, 156], [164, 116, 86], [104, 72, 54], [236, 200, 176]]);
    let stride = dice.real(0.04..0.18);
    person.line(&[[0.4, 0.95], [0.4 - stride, 1.72]], 0.15, trousers);
    person.line(&[[0.42, 0.95], [0.42 + stride, 1.72]], 0.15, shaded(trousers, 0.8));
    person.rect(0.34 - stride, 1.7, 0.2, 0.09, [30, 28, 28]);
    person.rect(0.36 + stride, 1.7, 0.2, 0.09, [30, 28, 28]);
    person.polygon(&[[0.24, 0.36], [0.56, 0.36], [0.6, 1.02], [0.22, 1.02]], coat);
    person.line(&[[0.27, 0.42], [0.2, 0.95]], 0.1, shaded(coat, 0.82));
    person.line(&[[0.53, 0.42], [0.6, 0.92]], 0.1, shaded(coat, 0.9));
    person.ellipse([0.4, 0.2], [0.1, 0.13], skin, 1.0);
    person.ellipse([0.4, 0.13], [0.11, 0.09], dice.pick(&[[40, 30, 26], [110, 76, 44], [160, 150, 140]]), 1.0);
    if dice.chance(0.4) {
        person.rect(0.58, 0.85, 0.18, 0.3, dice.vary([120, 80, 60], 40.0));
    }
    person
}

/// A stretch of road with pavements, `length` by twice `half_width` metres; x runs along the street.
pub(super) fn paint_ground(
    length: f32,
    half_width: f32,
    pavement: f32,
    cobbles: bool,
    scale: f32,
    seed: u64,
) -> Painting {
    let width = half_width * 2.0;
    let mut ground = Painting::new(length, width, scale);
    let mut dice = Dice::new(&[seed, 11]);
    ground.rect(0.0, 0.0, length, width, [92, 92, 94]);
    for top in [0.0, width - pavement] {
        ground.rect(0.0, top, length, pavement, [150, 146, 138]);
    }
    for top in [pavement - 0.14, width - pavement] {
        ground.rect(0.0, top, length, 0.14, [178, 174, 166]);
    }
    for _ in 0..(length / 9.0) as usize {
        let (x, y) = (dice.real(0.0..length), dice.real(pavement + 0.5..width - pavement - 1.5));
        ground.tint(x, y, dice.real(0.8..4.0), dice.real(0.5..1.4), [40, 40, 42], 0.45);
    }
    if !cobbles {
        (0..(length / 6.0) as usize)
            .for_each(|i| ground.rect(i as f32 * 6.0, half_width - 0.06, 3.0, 0.12, [206, 204, 196]));
    }
    for _ in 0..(length / 14.0) as usize {
        let at = [dice.real(0.0..length), dice.real(pavement..width - pavement)];
        ground.ellipse(at, [0.35, 0.35], [62, 60, 58], 1.0);
    }
    ground.modulate(|x, y| {
        let on_road = y > pavement && y < width - pavement;
        let wear = 0.82 + 0.36 * fractal(seed, x * 0.4, y * 0.8, 4);
        let grain = 0.88 + 0.24 * lattice(seed ^ 1, (x * 24.0) as i32, (y * 24.0) as i32);
        let joints = match (on_road, cobbles) {
            (true, false) => 1.0,
            (true, true) => paving(seed, x, y, 0.22),
            (false, _) => paving(seed, x, y, 0.6),
        };
        wear * grain * joints
    });
    ground
}

fn paving(seed: u64, x: f32, y: f32, side: f32) -> f32 {
    let row = (y / side).floor();
    let along = x / side + if row as i32 % 2 == 0 { 0.0 } else { 0.5 };
    let joint = along.fract() < 0.07 || (y / side).fract() < 0.07;
    if joint { 0.7 } else { 0.9 + 0.2 * lattice(seed ^ 2, along.floor() as i32, row as i32) }
}

//! Flanks and ends of cars and vans.

use super::lettering::paint_lettering;
use super::paint::{Painting, shaded};
use super::random::Dice;

/// The outline of a vehicle from its tail over the roof to its nose, in shares of length and height
/// (down from the top), and whether the panel up to the next point is glass.
pub(super) type Outline = [([f32; 2], bool)];

/// A saloon car.
pub(super) const CAR: &Outline = &[
    ([0.0, 0.88], false),
    ([0.01, 0.5], false),
    ([0.14, 0.42], true),
    ([0.27, 0.03], false),
    ([0.6, 0.03], true),
    ([0.75, 0.42], false),
    ([0.97, 0.52], false),
    ([1.0, 0.88], false),
];

/// A delivery van.
pub(super) const VAN: &Outline = &[
    ([0.0, 0.9], false),
    ([0.0, 0.08], false),
    ([0.03, 0.03], false),
    ([0.72, 0.03], true),
    ([0.86, 0.42], false),
    ([0.98, 0.52], false),
    ([1.0, 0.9], false),
];

const GLASS: [u8; 3] = [48, 58, 68];

/// The flank of a vehicle, nose to the right; metres.
pub(super) fn paint_flank(
    outline: &Outline,
    [length, height]: [f32; 2],
    colour: [u8; 3],
    scale: f32,
    seed: u64,
) -> Painting {
    let mut flank = Painting::new(length, height, scale);
    let mut dice = Dice::new(&[seed, 7]);
    let at = |x: f32, y: f32| [length * x, height * y];
    let points: Vec<[f32; 2]> = outline.iter().map(|([x, y], _)| at(*x, *y)).collect();
    flank.polygon(&points, colour);
    if outline.len() == VAN.len() {
        paint_van_side(&mut flank, [length, height], colour, &mut dice);
    } else {
        paint_saloon_side(&mut flank, [length, height], colour);
    }
    flank.tint(
        length * 0.01,
        height * 0.57,
        length * 0.97,
        0.04,
        [0, 0, 0],
        0.3,
    );
    flank.rect(
        length * 0.02,
        height * 0.8,
        length * 0.96,
        height * 0.09,
        shaded(colour, 0.55),
    );
    for axle in [length * 0.19, length * 0.81] {
        flank.ellipse([axle, height - 0.34], [0.38, 0.38], [18, 18, 20], 1.0);
        flank.ellipse([axle, height - 0.31], [0.31, 0.31], [28, 28, 30], 1.0);
        flank.ellipse([axle, height - 0.31], [0.17, 0.17], [140, 142, 146], 1.0);
    }
    let head_lamp = [length * 0.97, height * 0.58];
    flank.rect(
        head_lamp[0],
        head_lamp[1],
        length * 0.02,
        0.12,
        [240, 236, 210],
    );
    flank.rect(length * 0.012, height * 0.56, 0.1, 0.14, [170, 24, 28]);
    flank
}

/// The cab window, the edge of the door, and often a name.
fn paint_van_side(
    flank: &mut Painting,
    [length, height]: [f32; 2],
    colour: [u8; 3],
    dice: &mut Dice,
) {
    let at = |x: f32, y: f32| [length * x, height * y];
    let window = [
        at(0.66, 0.12),
        at(0.73, 0.12),
        at(0.83, 0.42),
        at(0.66, 0.42),
    ];
    flank.polygon(&window, GLASS);
    let edge = at(0.64, 0.1);
    flank.rect(edge[0], edge[1], 0.03, height * 0.75, shaded(colour, 0.7));
    if dice.chance(0.7) {
        let ink = dice.pick(&[[240, 240, 240], [30, 40, 90], [180, 40, 40], [40, 40, 44]]);
        let letters = dice.whole(4..9);
        paint_lettering(flank, at(0.1, 0.25), at(0.45, 0.2), ink, letters, dice);
    }
}

/// Two windows and the edge of the door.
fn paint_saloon_side(flank: &mut Painting, [length, height]: [f32; 2], colour: [u8; 3]) {
    let at = |x: f32, y: f32| [length * x, height * y];
    let rear = [at(0.2, 0.42), at(0.3, 0.11), at(0.44, 0.11), at(0.44, 0.42)];
    flank.polygon(&rear, GLASS);
    let front = [
        at(0.47, 0.11),
        at(0.58, 0.11),
        at(0.7, 0.42),
        at(0.47, 0.42),
    ];
    flank.polygon(&front, GLASS);
    let edge = at(0.455, 0.42);
    flank.rect(edge[0], edge[1], 0.02, height * 0.4, shaded(colour, 0.7));
}

/// The tail or the nose of a vehicle: lamps, number plate, bumper.
pub(super) fn paint_end(
    [width, height]: [f32; 2],
    colour: [u8; 3],
    lamps: [u8; 3],
    scale: f32,
    seed: u64,
) -> Painting {
    let mut end = Painting::new(width, height, scale);
    let mut dice = Dice::new(&[seed, 8]);
    end.rect(0.0, 0.0, width, height, colour);
    if height > 1.2 {
        // A van's back doors.
        end.rect(
            width / 2.0 - 0.01,
            0.1,
            0.03,
            height - 0.3,
            shaded(colour, 0.6),
        );
        for left in [0.2, width / 2.0 + 0.12] {
            end.rect(
                left,
                height * 0.12,
                width / 2.0 - 0.32,
                height * 0.25,
                [52, 62, 72],
            );
        }
    }
    let belt = (height - 0.5).max(0.05);
    for left in [0.04, width - 0.28] {
        end.rect(left, belt, 0.24, 0.15, lamps);
    }
    end.rect(
        width / 2.0 - 0.27,
        height - 0.34,
        0.54,
        0.13,
        [236, 236, 230],
    );
    paint_lettering(
        &mut end,
        [width / 2.0 - 0.23, height - 0.32],
        [0.46, 0.09],
        [20, 20, 24],
        6,
        &mut dice,
    );
    end.rect(0.0, height - 0.17, width, 0.17, shaded(colour, 0.45));
    end
}

//! The walls and roofs of a house: its front floor by floor, and the dirt of years.

use super::ground_floor::{paint_ground_floor, paint_shop};
use super::paint::{Painting, shaded};
use super::random::{Dice, fractal, lattice, noise};
use super::style::{HouseStyle, Material};
use super::window::{WindowSize, paint_window, window_share};

/// Paints the front of a house `width` metres wide at `scale` texels per metre.
pub(super) fn paint_front(style: &HouseStyle, width: f32, scale: f32, seed: u64) -> Painting {
    let height = style.height();
    let mut front = Painting::new(width, height, scale);
    let mut dice = Dice::new(&[seed, 1]);
    paint_wall(
        &mut front,
        style.material,
        style.wall,
        [width, height],
        seed,
    );
    if style.material == Material::Timber {
        paint_timber(&mut front, style, width, &mut dice);
    }
    let bay = dice.real(2.1..3.1);
    let bays = ((width - 0.8) / bay).floor().max(1.0) as usize;
    let left = (width - bays as f32 * bay) / 2.0;
    // One column in three carries balconies, the same on every floor.
    let balcony_bay = dice.whole(0..3);
    let window = WindowSize {
        width: bay * window_share(style.window) * dice.real(0.85..1.1),
        height: dice.real(1.4..1.9),
    };
    for floor in 0..style.floors {
        let top = height - style.ground_height - (floor + 1) as f32 * style.floor_height + 0.55;
        if dice.chance(0.35) {
            let line = top + style.floor_height - 0.62;
            front.rect(0.0, line, width, 0.12, shaded(style.trim, 0.92));
            front.tint(0.0, line + 0.12, width, 0.08, [0, 0, 0], 0.3);
        }
        for column in 0..bays {
            let x = left + column as f32 * bay + (bay - window.width) / 2.0;
            let balcony = style.balconies && column % 3 == balcony_bay;
            paint_window(&mut front, style, [x, top], window, balcony, &mut dice);
        }
    }
    if style.cornice {
        paint_cornice(&mut front, style.trim, width);
    }
    let ground = height - style.ground_height;
    if style.shop {
        paint_shop(&mut front, style, width, ground, &mut dice);
    } else {
        paint_ground_floor(&mut front, style, width, ground, [left, bay], &mut dice);
    }
    if dice.chance(0.7) {
        let x = dice.pick(&[0.12, width - 0.2]);
        front.rect(x, 0.3, 0.1, height - 0.4, shaded(style.trim, 0.55));
        front.tint(x + 0.1, 0.3, 0.07, height - 0.4, [0, 0, 0], 0.25);
    }
    weather(&mut front, height, seed);
    front
}

/// A moulding along the top of a front, with teeth below it.
fn paint_cornice(front: &mut Painting, colour: [u8; 3], width: f32) {
    front.rect(0.0, 0.0, width, 0.38, colour);
    front.rect(0.0, 0.26, width, 0.12, shaded(colour, 0.75));
    front.tint(0.0, 0.38, width, 0.25, [0, 0, 0], 0.28);
    let teeth = (width / 0.5) as usize;
    for i in 0..teeth {
        let left = i as f32 * 0.5 + 0.1;
        front.rect(left, 0.38, 0.18, 0.14, shaded(colour, 0.85));
    }
}

/// Paints a windowless side wall.
pub(super) fn paint_side(style: &HouseStyle, depth: f32, scale: f32, seed: u64) -> Painting {
    let height = style.height();
    let mut side = Painting::new(depth, height, scale);
    paint_wall(
        &mut side,
        style.material,
        shaded(style.wall, 0.9),
        [depth, height],
        seed ^ 0x51de,
    );
    weather(&mut side, height, seed ^ 0x51de);
    side
}

/// Paints roof tiles.
pub(super) fn paint_roof(
    style: &HouseStyle,
    width: f32,
    depth: f32,
    scale: f32,
    seed: u64,
) -> Painting {
    let mut roof = Painting::new(width, depth, scale);
    roof.rect(0.0, 0.0, width, depth, style.roof);
    let mut dice = Dice::new(&[seed, 2]);
    for _ in 0..dice.whole(0..4) {
        let x = dice.real(0.8..(width - 2.0).max(0.9));
        roof.rect(x - 0.1, depth * 0.3, 1.1, depth * 0.4, [60, 60, 62]);
        roof.gradient(
            x,
            depth * 0.33,
            0.9,
            depth * 0.33,
            [150, 170, 190],
            [70, 84, 100],
        );
    }
    roof.modulate(|x, y| {
        let row = (y / 0.3).floor();
        let tile = lattice(seed, ((x + row * 0.13) / 0.25).floor() as i32, row as i32);
        let edge = if (y / 0.3).fract() > 0.8 { 0.72 } else { 1.0 };
        (0.82 + 0.3 * tile) * edge * (0.8 + 0.4 * fractal(seed, x * 0.7, y * 0.7, 3))
    });
    roof
}

fn paint_wall(
    wall: &mut Painting,
    material: Material,
    colour: [u8; 3],
    [width, height]: [f32; 2],
    seed: u64,
) {
    wall.rect(0.0, 0.0, width, height, colour);
    wall.modulate(|x, y| {
        let grain = 0.9 + 0.2 * fractal(seed, x * 1.1, y * 1.1, 4);
        grain
            * match material {
                Material::Brick => courses(seed, x, y, [0.26, 0.1], 0.3, 1.3),
                Material::Stone => courses(seed, x, y, [0.75, 0.4], 0.14, 0.75),
                Material::Plaster | Material::Timber => {
                    0.94 + 0.12 * noise(seed ^ 9, x * 14.0, y * 14.0)
                }
                Material::Panel => courses(seed, x, y, [1.6, 1.1], 0.05, 0.7),
            }
    });
}

/// Blocks in courses, every other one shifted by half, with joints.
fn courses(seed: u64, x: f32, y: f32, [long, high]: [f32; 2], spread: f32, joint: f32) -> f32 {
    let row = (y / high).floor();
    let along = x / long + if row as i32 % 2 == 0 { 0.0 } else { 0.5 };
    let block = 1.0 - spread / 2.0 + spread * lattice(seed, along.floor() as i32, row as i32);
    let in_joint = along.fract() * long < 0.025 || (y / high).fract() * high < 0.02;
    if in_joint { joint } else { block }
}

fn paint_timber(front: &mut Painting, style: &HouseStyle, width: f32, dice: &mut Dice) {
    let beam = dice.pick(&[[74, 50, 38], [58, 44, 40], [96, 62, 44]]);
    let upper = style.height() - style.ground_height;
    let posts = (width / 1.3).round().max(2.0);
    let spacing = width / posts;
    for floor in 0..=style.floors {
        front.rect(
            0.0,
            upper - floor as f32 * style.floor_height - 0.1,
            width,
            0.2,
            beam,
        );
    }
    for post in 0..=posts as usize {
        let x = post as f32 * spacing;
        front.rect(x - 0.08, 0.3, 0.16, upper - 0.3, beam);
        for floor in 0..style.floors {
            if post < posts as usize && dice.chance(0.45) {
                let bottom = upper - floor as f32 * style.floor_height;
                let (from, to) = if dice.chance(0.5) {
                    (x, x + spacing)
                } else {
                    (x + spacing, x)
                };
                front.line(
                    &[[from, bottom], [to, bottom - style.floor_height]],
                    0.13,
                    beam,
                );
            }
        }
    }
}

/// Runs of water, soot towards the ground, uneven light.
fn weather(front: &mut Painting, height: f32, seed: u64) {
    front.modulate(|x, y| {
        let streaks = fractal(seed ^ 0x57e4, x * 5.0, y * 0.25, 3);
        let soot = 1.0
            - 0.22
                * ((y - height + 1.4) / 1.4).clamp(0.0, 1.0)
                * fractal(seed ^ 0x5007, x * 2.0, y * 2.0, 2)
                * 1.6;
        (0.86 + 0.24 * streaks) * soot
    });
}

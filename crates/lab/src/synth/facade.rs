//! A house front: wall, windows floor by floor, doors, shops, signs, and the dirt of years.

use super::paint::{Painting, shaded};
use super::random::{Dice, fractal, lattice, noise};
use super::style::{HouseStyle, Material, WindowKind};

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
        front.rect(0.0, 0.0, width, 0.38, style.trim);
        front.rect(0.0, 0.26, width, 0.12, shaded(style.trim, 0.75));
        front.tint(0.0, 0.38, width, 0.25, [0, 0, 0], 0.28);
        let teeth = (width / 0.5) as usize;
        (0..teeth).for_each(|i| {
            front.rect(
                i as f32 * 0.5 + 0.1,
                0.38,
                0.18,
                0.14,
                shaded(style.trim, 0.85),
            )
        });
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

#[derive(Clone, Copy)]
struct WindowSize {
    width: f32,
    height: f32,
}

fn window_share(kind: WindowKind) -> f32 {
    match kind {
        WindowKind::Band => 0.8,
        WindowKind::Plain => 0.5,
        WindowKind::Cross | WindowKind::Arched => 0.46,
        WindowKind::Sash => 0.42,
    }
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

fn paint_window(
    front: &mut Painting,
    style: &HouseStyle,
    [x, y]: [f32; 2],
    size: WindowSize,
    balcony: bool,
    dice: &mut Dice,
) {
    let WindowSize { width, mut height } = size;
    if balcony {
        height += 0.5;
    }
    let (centre, frame) = (x + width / 2.0, 0.09);
    let surround = shaded(style.trim, 0.95);
    if style.window == WindowKind::Arched {
        front.ellipse(
            [centre, y],
            [width / 2.0 + frame, width / 2.0 + frame],
            surround,
            1.0,
        );
    }
    front.rect(
        x - frame,
        y - frame,
        width + 2.0 * frame,
        height + 2.0 * frame,
        surround,
    );
    paint_glass(front, [x, y], [width, height], dice);
    if style.window == WindowKind::Arched {
        front.ellipse([centre, y], [width / 2.0, width / 2.0], [62, 74, 88], 1.0);
        front.rect(x, y - 0.03, width, 0.06, style.trim);
    }
    paint_bars(front, style, [x, y], [width, height]);
    // The reveal throws a shadow on the glass, the sill one on the wall.
    front.tint(x, y, width, 0.16, [0, 0, 0], 0.45);
    front.tint(x, y, 0.08, height, [0, 0, 0], 0.3);
    front.rect(
        x - 0.15,
        y + height,
        width + 0.3,
        0.1,
        shaded(style.trim, 1.05),
    );
    front.tint(
        x - 0.15,
        y + height + 0.1,
        width + 0.3,
        0.12,
        [0, 0, 0],
        0.35,
    );
    if style.shutters {
        let leaf = width * 0.45;
        for left in [x - leaf - 0.1, x + width + 0.1] {
            if dice.chance(0.92) {
                front.rect(left, y, leaf, height, style.accent);
                let slats = (height / 0.12) as usize;
                (0..slats).for_each(|i| {
                    front.tint(left, y + i as f32 * 0.12, leaf, 0.04, [0, 0, 0], 0.28)
                });
            }
        }
    }
    if balcony {
        paint_balcony(
            front,
            style,
            [x - 0.5, y + height - 0.95],
            width + 1.0,
            dice,
        );
    } else if dice.chance(0.16) {
        paint_flower_box(front, [x, y + height - 0.12], width, dice);
    }
}

fn paint_glass(front: &mut Painting, [x, y]: [f32; 2], [width, height]: [f32; 2], dice: &mut Dice) {
    let sky = dice.vary([120, 142, 164], 14.0);
    front.gradient(x, y, width, height, sky, dice.vary([46, 52, 60], 8.0));
    // What stands behind the glass: blinds, curtains, or nothing.
    match dice.whole(0..5) {
        0 => {
            let drawn = height * dice.real(0.2..0.9);
            let blind = dice.vary([206, 200, 186], 10.0);
            front.rect(x, y, width, drawn, blind);
            (0..(drawn / 0.12) as usize)
                .for_each(|i| front.tint(x, y + i as f32 * 0.12, width, 0.03, [0, 0, 0], 0.2));
        }
        1 | 2 => {
            let curtain = dice.vary([222, 214, 200], 12.0);
            let share = width * dice.real(0.14..0.3);
            for left in [x, x + width - share] {
                front.tint(left, y, share, height, curtain, 0.75);
                front.tint(left + share * 0.4, y, share * 0.12, height, [0, 0, 0], 0.2);
            }
        }
        _ => {}
    }
    // A slanted reflection.
    let slant = x + width * dice.real(0.1..0.6);
    let end = (slant + width * 0.3).min(x + width);
    front.polygon(
        &[
            [slant, y],
            [end, y],
            [end - width * 0.1, y + height * 0.6],
            [slant - width * 0.05, y + height * 0.6],
        ],
        shaded(sky, 1.12),
    );
    if dice.chance(0.45) {
        front.glow(x, y, width, height, dice.real(0.35..1.0));
    }
}

fn paint_bars(
    front: &mut Painting,
    style: &HouseStyle,
    [x, y]: [f32; 2],
    [width, height]: [f32; 2],
) {
    let bar = 0.06;
    let mut upright = |share: f32, top: f32, length: f32| {
        front.rect(x + width * share - bar / 2.0, top, bar, length, style.trim);
    };
    match style.window {
        WindowKind::Plain => {}
        WindowKind::Cross | WindowKind::Arched => upright(0.5, y, height),
        WindowKind::Sash => [1.0 / 3.0, 2.0 / 3.0]
            .into_iter()
            .for_each(|share| upright(share, y, height / 2.0)),
        WindowKind::Band => [0.25, 0.5, 0.75]
            .into_iter()
            .for_each(|share| upright(share, y, height)),
    }
    match style.window {
        WindowKind::Cross | WindowKind::Arched => {
            front.rect(x, y + height * 0.33, width, bar, style.trim)
        }
        WindowKind::Sash => {
            front.rect(x, y + height * 0.5 - 0.04, width, 0.08, style.trim);
            front.rect(x, y + height * 0.25, width, bar * 0.7, style.trim);
        }
        WindowKind::Plain | WindowKind::Band => {}
    }
}

fn paint_balcony(
    front: &mut Painting,
    style: &HouseStyle,
    [x, y]: [f32; 2],
    width: f32,
    dice: &mut Dice,
) {
    front.tint(x, y + 1.05, width, 0.45, [0, 0, 0], 0.4);
    front.rect(x, y + 0.93, width, 0.16, shaded(style.trim, 0.85));
    let rail = dice.pick(&[[44, 44, 48], [200, 198, 192], [70, 60, 54]]);
    if dice.chance(0.35) {
        front.rect(x, y, width, 0.93, style.accent);
    } else {
        (0..=(width / 0.13) as usize)
            .for_each(|i| front.rect(x + i as f32 * 0.13, y, 0.035, 0.95, rail));
    }
    front.rect(x, y, width, 0.07, rail);
    if dice.chance(0.4) {
        paint_flower_box(front, [x, y + 0.1], width, dice);
    }
}

fn paint_flower_box(front: &mut Painting, [x, y]: [f32; 2], width: f32, dice: &mut Dice) {
    front.rect(x, y, width, 0.18, [110, 74, 52]);
    for _ in 0..(width * 14.0) as usize {
        let leaf = dice.pick(&[
            [60, 104, 48],
            [84, 126, 60],
            [200, 60, 70],
            [226, 170, 60],
            [214, 120, 170],
        ]);
        let at = [x + dice.real(0.0..1.0) * width, y - dice.real(-0.05..0.16)];
        front.ellipse(at, [0.07, 0.06], leaf, 1.0);
    }
}

fn paint_ground_floor(
    front: &mut Painting,
    style: &HouseStyle,
    width: f32,
    ground: f32,
    [left, bay]: [f32; 2],
    dice: &mut Dice,
) {
    let plinth = shaded(style.wall, 0.62);
    front.rect(0.0, ground + style.ground_height - 0.6, width, 0.6, plinth);
    let bays = ((width - 2.0 * left) / bay).round().max(1.0) as usize;
    let door_bay = dice.whole(0..bays);
    for column in 0..bays {
        let x = left + column as f32 * bay;
        if column == door_bay {
            paint_door(
                front,
                style,
                x + bay / 2.0 - 0.55,
                ground + style.ground_height - 2.55,
                dice,
            );
        } else {
            let size = WindowSize {
                width: bay * 0.5,
                height: 1.5,
            };
            paint_window(
                front,
                style,
                [x + bay * 0.25, ground + 0.8],
                size,
                false,
                dice,
            );
        }
    }
}

fn paint_door(front: &mut Painting, style: &HouseStyle, x: f32, y: f32, dice: &mut Dice) {
    let (width, height) = (1.1, 2.45);
    front.rect(x - 0.18, y - 0.45, width + 0.36, height + 0.45, style.trim);
    front.gradient(x, y - 0.35, width, 0.32, [126, 146, 164], [60, 70, 84]);
    front.glow(x, y - 0.35, width, 0.32, 0.8);
    let painted = if dice.chance(0.6) {
        style.accent
    } else {
        [96, 66, 46]
    };
    let leaf = dice.vary(painted, 10.0);
    front.rect(x, y, width, height, leaf);
    let panels = dice.whole(1..4);
    let tall = (height - 0.3) / panels as f32;
    for i in 0..panels {
        let top = y + 0.15 + i as f32 * tall;
        for left in [x + 0.12, x + width / 2.0 + 0.06] {
            front.rect(
                left,
                top,
                width / 2.0 - 0.18,
                tall - 0.15,
                shaded(leaf, 0.76),
            );
        }
    }
    front.ellipse(
        [x + width - 0.12, y + height * 0.55],
        [0.05, 0.05],
        [224, 196, 110],
        1.0,
    );
    front.rect(x - 0.3, y + height, width + 0.6, 0.12, [150, 146, 140]);
    // House number, bell plate.
    front.rect(x + width + 0.28, y + 0.6, 0.3, 0.22, [30, 50, 110]);
    paint_lettering(
        front,
        [x + width + 0.31, y + 0.63],
        [0.24, 0.16],
        [240, 240, 240],
        2,
        dice,
    );
    front.rect(x - 0.42, y + 1.1, 0.16, 0.3, [180, 170, 140]);
}

fn paint_shop(front: &mut Painting, style: &HouseStyle, width: f32, ground: f32, dice: &mut Dice) {
    let surround = dice.pick(&[
        [50, 48, 50],
        [196, 190, 180],
        [96, 74, 58],
        shaded(style.accent, 0.6),
    ]);
    front.rect(
        0.1,
        ground + 0.1,
        width - 0.2,
        style.ground_height - 0.1,
        surround,
    );
    // Show windows with goods, and one door.
    let panes = dice.whole(2..5);
    let span = (width - 0.6) / panes as f32;
    let door = dice.whole(0..panes);
    for pane in 0..panes {
        let (x, top) = (0.3 + pane as f32 * span + 0.06, ground + 1.05);
        let foot = if pane == door { 0.06 } else { 0.55 };
        let height = style.ground_height - 1.05 - foot;
        let dark = dice.vary([58, 60, 62], 12.0);
        front.gradient(
            x,
            top,
            span - 0.12,
            height,
            dice.vary([130, 140, 150], 16.0),
            dark,
        );
        front.glow(x, top, span - 0.12, height, 0.9);
        if pane == door {
            front.rect(x, top, 0.08, height, surround);
            front.rect(x + span - 0.2, top, 0.08, height, surround);
            front.rect(
                x + span * 0.7,
                top + height * 0.5,
                0.05,
                0.35,
                [210, 206, 196],
            );
        } else {
            paint_goods(front, [x + 0.1, top + height], [span - 0.32, height], dice);
        }
        if dice.chance(0.3) {
            let (w, h) = (dice.real(0.3..0.7), dice.real(0.3..0.8));
            front.rect(x + 0.12, top + 0.3, w, h, dice.vary([220, 200, 150], 40.0));
            paint_lettering(
                front,
                [x + 0.16, top + 0.4],
                [w - 0.08, h * 0.25],
                [40, 40, 60],
                3,
                dice,
            );
        }
    }
    // The fascia with the name.
    front.rect(0.1, ground + 0.1, width - 0.2, 0.8, style.accent);
    front.tint(0.1, ground + 0.84, width - 0.2, 0.12, [0, 0, 0], 0.4);
    let letters = dice.whole(5..11);
    let (long, ink) = (
        letters as f32 * 0.48,
        dice.pick(&[[250, 246, 230], [250, 220, 120], [30, 30, 34]]),
    );
    let start = if dice.chance(0.5) {
        (width - long) / 2.0
    } else {
        0.5
    };
    paint_lettering(
        front,
        [start.max(0.2), ground + 0.24],
        [long.min(width - 0.5), 0.5],
        ink,
        letters,
        dice,
    );
    front.glow(0.1, ground + 0.1, width - 0.2, 0.8, 0.35);
}

fn paint_goods(
    front: &mut Painting,
    [left, bottom]: [f32; 2],
    [width, height]: [f32; 2],
    dice: &mut Dice,
) {
    for _ in 0..dice.whole(4..12) {
        let colour = dice.vary([150, 120, 100], 60.0);
        let (w, h) = (dice.real(0.12..0.4), dice.real(0.15..0.5) * height);
        let x = left + dice.real(0.0..1.0) * (width - w).max(0.01);
        if dice.chance(0.3) {
            front.ellipse([x + w / 2.0, bottom - h], [w / 2.0, w / 2.0], colour, 1.0);
        } else {
            front.rect(x, bottom - h, w, h, colour);
        }
    }
}

/// `count` invented letters: strokes between the nine points of a small grid, so that no two signs
/// read alike.
pub(super) fn paint_lettering(
    front: &mut Painting,
    [x, y]: [f32; 2],
    [width, height]: [f32; 2],
    ink: [u8; 3],
    count: usize,
    dice: &mut Dice,
) {
    let cell = width / count as f32;
    for letter in 0..count {
        let left = x + letter as f32 * cell + cell * 0.12;
        let point = |dice: &mut Dice| {
            [
                left + dice.whole(0..3) as f32 * cell * 0.36,
                y + dice.whole(0..3) as f32 * height / 2.0,
            ]
        };
        front.rect(left, y, cell * 0.16, height, ink);
        for _ in 0..dice.whole(2..4) {
            let (from, to) = (point(dice), point(dice));
            front.line(&[from, to], cell * 0.16, ink);
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

//! Windows with all that belongs to them.

use super::paint::{Painting, shaded};
use super::random::Dice;
use super::style::{HouseStyle, WindowKind};

/// Size of a window in metres.
#[derive(Clone, Copy)]
pub(super) struct WindowSize {
    pub(super) width: f32,
    pub(super) height: f32,
}

/// Share of a bay that a window takes.
pub(super) fn window_share(kind: WindowKind) -> f32 {
    match kind {
        WindowKind::Band => 0.8,
        WindowKind::Plain => 0.5,
        WindowKind::Cross | WindowKind::Arched => 0.46,
        WindowKind::Sash => 0.42,
    }
}

/// A window with its surround, sill, shutters, and a balcony or a flower box.
pub(super) fn paint_window(
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
    paint_surround(front, style, [x, y], [width, height]);
    paint_glass(front, [x, y], [width, height], dice);
    if style.window == WindowKind::Arched {
        let centre = x + width / 2.0;
        front.ellipse([centre, y], [width / 2.0, width / 2.0], [62, 74, 88], 1.0);
        front.rect(x, y - 0.03, width, 0.06, style.trim);
    }
    paint_bars(front, style, [x, y], [width, height]);
    paint_sill(front, style, [x, y], [width, height]);
    if style.shutters {
        paint_shutters(front, style, [x, y], [width, height], dice);
    }
    if balcony {
        let corner = [x - 0.5, y + height - 0.95];
        paint_balcony(front, style, corner, width + 1.0, dice);
    } else if dice.chance(0.16) {
        paint_flower_box(front, [x, y + height - 0.12], width, dice);
    }
}

/// The frame in the wall, round above where the window is arched.
fn paint_surround(
    front: &mut Painting,
    style: &HouseStyle,
    [x, y]: [f32; 2],
    [width, height]: [f32; 2],
) {
    let frame = 0.09;
    let colour = shaded(style.trim, 0.95);
    if style.window == WindowKind::Arched {
        let centre = [x + width / 2.0, y];
        let radius = width / 2.0 + frame;
        front.ellipse(centre, [radius, radius], colour, 1.0);
    }
    let outer = [width + 2.0 * frame, height + 2.0 * frame];
    front.rect(x - frame, y - frame, outer[0], outer[1], colour);
}

/// The sill, and the shadows: of the reveal on the glass, of the sill on the wall.
fn paint_sill(
    front: &mut Painting,
    style: &HouseStyle,
    [x, y]: [f32; 2],
    [width, height]: [f32; 2],
) {
    const BLACK: [u8; 3] = [0, 0, 0];
    front.tint(x, y, width, 0.16, BLACK, 0.45);
    front.tint(x, y, 0.08, height, BLACK, 0.3);
    let sill = shaded(style.trim, 1.05);
    front.rect(x - 0.15, y + height, width + 0.3, 0.1, sill);
    front.tint(x - 0.15, y + height + 0.1, width + 0.3, 0.12, BLACK, 0.35);
}

/// Open shutters on both sides; some have gone.
fn paint_shutters(
    front: &mut Painting,
    style: &HouseStyle,
    [x, y]: [f32; 2],
    [width, height]: [f32; 2],
    dice: &mut Dice,
) {
    let leaf = width * 0.45;
    for left in [x - leaf - 0.1, x + width + 0.1] {
        if !dice.chance(0.92) {
            continue;
        }
        front.rect(left, y, leaf, height, style.accent);
        let slats = (height / 0.12) as usize;
        for i in 0..slats {
            front.tint(left, y + i as f32 * 0.12, leaf, 0.04, [0, 0, 0], 0.28);
        }
    }
}

/// The glass, what stands behind it, and a reflection.
fn paint_glass(front: &mut Painting, [x, y]: [f32; 2], [width, height]: [f32; 2], dice: &mut Dice) {
    let sky = dice.vary([120, 142, 164], 14.0);
    front.gradient(x, y, width, height, sky, dice.vary([46, 52, 60], 8.0));
    // What stands behind the glass: blinds, curtains, or nothing.
    match dice.whole(0..5) {
        0 => {
            let drawn = height * dice.real(0.2..0.9);
            let blind = dice.vary([206, 200, 186], 10.0);
            front.rect(x, y, width, drawn, blind);
            for i in 0..(drawn / 0.12) as usize {
                front.tint(x, y + i as f32 * 0.12, width, 0.03, [0, 0, 0], 0.2);
            }
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

/// The glazing bars of the window's kind.
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
        WindowKind::Sash => {
            for share in [1.0 / 3.0, 2.0 / 3.0] {
                upright(share, y, height / 2.0);
            }
        }
        WindowKind::Band => {
            for share in [0.25, 0.5, 0.75] {
                upright(share, y, height);
            }
        }
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

/// A balcony with its rail, under a window.
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
        for i in 0..=(width / 0.13) as usize {
            front.rect(x + i as f32 * 0.13, y, 0.035, 0.95, rail);
        }
    }
    front.rect(x, y, width, 0.07, rail);
    if dice.chance(0.4) {
        paint_flower_box(front, [x, y + 0.1], width, dice);
    }
}

/// A box of flowers.
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

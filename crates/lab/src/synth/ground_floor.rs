//! Ground floors: doors, windows, shops.

use super::lettering::paint_lettering;
use super::paint::{Painting, shaded};
use super::random::Dice;
use super::style::HouseStyle;
use super::window::{WindowSize, paint_window};

/// A ground floor of windows and one door.
pub(super) fn paint_ground_floor(
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

/// A house door with its surround, number and bell plate.
fn paint_door(front: &mut Painting, style: &HouseStyle, x: f32, y: f32, dice: &mut Dice) {
    let width = 1.1;
    let height = 2.45;
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

/// Show windows with goods, one door, and the name above.
pub(super) fn paint_shop(
    front: &mut Painting,
    style: &HouseStyle,
    width: f32,
    ground: f32,
    dice: &mut Dice,
) {
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
    let panes = dice.whole(2..5);
    let span = (width - 0.6) / panes as f32;
    let door = dice.whole(0..panes);
    for pane in 0..panes {
        let foot = if pane == door { 0.06 } else { 0.55 };
        let corner = [0.3 + pane as f32 * span + 0.06, ground + 1.05];
        let size = [span, style.ground_height - 1.05 - foot];
        paint_pane(
            front,
            corner,
            size,
            (pane == door).then_some(surround),
            dice,
        );
    }
    paint_fascia(front, style, width, ground, dice);
}

/// One pane of a shop, in a bay `span` metres wide: a door with `frame`, or a window with goods.
fn paint_pane(
    front: &mut Painting,
    [x, top]: [f32; 2],
    [span, height]: [f32; 2],
    frame: Option<[u8; 3]>,
    dice: &mut Dice,
) {
    let dark = dice.vary([58, 60, 62], 12.0);
    let bright = dice.vary([130, 140, 150], 16.0);
    front.gradient(x, top, span - 0.12, height, bright, dark);
    front.glow(x, top, span - 0.12, height, 0.9);
    if let Some(frame) = frame {
        front.rect(x, top, 0.08, height, frame);
        front.rect(x + span - 0.2, top, 0.08, height, frame);
        let handle = [x + span * 0.7, top + height * 0.5];
        front.rect(handle[0], handle[1], 0.05, 0.35, [210, 206, 196]);
    } else {
        paint_goods(front, [x + 0.1, top + height], [span - 0.32, height], dice);
    }
    if dice.chance(0.3) {
        let w = dice.real(0.3..0.7);
        let h = dice.real(0.3..0.8);
        let paper = dice.vary([220, 200, 150], 40.0);
        front.rect(x + 0.12, top + 0.3, w, h, paper);
        let corner = [x + 0.16, top + 0.4];
        let size = [w - 0.08, h * 0.25];
        paint_lettering(front, corner, size, [40, 40, 60], 3, dice);
    }
}

/// The board above the panes with the name of the shop.
fn paint_fascia(
    front: &mut Painting,
    style: &HouseStyle,
    width: f32,
    ground: f32,
    dice: &mut Dice,
) {
    front.rect(0.1, ground + 0.1, width - 0.2, 0.8, style.accent);
    front.tint(0.1, ground + 0.84, width - 0.2, 0.12, [0, 0, 0], 0.4);
    let letters = dice.whole(5..11);
    let long = letters as f32 * 0.48;
    let ink = dice.pick(&[[250, 246, 230], [250, 220, 120], [30, 30, 34]]);
    let start = if dice.chance(0.5) {
        (width - long) / 2.0
    } else {
        0.5
    };
    let corner = [start.max(0.2), ground + 0.24];
    let size = [long.min(width - 0.5), 0.5];
    paint_lettering(front, corner, size, ink, letters, dice);
    front.glow(0.1, ground + 0.1, width - 0.2, 0.8, 0.35);
}

/// Boxes and balls in a show window.
fn paint_goods(
    front: &mut Painting,
    [left, bottom]: [f32; 2],
    [width, height]: [f32; 2],
    dice: &mut Dice,
) {
    for _ in 0..dice.whole(4..12) {
        let colour = dice.vary([150, 120, 100], 60.0);
        let w = dice.real(0.12..0.4);
        let h = dice.real(0.15..0.5) * height;
        let x = left + dice.real(0.0..1.0) * (width - w).max(0.01);
        if dice.chance(0.3) {
            front.ellipse([x + w / 2.0, bottom - h], [w / 2.0, w / 2.0], colour, 1.0);
        } else {
            front.rect(x, bottom - h, w, h, colour);
        }
    }
}

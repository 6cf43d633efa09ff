//! Invented letters for signs and number plates.

use super::paint::Painting;
use super::random::Dice;

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
            let from = point(dice);
            let to = point(dice);
            front.line(&[from, to], cell * 0.16, ink);
        }
    }
}

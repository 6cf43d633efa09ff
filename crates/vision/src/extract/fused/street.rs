//! A synthetic picture of a street, from which the int8 statistics are measured.
//!
//! It has what photographs of streets have in common: sky, road, houses with windows, and a few
//! things in front of them. Everything random is drawn from one fixed seed, so every machine draws
//! the same picture.

use placeformer_core::types::{ImageSize, ImageTensor};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// Draws the street, normalised as photographs are.
pub(super) fn draw(size: ImageSize) -> ImageTensor {
    let width = size.width as usize;
    let height = size.height as usize;
    let horizon = height * 3 / 5;
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut picture = ImageTensor {
        size,
        data: vec![0.0; 3 * width * height],
    };

    fill(&mut picture, 0..width, 0..horizon, [0.3, 1.0, 1.9]);
    fill(&mut picture, 0..width, horizon..height, [-0.6, -0.5, -0.3]);
    let mut left = 0;
    while left < width {
        left = draw_house(&mut picture, &mut random, left, horizon);
    }
    for _ in 0..6 {
        draw_obstacle(&mut picture, &mut random, horizon);
    }
    for value in &mut picture.data {
        *value += random.random_range(-0.2..0.2);
    }
    picture
}

/// Draws a house with rows of windows from column `left` on, and returns the column where it ends.
fn draw_house(
    picture: &mut ImageTensor,
    random: &mut ChaCha8Rng,
    left: usize,
    horizon: usize,
) -> usize {
    let width = picture.size.width as usize;
    let height = picture.size.height as usize;
    let right = (left + random.random_range(width / 7..width / 3)).min(width);
    let top = random.random_range(height / 10..height / 3);
    let colour: [f32; 3] = std::array::from_fn(|_| random.random_range(-1.0..1.2));
    let bottom = horizon + random.random_range(0..height / 12);
    fill(picture, left..right, top..bottom, colour);

    let across = random.random_range(12..26);
    let down = random.random_range(14..30);
    for y in (top + 6..horizon.saturating_sub(down)).step_by(down) {
        for x in (left + 4..right.saturating_sub(across)).step_by(across) {
            let dark = random.random_range(-1.6..-0.6);
            let columns = x..x + across * 3 / 5;
            let rows = y..y + down * 3 / 5;
            fill(picture, columns, rows, [dark; 3]);
        }
    }
    right
}

/// Draws a thing in front of the houses, such as a car or a lamp post.
fn draw_obstacle(picture: &mut ImageTensor, random: &mut ChaCha8Rng, horizon: usize) {
    let width = picture.size.width as usize;
    let height = picture.size.height as usize;
    let left = random.random_range(0..width);
    let right = (left + random.random_range(3..40)).min(width);
    let top = horizon - random.random_range(5..height / 3);
    let bottom = horizon + random.random_range(5..height / 4);
    let colour = std::array::from_fn(|_| random.random_range(-2.0..2.2));
    fill(picture, left..right, top..bottom, colour);
}

/// Paints a rectangle in one colour.
fn fill(picture: &mut ImageTensor, columns: Range<usize>, rows: Range<usize>, colour: [f32; 3]) {
    let width = picture.size.width as usize;
    let height = picture.size.height as usize;
    let planes = picture.data.chunks_exact_mut(width * height);
    for (plane, value) in planes.zip(colour) {
        let lines = plane.chunks_exact_mut(width);
        for line in lines.take(rows.end).skip(rows.start) {
            line[columns.clone()].fill(value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn the_street_fills_pictures_of_every_patch_size() {
        for side in [14, 16, 32] {
            let size = ImageSize {
                width: 16 * side,
                height: 12 * side,
            };
            let picture = draw(size);
            assert_eq!(picture.data.len(), 3 * (size.width * size.height) as usize);
            assert!(picture.data.iter().all(|value| value.abs() < 2.5));
            let patches: HashSet<u32> = picture
                .data
                .chunks_exact(side as usize)
                .map(|row| row[0].to_bits())
                .collect();
            assert!(patches.len() > 1000, "only {} different", patches.len());
        }
    }
}

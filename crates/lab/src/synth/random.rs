//! Randomness that depends on nothing but seeds: dice for choices, value noise for surfaces.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// Folds `parts` into one seed; every order and every value gives another.
pub(super) fn seed_of(parts: &[u64]) -> u64 {
    parts.iter().fold(0x9e37_79b9_7f4a_7c15, |state, part| {
        scramble(state ^ part.wrapping_mul(0xd6e8_feb8_6659_fd93))
    })
}

/// The finaliser of SplitMix64.
fn scramble(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// A seeded source of choices.
pub(super) struct Dice(ChaCha8Rng);

impl Dice {
    pub(super) fn new(parts: &[u64]) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed_of(parts)))
    }

    pub(super) fn real(&mut self, range: Range<f32>) -> f32 {
        self.0.random_range(range)
    }

    /// From `range.start` up to but without `range.end`.
    pub(super) fn whole(&mut self, range: Range<usize>) -> usize {
        self.0.random_range(range)
    }

    pub(super) fn chance(&mut self, probability: f32) -> bool {
        self.real(0.0..1.0) < probability
    }

    /// One of `choices`, which must not be empty.
    pub(super) fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.whole(0..choices.len())]
    }

    /// `colour` with each channel moved by up to `spread` and all together by up to twice that.
    pub(super) fn vary(&mut self, colour: [u8; 3], spread: f32) -> [u8; 3] {
        let together = self.real(-2.0..2.0) * spread;
        colour.map(|channel| {
            (f32::from(channel) + together + self.real(-1.0..1.0) * spread).clamp(0.0, 255.0) as u8
        })
    }
}

/// Uniform in 0..1 at an integer point. Asked for millions of times a picture, so 32 bits and two
/// multiplications.
pub(super) fn lattice(seed: u64, x: i32, y: i32) -> f32 {
    let mut h = (seed as u32) ^ ((seed >> 32) as u32).rotate_left(13);
    h ^= (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77).rotate_left(7);
    h = (h ^ (h >> 16)).wrapping_mul(0x7feb_352d);
    h = (h ^ (h >> 15)).wrapping_mul(0x846c_a68b);
    ((h ^ (h >> 16)) >> 8) as f32 / (1u32 << 24) as f32
}

/// Smooth noise in 0..1 with features about one unit wide.
pub(super) fn noise(seed: u64, x: f32, y: f32) -> f32 {
    let left = x.floor();
    let top = y.floor();
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let fx = ease(x - left);
    let fy = ease(y - top);
    let at = |dx: i32, dy: i32| lattice(seed, left as i32 + dx, top as i32 + dy);
    let upper = at(0, 0) + (at(1, 0) - at(0, 0)) * fx;
    let lower = at(0, 1) + (at(1, 1) - at(0, 1)) * fx;
    upper + (lower - upper) * fy
}

/// `octaves` layers of [`noise`], each half as wide and half as strong as the one before; in 0..1.
pub(super) fn fractal(seed: u64, x: f32, y: f32, octaves: u32) -> f32 {
    let mut sum = 0.0;
    let mut weight = 1.0;
    let mut total = 0.0;
    let mut zoom = 1.0;
    for octave in 0..octaves {
        sum += weight * noise(seed.wrapping_add(u64::from(octave)), x * zoom, y * zoom);
        total += weight;
        weight *= 0.5;
        zoom *= 2.03;
    }
    sum / total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_differ_by_order_and_value() {
        let seeds = [
            seed_of(&[1, 2]),
            seed_of(&[2, 1]),
            seed_of(&[1, 2, 0]),
            seed_of(&[1]),
        ];
        assert!((0..4).all(|i| (0..i).all(|j| seeds[i] != seeds[j])));
    }

    #[test]
    fn lattice_values_are_spread_evenly_and_neighbours_are_strangers() {
        let values: Vec<f32> = (0..100)
            .flat_map(|y| (0..100).map(move |x| lattice(3, x - 50, y - 50)))
            .collect();
        let mean = values.iter().sum::<f32>() / 1e4;
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
        for step in [1, 100] {
            let pairs = values.iter().zip(&values[step..]);
            let correlation = pairs.map(|(a, b)| (a - 0.5) * (b - 0.5)).sum::<f32>() / 1e4 * 12.0;
            assert!(correlation.abs() < 0.05, "step {step}: {correlation}");
        }
    }

    #[test]
    fn noise_is_smooth_and_bounded() {
        for i in 0..2000 {
            let x = i as f32 * 0.173 - 100.0;
            let y = i as f32 * 0.091 - 50.0;
            let here = fractal(7, x, y, 4);
            assert!((0.0..=1.0).contains(&here));
            assert!((here - fractal(7, x + 1e-3, y, 4)).abs() < 0.02);
        }
    }
}

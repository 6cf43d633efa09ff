//! Random numbers and pictures for tests: the same seed gives the same ones everywhere.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// `count` values between `-spread` and `spread`.
pub fn values(random: &mut ChaCha8Rng, count: usize, spread: f32) -> Vec<f32> {
    (0..count)
        .map(|_| random.random_range(-spread..spread))
        .collect()
}

/// `count` bytes drawn from `seed`.
pub fn bytes(seed: u64, count: usize) -> Vec<u8> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    (0..count).map(|_| random.random()).collect()
}

/// A PNG of `width` by `height` pixels that no other seed gives.
pub fn png(seed: u64, width: u32, height: u32) -> Vec<u8> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let pixels = image::RgbImage::from_fn(width, height, |_, _| image::Rgb(random.random()));
    let mut bytes = std::io::Cursor::new(Vec::new());
    pixels
        .write_to(&mut bytes, image::ImageFormat::Png)
        .unwrap();
    bytes.into_inner()
}

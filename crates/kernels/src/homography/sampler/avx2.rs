//! The loops compiled for AVX2.

use super::{CHUNK, scalar};

/// See [`scalar::draw`].
#[target_feature(enable = "avx2")]
pub(super) fn draw(
    counter: u64,
    points: u16,
    positions: &mut [u64; CHUNK],
    distinct: &mut [u64; CHUNK],
) {
    scalar::draw(counter, points, positions, distinct);
}

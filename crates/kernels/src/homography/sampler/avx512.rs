//! The loops compiled for AVX-512, of which DQ has products of 64-bit words.

use super::{CHUNK, scalar};

/// See [`scalar::draw`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn draw(
    counter: u64,
    points: u16,
    positions: &mut [u64; CHUNK],
    distinct: &mut [u64; CHUNK],
) {
    scalar::draw(counter, points, positions, distinct);
}

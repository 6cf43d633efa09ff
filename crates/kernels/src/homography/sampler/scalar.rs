//! The loops over successive numbers, written so that the compiler can use vectors; the other
//! modules compile them for their instruction sets.

use super::{CHUNK, STEP, mix};

/// Draws four positions below `points` from each of the next numbers of the generator, which become
/// the four 16-bit fields of `positions`. `distinct` receives 1 where all four differ, else 0.
#[inline(always)]
pub(super) fn draw(
    counter: u64,
    points: u16,
    positions: &mut [u64; CHUNK],
    distinct: &mut [u64; CHUNK],
) {
    for (i, four) in (1u64..).zip(positions.iter_mut()) {
        *four = mix(counter.wrapping_add(STEP.wrapping_mul(i)));
    }
    // On a big-endian machine the fields of a number lie in memory in the reverse order. It does
    // not matter to the loop over all fields, and the second conversion undoes the first.
    for four in positions.iter_mut() {
        *four = four.to_le();
    }
    for field in bytemuck::cast_slice_mut::<u64, u16>(positions) {
        *field = ((u32::from(*field) * u32::from(points)) >> 16) as u16;
    }
    for four in positions.iter_mut() {
        *four = u64::from_le(*four);
    }
    for (distinct, &four) in distinct.iter_mut().zip(positions.iter()) {
        *distinct = u64::from(are_distinct(four));
    }
}

/// Whether the four 16-bit fields of a number differ from each other.
#[inline(always)]
fn are_distinct(four: u64) -> bool {
    // Rotated by one and by two fields, every pair of fields meets in some place, where their
    // exclusive or is zero if they are equal.
    let equal = zero_fields(four ^ four.rotate_left(16)) | zero_fields(four ^ four.rotate_left(32));
    equal == 0
}

/// Not zero if and only if some 16-bit field of `word` is zero.
///
/// Subtracting one from each field sets the top bit of a field that was zero. A borrow may then
/// wrongly mark the fields above it, which is harmless, as one mark is enough.
#[inline(always)]
fn zero_fields(word: u64) -> u64 {
    word.wrapping_sub(0x0001_0001_0001_0001) & !word & 0x8000_8000_8000_8000
}

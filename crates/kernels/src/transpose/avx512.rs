//! AVX-512: squares of sixteen by sixteen words in registers.
//!
//! Transposing a square of side 2d means exchanging the upper right quarter with the lower left
//! one, then transposing all four quarters in the same way. The four rounds, with d = 8, 4, 2 and
//! 1, exchange the quarters of all squares of side 2d at once, by pairs of rows d apart.

use super::SourceBlock;
use super::scalar::transpose_row;
use crate::registers::{first, first_mut};
use std::arch::x86_64::*;

/// Side of the square that is transposed in registers.
const SIDE: usize = 16;

/// For the rounds with d = 8, 4, 2, 1: which elements of a pair of rows the upper row takes, and
/// which the lower row.
const EXCHANGES: [[[u32; SIDE]; 2]; 4] = [
    [exchange(8, false), exchange(8, true)],
    [exchange(4, false), exchange(4, true)],
    [exchange(2, false), exchange(2, true)],
    [exchange(1, false), exchange(1, true)],
];

/// Which elements of two rows that are `distance` apart one of them takes. Elements are numbered
/// through both rows, the lower row's from [`SIDE`] on. In every block of twice the distance, the
/// upper row keeps its first half and takes the lower row's first half behind it; the lower row
/// takes the upper row's second half and keeps its own.
const fn exchange(distance: usize, lower: bool) -> [u32; SIDE] {
    let mut elements = [0; SIDE];
    let mut lane = 0;
    while lane < SIDE {
        let from_lower = lane & distance != 0;
        let element = if from_lower == lower {
            lane
        } else if lower {
            lane + distance
        } else {
            lane - distance
        };
        elements[lane] = (element + if from_lower { SIDE } else { 0 }) as u32;
        lane += 1;
    }
    elements
}

/// See [`super::transpose`].
#[target_feature(enable = "avx512f")]
pub(super) fn transpose(source: SourceBlock<'_>, out: &mut [u32], out_stride: usize) {
    let SourceBlock {
        words,
        stride,
        rows,
        columns,
    } = source;
    let whole_rows = rows / SIDE * SIDE;
    let whole_columns = columns / SIDE * SIDE;
    for row in (0..whole_rows).step_by(SIDE) {
        for column in (0..whole_columns).step_by(SIDE) {
            let square = &words[row * stride + column..];
            let place = &mut out[column * out_stride + row..];
            transpose_square(square, stride, place, out_stride);
        }
    }
    for row in 0..rows {
        let first = if row < whole_rows { whole_columns } else { 0 };
        transpose_row(&source, row, first..columns, out, out_stride);
    }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn transpose_square(source: &[u32], stride: usize, out: &mut [u32], out_stride: usize) {
    let mut rows = [_mm512_setzero_si512(); SIDE];
    for (number, row) in rows.iter_mut().enumerate() {
        *row = load(first(&source[number * stride..]));
    }
    for (round, [upper_elements, lower_elements]) in EXCHANGES.iter().enumerate() {
        let distance = 8 >> round;
        let upper_elements = load(upper_elements);
        let lower_elements = load(lower_elements);
        for upper in (0..SIDE).filter(|row| row & distance == 0) {
            let a = rows[upper];
            let b = rows[upper + distance];
            rows[upper] = _mm512_permutex2var_epi32(a, upper_elements, b);
            rows[upper + distance] = _mm512_permutex2var_epi32(a, lower_elements, b);
        }
    }
    for (number, row) in rows.into_iter().enumerate() {
        store(row, first_mut(&mut out[number * out_stride..]));
    }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load(words: &[u32; SIDE]) -> __m512i {
    // SAFETY: the array holds the 64 bytes read, at any address.
    unsafe { _mm512_loadu_si512(words.as_ptr().cast()) }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn store(row: __m512i, words: &mut [u32; SIDE]) {
    // SAFETY: the array has room for the 64 bytes written, at any address.
    unsafe { _mm512_storeu_si512(words.as_mut_ptr().cast(), row) }
}

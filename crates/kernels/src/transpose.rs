//! Words transposed: what is a row for one product is a column of a panel for the next.

use super::Simd;
use super::gemm::covers;
#[cfg(target_arch = "x86_64")]
use super::simd::SimdLevel;
#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// Side of the square that AVX-512 transposes in registers.
#[cfg(target_arch = "x86_64")]
const SIDE: usize = 16;

/// `out[column * out_stride + row] = source[row * stride + column]` for `(rows, columns)` words.
///
/// # Panics
/// If a slice is too short.
pub(super) fn transpose(
    simd: Simd,
    (source, stride): (&[u32], usize),
    (rows, columns): (usize, usize),
    out: &mut [u32],
    out_stride: usize,
) {
    if rows == 0 || columns == 0 {
        return;
    }
    assert!(
        covers(source.len(), rows, stride, columns),
        "source too short"
    );
    assert!(
        covers(out.len(), columns, out_stride, rows),
        "result too short"
    );
    let (whole_rows, whole_columns) =
        transpose_squares(simd, (source, stride), (rows, columns), out, out_stride);
    for row in 0..rows {
        let first = if row < whole_rows { whole_columns } else { 0 };
        for column in first..columns {
            out[column * out_stride + row] = source[row * stride + column];
        }
    }
}

/// As much of it as is done in registers: so many rows and columns from the first on.
fn transpose_squares(
    simd: Simd,
    (source, stride): (&[u32], usize),
    (rows, columns): (usize, usize),
    out: &mut [u32],
    out_stride: usize,
) -> (usize, usize) {
    #[cfg(target_arch = "x86_64")]
    if simd.level() >= SimdLevel::Avx512 {
        let (rows, columns) = (rows / SIDE * SIDE, columns / SIDE * SIDE);
        for row in (0..rows).step_by(SIDE) {
            for column in (0..columns).step_by(SIDE) {
                let (from, to) = (
                    &source[row * stride + column..],
                    &mut out[column * out_stride + row..],
                );
                // SAFETY: the token proves the level; the square lies inside what `transpose` has
                // checked.
                unsafe { transpose_square(from.as_ptr(), stride, to.as_mut_ptr(), out_stride) };
            }
        }
        return (rows, columns);
    }
    let _ = (simd, source, stride, rows, columns, out, out_stride);
    (0, 0)
}

/// Which lanes of two rows, `distance` apart, the upper and the lower of them take: each keeps its
/// half of every block of twice that width and gets the other's.
#[cfg(target_arch = "x86_64")]
const fn exchange(distance: usize, lower: bool) -> [u32; SIDE] {
    let mut lanes = [0; SIDE];
    let mut lane = 0;
    while lane < SIDE {
        let of_lower = lane & distance != 0;
        let from = if of_lower == lower {
            lane
        } else if lower {
            lane + distance
        } else {
            lane - distance
        };
        lanes[lane] = (from + if of_lower { SIDE } else { 0 }) as u32;
        lane += 1;
    }
    lanes
}

/// # Safety
/// The CPU has AVX-512; pointers are valid for sixteen rows of sixteen words.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn transpose_square(source: *const u32, stride: usize, out: *mut u32, out_stride: usize) {
    const EXCHANGES: [[[u32; SIDE]; 2]; 4] = [
        [exchange(8, false), exchange(8, true)],
        [exchange(4, false), exchange(4, true)],
        [exchange(2, false), exchange(2, true)],
        [exchange(1, false), exchange(1, true)],
    ];
    // SAFETY: the caller's; the tables are as long as a vector.
    unsafe {
        let mut rows: [__m512i; SIDE] =
            std::array::from_fn(|row| _mm512_loadu_si512(source.add(row * stride).cast()));
        for (round, lanes) in EXCHANGES.iter().enumerate() {
            let distance = 8 >> round;
            let [of_upper, of_lower] = lanes.map(|lanes| _mm512_loadu_si512(lanes.as_ptr().cast()));
            for upper in (0..SIDE).filter(|row| row & distance == 0) {
                let (a, b) = (rows[upper], rows[upper + distance]);
                rows[upper] = _mm512_permutex2var_epi32(a, of_upper, b);
                rows[upper + distance] = _mm512_permutex2var_epi32(a, of_lower, b);
            }
        }
        for (row, words) in rows.into_iter().enumerate() {
            _mm512_storeu_si512(out.add(row * out_stride).cast(), words);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_level_puts_every_word_where_it_belongs_and_touches_no_other(
            rows in 0usize..40, columns in 0usize..40, spare in 0usize..5
        ) {
            let (stride, out_stride) = (columns + spare, rows + spare);
            let source: Vec<u32> = (0..rows * stride).map(|at| at as u32).collect();
            for simd in Simd::all() {
                let mut out = vec![u32::MAX; columns * out_stride];
                transpose(simd, (&source, stride), (rows, columns), &mut out, out_stride);
                for (at, &word) in out.iter().enumerate() {
                    let (column, row) = (at / out_stride, at % out_stride);
                    let expected = if row < rows { (row * stride + column) as u32 } else { u32::MAX };
                    prop_assert_eq!(word, expected, "level {}, row {}, column {}", simd.level(), row, column);
                }
            }
        }
    }
}

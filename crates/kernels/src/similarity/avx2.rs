//! AVX2: tiles of 6 rows by 16 columns, products by `vpmaddwd` on codes widened to i16.
//!
//! `vpmaddubsw` would take twice the products per instruction, but it saturates, so that exactness
//! costs back a sign transfer and a second widening multiplication; per exact product both need the
//! same slots of the multiplier ports.

use super::driver::{self, Level};
use super::{BlockMaxima, Blocks, Line, PackedColumns, Quantised, SECTIONS, Scratch};
use crate::lanes;
use std::arch::x86_64::*;

/// Columns of a panel: two vectors.
const PANEL: usize = 16;
/// Rows of a tile: 6 x 2 accumulators, two column vectors, a row value and a product fill the 16
/// registers.
const TILE: usize = 6;
/// Rows of a tile where fewer than [`TILE`] are left.
const STEP: usize = 2;

/// Lays columns out in panels: line `k` holds values `2k` and `2k + 1` of 16 columns.
pub(super) fn pack(packed: &mut PackedColumns, columns: Quantised<'_>) {
    let dim = columns.dim;
    let depth = dim.div_ceil(2);
    packed.pack_factors(columns, PANEL);
    packed.pairs.clear();
    packed
        .pairs
        .resize(packed.factors.len() / PANEL * depth, Line([0; 32]));
    let mut panel_base = 0;
    for section in 0..SECTIONS {
        for local in 0..columns.counts[section] {
            let codes = &columns.codes[(columns.start(section) + local) * dim..][..dim];
            let lines = &mut packed.pairs[(panel_base + local / PANEL) * depth..][..depth];
            for (line, pair) in lines.iter_mut().zip(codes.chunks(2)) {
                for (slot, &code) in line.0[local % PANEL * 2..].iter_mut().zip(pair) {
                    *slot = i16::from(code);
                }
            }
        }
        panel_base += columns.counts[section].div_ceil(PANEL);
    }
}

/// Widens the rows to i16, each padded to an even length.
#[target_feature(enable = "avx2")]
fn widen(rows: Quantised<'_>, scratch: &mut Scratch) {
    scratch.wide.clear();
    if rows.dim.is_multiple_of(2) {
        scratch
            .wide
            .extend(rows.codes.iter().map(|&code| i16::from(code)));
    } else {
        for row in rows.codes.chunks_exact(rows.dim) {
            scratch.wide.extend(row.iter().map(|&code| i16::from(code)));
            scratch.wide.push(0);
        }
    }
}

/// See [`super::block_maxima`], which has checked the lengths.
#[target_feature(enable = "avx2")]
pub(super) fn block_maxima(
    columns: &PackedColumns,
    rows: Quantised<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    // SAFETY: this function has the level's instructions.
    unsafe { driver::block_maxima::<Avx2, TILE, STEP>(columns, rows, wanted, scratch, out) }
}

struct Avx2;

impl Level for Avx2 {
    type Code = i16;
    type Line = Line<i16, 32>;
    type Floats = lanes::Avx2;
    type Integers = __m256i;

    #[inline(always)]
    unsafe fn lay_out(rows: Quantised<'_>, scratch: &mut Scratch) {
        // SAFETY: the caller vouches for AVX2.
        unsafe { widen(rows, scratch) }
    }

    #[inline(always)]
    fn rows<'a>(_: Quantised<'a>, scratch: &'a Scratch) -> &'a [i16] {
        &scratch.wide
    }

    #[inline(always)]
    fn lines(columns: &PackedColumns) -> &[Self::Line] {
        &columns.pairs
    }

    #[inline(always)]
    fn lines_per_panel(dim: usize) -> usize {
        dim.div_ceil(2)
    }

    #[inline(always)]
    unsafe fn start(_: &Scratch, _: usize) -> __m256i {
        // SAFETY: the caller vouches for AVX2.
        unsafe { _mm256_setzero_si256() }
    }

    #[inline(always)]
    unsafe fn add_products<const ROWS: usize, const VECTORS: usize>(
        rows: *const i16,
        panel: &[Self::Line],
        sums: &mut [[__m256i; VECTORS]; ROWS],
    ) {
        const { assert!(ROWS <= TILE && VECTORS <= 2) };
        let stride = 2 * panel.len();
        for (k, line) in panel.iter().enumerate() {
            // SAFETY: a line holds 64 bytes; row `r` has values up to `stride`, and 2k + 1 <
            // stride.
            unsafe {
                let columns = line.0.as_ptr().cast::<__m256i>();
                // Written out: with a loop over rows the compiler keeps the sums in memory.
                macro_rules! rows {
                    ($($r:literal)*) => {$(
                        if $r < ROWS {
                            let pair = _mm256_set1_epi32(rows.add($r * stride + 2 * k).cast::<i32>().read_unaligned());
                            for vector in 0..VECTORS {
                                let column = _mm256_load_si256(columns.add(vector));
                                sums[$r][vector] = _mm256_add_epi32(sums[$r][vector], _mm256_madd_epi16(pair, column));
                            }
                        }
                    )*};
                }
                rows!(0 1 2 3 4 5);
            }
        }
    }

    #[inline(always)]
    unsafe fn to_floats(sums: __m256i) -> lanes::Avx2 {
        // SAFETY: the caller vouches for AVX2.
        lanes::Avx2(unsafe { _mm256_cvtepi32_ps(sums) })
    }

    #[inline(always)]
    unsafe fn splat_index(index: i32) -> __m256i {
        // SAFETY: the caller vouches for AVX2.
        unsafe { _mm256_set1_epi32(index) }
    }

    #[inline(always)]
    unsafe fn indices_from(first: i32) -> __m256i {
        // SAFETY: the caller vouches for AVX2.
        unsafe {
            _mm256_add_epi32(
                _mm256_set1_epi32(first),
                _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7),
            )
        }
    }

    #[inline(always)]
    unsafe fn load_indices(from: *const i32) -> __m256i {
        // SAFETY: the caller vouches for AVX2 and eight elements.
        unsafe { _mm256_loadu_si256(from.cast()) }
    }

    #[inline(always)]
    unsafe fn store_indices(to: *mut i32, indices: __m256i) {
        // SAFETY: the caller vouches for AVX2 and eight elements.
        unsafe { _mm256_storeu_si256(to.cast(), indices) }
    }

    #[inline(always)]
    unsafe fn challenge(
        value: &mut lanes::Avx2,
        index: &mut __m256i,
        new_value: lanes::Avx2,
        new_index: __m256i,
    ) {
        // SAFETY: the caller vouches for AVX2.
        unsafe {
            let better = _mm256_cmp_ps::<_CMP_GT_OQ>(new_value.0, value.0);
            // Of (new, held) `max` gives the second when the first is NaN.
            value.0 = _mm256_max_ps(new_value.0, value.0);
            *index = _mm256_blendv_epi8(*index, new_index, _mm256_castps_si256(better));
        }
    }
}

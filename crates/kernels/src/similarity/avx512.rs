//! AVX-512 VNNI: tiles of 12 rows by 32 columns, products by `vpdpbusd`.
//!
//! The instruction multiplies unsigned by signed bytes, so columns are offset by 128, once for all
//! candidates, and sums start at -128 times that of a row's codes. Written on a CPU without it:
//! [`super::check`] must pass before this level is used.

use super::driver::{self, Level};
use super::{BlockMaxima, Blocks, Line, PackedColumns, Quantised, SECTIONS, Scratch};
use crate::lanes;
use std::arch::x86_64::*;

/// Columns of a panel: two vectors.
const PANEL: usize = 32;
/// Rows of a tile: 12 x 2 accumulators of the 32 registers.
const TILE: usize = 12;
/// Rows of a tile where fewer than [`TILE`] are left.
const STEP: usize = 4;
const LANES: usize = 16;

/// What makes a signed code an unsigned one: added, or as the highest bit turned around.
const OFFSET: u8 = 128;

/// Lays columns out in panels: lines `2k` and `2k + 1` hold values `4k..4k + 4` of the first and
/// last 16 columns.
pub(super) fn pack(packed: &mut PackedColumns, columns: Quantised<'_>) {
    let dim = columns.dim;
    let depth = dim.div_ceil(4);
    packed.pack_factors(columns, PANEL);
    packed.quads.clear();
    packed
        .quads
        .resize(packed.factors.len() / PANEL * depth * 2, Line([OFFSET; 64]));
    let mut panel_base = 0;
    for section in 0..SECTIONS {
        for local in 0..columns.counts[section] {
            let codes = &columns.codes[(columns.start(section) + local) * dim..][..dim];
            let (panel, column) = (panel_base + local / PANEL, local % PANEL);
            let lines = &mut packed.quads[panel * depth * 2..][..depth * 2];
            for (pair, quad) in lines.chunks_exact_mut(2).zip(codes.chunks(4)) {
                for (slot, &code) in pair[column / LANES].0[column % LANES * 4..]
                    .iter_mut()
                    .zip(quad)
                {
                    *slot = code as u8 ^ OFFSET;
                }
            }
        }
        panel_base += columns.counts[section].div_ceil(PANEL);
    }
}

/// Sums of the rows, from which follows what the offset of the columns adds to a product; and the
/// rows padded to whole fours, if need be.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
fn lay_out(rows: Quantised<'_>, scratch: &mut Scratch) {
    scratch.starts.clear();
    scratch.starts.extend(
        rows.codes
            .chunks_exact(rows.dim)
            .map(|row| -i32::from(OFFSET) * sum(row)),
    );
    scratch.padded.clear();
    if !rows.dim.is_multiple_of(4) {
        for row in rows.codes.chunks_exact(rows.dim) {
            scratch.padded.extend_from_slice(row);
            scratch
                .padded
                .resize(scratch.padded.len().next_multiple_of(4), 0);
        }
    }
}

/// The sum of a row's codes: its product with ones.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
fn sum(row: &[i8]) -> i32 {
    let (whole, rest) = row.as_chunks::<64>();
    let ones = _mm512_set1_epi8(1);
    let add = |sums, codes: &[i8; 64]| {
        // SAFETY: the array holds 64 bytes, and this function has the instructions.
        unsafe { _mm512_dpbusd_epi32(sums, ones, _mm512_loadu_si512(codes.as_ptr().cast())) }
    };
    _mm512_reduce_add_epi32(whole.iter().fold(_mm512_setzero_si512(), add))
        + rest.iter().map(|&code| i32::from(code)).sum::<i32>()
}

/// See [`super::block_maxima`], which has checked the lengths.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
pub(super) fn block_maxima(
    columns: &PackedColumns,
    rows: Quantised<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    // SAFETY: this function has the level's instructions.
    unsafe { driver::block_maxima::<Avx512, TILE, STEP>(columns, rows, wanted, scratch, out) }
}

struct Avx512;

impl Level for Avx512 {
    type Code = i8;
    type Line = Line<u8, 64>;
    type Floats = lanes::Avx512;
    type Integers = __m512i;

    #[inline(always)]
    unsafe fn lay_out(rows: Quantised<'_>, scratch: &mut Scratch) {
        // SAFETY: the caller vouches for AVX-512.
        unsafe { lay_out(rows, scratch) }
    }

    #[inline(always)]
    fn rows<'a>(rows: Quantised<'a>, scratch: &'a Scratch) -> &'a [i8] {
        if rows.dim.is_multiple_of(4) {
            rows.codes
        } else {
            &scratch.padded
        }
    }

    #[inline(always)]
    fn lines(columns: &PackedColumns) -> &[Self::Line] {
        &columns.quads
    }

    #[inline(always)]
    fn lines_per_panel(dim: usize) -> usize {
        dim.div_ceil(4) * 2
    }

    #[inline(always)]
    unsafe fn start(scratch: &Scratch, row: usize) -> __m512i {
        // SAFETY: the caller vouches for AVX-512.
        unsafe { _mm512_set1_epi32(scratch.starts[row]) }
    }

    #[inline(always)]
    unsafe fn add_products<const ROWS: usize, const VECTORS: usize>(
        rows: *const i8,
        panel: &[Self::Line],
        sums: &mut [[__m512i; VECTORS]; ROWS],
    ) {
        const { assert!(ROWS <= TILE && VECTORS <= 2) };
        let stride = 2 * panel.len();
        for (k, lines) in panel.chunks_exact(2).enumerate() {
            // SAFETY: a line holds 64 bytes; row `r` has bytes up to `stride`, and 4k + 3 < stride.
            unsafe {
                // Written out: with a loop over rows the compiler keeps the sums in memory.
                macro_rules! rows {
                    ($($r:literal)*) => {$(
                        if $r < ROWS {
                            let quad = _mm512_set1_epi32(rows.add($r * stride + 4 * k).cast::<i32>().read_unaligned());
                            for vector in 0..VECTORS {
                                let column = _mm512_load_si512(lines[vector].0.as_ptr().cast());
                                sums[$r][vector] = _mm512_dpbusd_epi32(sums[$r][vector], column, quad);
                            }
                        }
                    )*};
                }
                rows!(0 1 2 3 4 5 6 7 8 9 10 11);
            }
        }
    }

    #[inline(always)]
    unsafe fn to_floats(sums: __m512i) -> lanes::Avx512 {
        // SAFETY: the caller vouches for AVX-512.
        lanes::Avx512(unsafe { _mm512_cvtepi32_ps(sums) })
    }

    #[inline(always)]
    unsafe fn splat_index(index: i32) -> __m512i {
        // SAFETY: the caller vouches for AVX-512.
        unsafe { _mm512_set1_epi32(index) }
    }

    #[inline(always)]
    unsafe fn indices_from(first: i32) -> __m512i {
        // SAFETY: the caller vouches for AVX-512.
        unsafe {
            let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            _mm512_add_epi32(_mm512_set1_epi32(first), lane)
        }
    }

    #[inline(always)]
    unsafe fn load_indices(from: *const i32) -> __m512i {
        // SAFETY: the caller vouches for AVX-512 and sixteen elements.
        unsafe { _mm512_loadu_si512(from.cast()) }
    }

    #[inline(always)]
    unsafe fn store_indices(to: *mut i32, indices: __m512i) {
        // SAFETY: the caller vouches for AVX-512 and sixteen elements.
        unsafe { _mm512_storeu_si512(to.cast(), indices) }
    }

    #[inline(always)]
    unsafe fn challenge(
        value: &mut lanes::Avx512,
        index: &mut __m512i,
        new_value: lanes::Avx512,
        new_index: __m512i,
    ) {
        // SAFETY: the caller vouches for AVX-512.
        unsafe {
            let better = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(new_value.0, value.0);
            value.0 = _mm512_mask_mov_ps(value.0, better, new_value.0);
            *index = _mm512_mask_mov_epi32(*index, better, new_index);
        }
    }
}

//! AVX-512 VNNI: tiles of 12 rows by 32 columns, products by `vpdpbusd`.
//!
//! The instruction multiplies unsigned by signed bytes, so rows are offset by 128 and 128 times each column's sum is
//! taken off again. Written on a CPU without it: [`super::check`] must pass before this level is used.

use super::driver::{self, Level};
use super::{BlockMaxima, Blocks, Line, PackedColumns, Quantised, SECTIONS, Scratch};
use crate::kernels::lanes;
use std::arch::x86_64::*;

/// Columns of a panel: two vectors.
const PANEL: usize = 32;
/// Rows of a tile: 12 x 2 accumulators of the 32 registers.
const TILE: usize = 12;
const LANES: usize = 16;

/// Lays columns out in panels: lines `2k` and `2k + 1` hold values `4k..4k + 4` of the first and last 16 columns.
pub(super) fn pack(packed: &mut PackedColumns, columns: Quantised<'_>) {
    let dim = columns.dim;
    let depth = dim.div_ceil(4);
    packed.pack_factors(columns, PANEL);
    packed.quads.clear();
    packed.quads.resize(packed.factors.len() / PANEL * depth * 2, Line([0; 64]));
    packed.offsets.clear();
    packed.offsets.resize(packed.factors.len(), 0);
    let mut panel_base = 0;
    for section in 0..SECTIONS {
        for local in 0..columns.counts[section] {
            let codes = &columns.codes[(columns.start(section) + local) * dim..][..dim];
            let (panel, column) = (panel_base + local / PANEL, local % PANEL);
            let lines = &mut packed.quads[panel * depth * 2..][..depth * 2];
            for (pair, quad) in lines.chunks_exact_mut(2).zip(codes.chunks(4)) {
                pair[column / LANES].0[column % LANES * 4..][..quad.len()].copy_from_slice(quad);
            }
            packed.offsets[panel * PANEL + column] = 128 * codes.iter().map(|&code| i32::from(code)).sum::<i32>();
        }
        panel_base += columns.counts[section].div_ceil(PANEL);
    }
}

/// Offsets the rows by 128, each padded to a multiple of four values, sections padded to whole tiles.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn offset(rows: Quantised<'_>, scratch: &mut Scratch) {
    let stride = rows.dim.next_multiple_of(4);
    scratch.pad_factors(rows, TILE);
    scratch.offset.clear();
    for section in 0..SECTIONS {
        let start = rows.start(section);
        let codes = &rows.codes[start * rows.dim..(start + rows.counts[section]) * rows.dim];
        for row in codes.chunks_exact(rows.dim) {
            scratch.offset.extend(row.iter().map(|&code| code as u8 ^ 128));
            // Meets zeros of the columns, so that any value does.
            scratch.offset.resize(scratch.offset.len().next_multiple_of(stride), 128);
        }
        scratch.offset.resize(scratch.offset.len().next_multiple_of(TILE * stride), 128);
    }
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
    unsafe { driver::block_maxima::<Avx512, TILE>(columns, rows, wanted, scratch, out) }
}

struct Avx512;

impl Level<TILE> for Avx512 {
    type Code = u8;
    type Line = Line<i8, 64>;
    type Floats = lanes::Avx512;
    type Integers = __m512i;

    #[inline(always)]
    unsafe fn pad(rows: Quantised<'_>, scratch: &mut Scratch) {
        // SAFETY: the caller vouches for AVX-512.
        unsafe { offset(rows, scratch) }
    }

    #[inline(always)]
    fn padded(scratch: &Scratch) -> &[u8] {
        &scratch.offset
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
    unsafe fn excess(columns: &PackedColumns, panel: usize) -> [__m512i; 2] {
        let offsets = columns.offsets[panel * PANEL..][..PANEL].as_ptr();
        // SAFETY: the slice holds 32 values; the caller vouches for AVX-512.
        unsafe { [Self::load_indices(offsets), Self::load_indices(offsets.add(LANES))] }
    }

    #[inline(always)]
    unsafe fn products(rows: *const u8, stride: usize, panel: &[Self::Line]) -> [[__m512i; 2]; TILE] {
        // SAFETY: the caller vouches for AVX-512.
        let mut sums = unsafe { [[_mm512_setzero_si512(); 2]; TILE] };
        for (k, lines) in panel.chunks_exact(2).enumerate() {
            // SAFETY: a line holds 64 bytes; row `r` has bytes up to `stride`, and 4k + 3 < stride.
            unsafe {
                let left = _mm512_load_si512(lines[0].0.as_ptr().cast());
                let right = _mm512_load_si512(lines[1].0.as_ptr().cast());
                // Written out: with a loop over rows the compiler keeps the sums in memory.
                macro_rules! rows {
                    ($($r:literal)*) => {$(
                        let quad = _mm512_set1_epi32(rows.add($r * stride + 4 * k).cast::<i32>().read_unaligned());
                        sums[$r][0] = _mm512_dpbusd_epi32(sums[$r][0], quad, left);
                        sums[$r][1] = _mm512_dpbusd_epi32(sums[$r][1], quad, right);
                    )*};
                }
                rows!(0 1 2 3 4 5 6 7 8 9 10 11);
            }
        }
        sums
    }

    #[inline(always)]
    unsafe fn exact(products: __m512i, excess: __m512i) -> lanes::Avx512 {
        // SAFETY: the caller vouches for AVX-512.
        lanes::Avx512(unsafe { _mm512_cvtepi32_ps(_mm512_sub_epi32(products, excess)) })
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
    unsafe fn challenge(value: &mut lanes::Avx512, index: &mut __m512i, new_value: lanes::Avx512, new_index: __m512i) {
        // SAFETY: the caller vouches for AVX-512.
        unsafe {
            let better = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(new_value.0, value.0);
            value.0 = _mm512_mask_mov_ps(value.0, better, new_value.0);
            *index = _mm512_mask_mov_epi32(*index, better, new_index);
        }
    }
}

//! AVX-512 VNNI: tiles of 12 rows by 32 columns, products by `vpdpbusd`.
//!
//! The instruction multiplies unsigned with signed bytes. So the columns are increased by 128, once
//! for all candidates, and the sums of a row start at -128 times the sum of its codes.

use super::packed::{CacheLine, for_each_column};
use super::panels::{self, LaneBests, SimilarityIsa};
use super::{BlockMaxima, Blocks, Int8Descriptors, PackedColumns, Scratch};
use crate::registers::avx512::{Avx512Floats, Avx512Isa};
use crate::registers::{first, first_mut};
use std::arch::x86_64::*;

/// Columns of a panel: two vectors.
const PANEL: usize = 32;

/// Rows of a tile: 12 x 2 of the 32 registers hold sums.
const TILE: usize = 12;

/// Rows of a tile if fewer than [`TILE`] are left.
const STEP: usize = 4;

/// Columns of a vector.
const LANES: usize = 16;

/// Added to a signed code, which inverts its highest bit, it makes the code unsigned.
const OFFSET: u8 = 128;

/// See [`PackedColumns::pack`]: the two lines of group `k` of a panel hold the values `4k..4k + 4`
/// of the first and of the last 16 columns.
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) fn pack(packed: &mut PackedColumns, columns: Int8Descriptors<'_>) {
    packed.pack_factors(columns, PANEL);
    let groups = Avx512Isa::groups(columns.dim);
    let panels = packed.factors.len() / PANEL;
    packed.quads.clear();
    packed
        .quads
        .resize(panels * groups, [CacheLine([OFFSET; 64]); 2]);
    for_each_column(columns, PANEL, |panel, column, codes| {
        let lines = &mut packed.quads[panel * groups..][..groups];
        for (lines, quad) in lines.iter_mut().zip(codes.chunks(4)) {
            let places = &mut lines[column / LANES].0[column % LANES * 4..];
            for (place, &code) in places.iter_mut().zip(quad) {
                *place = code.cast_unsigned() ^ OFFSET;
            }
        }
    });
}

/// See [`super::block_maxima`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn block_maxima(
    columns: &PackedColumns,
    rows: Int8Descriptors<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    panels::block_maxima::<_, TILE, STEP>(Avx512Isa::new(), columns, rows, wanted, scratch, out);
}

impl SimilarityIsa for Avx512Isa {
    type RowGroup = [i8; 4];
    type PanelGroup = [CacheLine<u8, 64>; 2];
    type Integers = __m512i;

    /// Sums the codes of each row, and fills rows up with zeros to whole groups if they are not.
    #[inline(always)]
    fn lay_out(self, rows: Int8Descriptors<'_>, scratch: &mut Scratch) {
        // SAFETY: `self` proves that the CPU has AVX-512 with VNNI.
        unsafe { start_sums(rows, &mut scratch.starts) };
        scratch.quads.clear();
        if rows.dim.is_multiple_of(4) {
            return;
        }
        let groups = Self::groups(rows.dim);
        scratch.quads.resize(rows.len() * groups, [0; 4]);
        let places = scratch.quads.chunks_exact_mut(groups);
        for (row, quads) in rows.codes.chunks_exact(rows.dim).zip(places) {
            quads.as_flattened_mut()[..rows.dim].copy_from_slice(row);
        }
    }

    #[inline(always)]
    fn rows<'a>(rows: Int8Descriptors<'a>, scratch: &'a Scratch) -> &'a [[i8; 4]] {
        if rows.dim.is_multiple_of(4) {
            let (quads, _) = rows.codes.as_chunks();
            quads
        } else {
            &scratch.quads
        }
    }

    #[inline(always)]
    fn panels(columns: &PackedColumns) -> &[[CacheLine<u8, 64>; 2]] {
        &columns.quads
    }

    #[inline(always)]
    fn groups(dim: usize) -> usize {
        dim.div_ceil(4)
    }

    #[inline(always)]
    fn start(self, scratch: &Scratch, row: usize) -> __m512i {
        self.splat_index(scratch.starts[row])
    }

    #[inline(always)]
    fn broadcast(self, group: [i8; 4]) -> __m512i {
        self.splat_index(bytemuck::cast(group))
    }

    #[inline(always)]
    fn column(self, group: &[CacheLine<u8, 64>; 2], vector: usize) -> __m512i {
        let line = &group[vector];
        // SAFETY: the line holds the 64 bytes read and is aligned to as many; `self` proves that
        // the CPU has AVX-512.
        unsafe { _mm512_load_si512(line.0.as_ptr().cast()) }
    }

    #[inline(always)]
    fn add_products(self, sums: __m512i, columns: __m512i, row: __m512i) -> __m512i {
        // SAFETY: `self` proves that the CPU has AVX-512 VNNI.
        unsafe { _mm512_dpbusd_epi32(sums, columns, row) }
    }

    #[inline(always)]
    fn to_floats(self, sums: __m512i) -> Avx512Floats {
        // SAFETY: `self` proves that the CPU has AVX-512.
        Avx512Floats::new(self, unsafe { _mm512_cvtepi32_ps(sums) })
    }

    #[inline(always)]
    fn splat_index(self, index: i32) -> __m512i {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { _mm512_set1_epi32(index) }
    }

    #[inline(always)]
    fn indices_from(self, first: i32) -> __m512i {
        // SAFETY: `self` proves that the CPU has AVX-512.
        unsafe { indices_from(first) }
    }

    #[inline(always)]
    fn load_indices(self, from: &[i32]) -> __m512i {
        let from: &[i32; 16] = first(from);
        // SAFETY: the array holds the 64 bytes read, at any address; `self` proves that the CPU has
        // AVX-512.
        unsafe { _mm512_loadu_si512(from.as_ptr().cast()) }
    }

    #[inline(always)]
    fn store_indices(self, indices: __m512i, to: &mut [i32]) {
        let to: &mut [i32; 16] = first_mut(to);
        // SAFETY: the array has room for the 64 bytes written, at any address; `self` proves that
        // the CPU has AVX-512.
        unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), indices) }
    }

    #[inline(always)]
    fn better(self, current: LaneBests<Self>, challenger: LaneBests<Self>) -> LaneBests<Self> {
        let current_values = current.values.register();
        let values = challenger.values.register();
        // SAFETY: `self` proves that the CPU has AVX-512.
        let (values, indices) =
            unsafe { better(current_values, current.indices, values, challenger.indices) };
        LaneBests {
            values: Avx512Floats::new(self, values),
            indices,
        }
    }
}

/// What the sums of each row start from, so that the offset of the columns cancels out.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
fn start_sums(rows: Int8Descriptors<'_>, starts: &mut Vec<i32>) {
    starts.clear();
    for row in rows.codes.chunks_exact(rows.dim) {
        starts.push(-i32::from(OFFSET) * sum(row));
    }
}

/// The sum of a row's codes: its product with ones.
#[inline]
#[target_feature(enable = "avx512f,avx512vnni")]
fn sum(row: &[i8]) -> i32 {
    let (whole, rest) = row.as_chunks::<64>();
    let ones = _mm512_set1_epi8(1);
    let mut sums = _mm512_setzero_si512();
    for codes in whole {
        // SAFETY: the array holds the 64 bytes read, at any address.
        let codes = unsafe { _mm512_loadu_si512(codes.as_ptr().cast()) };
        sums = _mm512_dpbusd_epi32(sums, ones, codes);
    }
    let of_rest: i32 = rest.iter().map(|&code| i32::from(code)).sum();
    _mm512_reduce_add_epi32(sums) + of_rest
}

#[inline]
#[target_feature(enable = "avx512f")]
fn indices_from(first: i32) -> __m512i {
    let lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    _mm512_add_epi32(_mm512_set1_epi32(first), lanes)
}

#[inline]
#[target_feature(enable = "avx512f")]
fn better(
    current_values: __m512,
    current_indices: __m512i,
    values: __m512,
    indices: __m512i,
) -> (__m512, __m512i) {
    let is_better = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(values, current_values);
    let values = _mm512_mask_mov_ps(current_values, is_better, values);
    let indices = _mm512_mask_mov_epi32(current_indices, is_better, indices);
    (values, indices)
}

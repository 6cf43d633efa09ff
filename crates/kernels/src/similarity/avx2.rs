//! AVX2: tiles of 6 rows by 16 columns, products by `vpmaddwd` on codes widened to i16.
//!
//! `vpmaddubsw` would compute twice the products in one instruction, but it saturates, so that
//! exact sums would need a transfer of signs and a second multiplication; for each exact product
//! both ways take the same time on the multiplier ports.

use super::packed::{CacheLine, for_each_column};
use super::panels::{self, LaneBests, SimilarityIsa};
use super::{BlockMaxima, Blocks, Int8Descriptors, PackedColumns, Scratch};
use crate::registers::avx2::{Avx2Floats, Avx2Isa};
use crate::registers::{first, first_mut};
use std::arch::x86_64::*;

/// Columns of a panel: two vectors.
const PANEL: usize = 16;

/// Rows of a tile: 6 x 2 registers of sums, two of columns, one of a row's values and one of
/// products are all sixteen.
const TILE: usize = 6;

/// Rows of a tile if fewer than [`TILE`] are left.
const STEP: usize = 2;

/// See [`PackedColumns::pack`]: line `k` of a panel holds the values `2k` and `2k + 1` of 16
/// columns.
#[target_feature(enable = "avx2")]
pub(super) fn pack(packed: &mut PackedColumns, columns: Int8Descriptors<'_>) {
    packed.pack_factors(columns, PANEL);
    let groups = Avx2Isa::groups(columns.dim);
    let panels = packed.factors.len() / PANEL;
    packed.pairs.clear();
    packed.pairs.resize(panels * groups, CacheLine([0; 32]));
    for_each_column(columns, PANEL, |panel, column, codes| {
        let lines = &mut packed.pairs[panel * groups..][..groups];
        for (line, pair) in lines.iter_mut().zip(codes.chunks(2)) {
            for (place, &code) in line.0[column * 2..].iter_mut().zip(pair) {
                *place = i16::from(code);
            }
        }
    });
}

/// See [`super::block_maxima`].
#[target_feature(enable = "avx2,fma,popcnt")]
pub(super) fn block_maxima(
    columns: &PackedColumns,
    rows: Int8Descriptors<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    panels::block_maxima::<_, TILE, STEP>(Avx2Isa::new(), columns, rows, wanted, scratch, out);
}

impl SimilarityIsa for Avx2Isa {
    type RowGroup = [i16; 2];
    type PanelGroup = CacheLine<i16, 32>;
    type Integers = __m256i;

    /// Widens the rows to i16, each filled up with zero to an even length.
    #[inline(always)]
    fn lay_out(self, rows: Int8Descriptors<'_>, scratch: &mut Scratch) {
        let groups = Self::groups(rows.dim);
        scratch.pairs.clear();
        scratch.pairs.resize(rows.len() * groups, [0; 2]);
        let places = scratch.pairs.chunks_exact_mut(groups);
        for (row, pairs) in rows.codes.chunks_exact(rows.dim).zip(places) {
            for (place, &code) in pairs.as_flattened_mut().iter_mut().zip(row) {
                *place = i16::from(code);
            }
        }
    }

    #[inline(always)]
    fn rows<'a>(_: Int8Descriptors<'a>, scratch: &'a Scratch) -> &'a [[i16; 2]] {
        &scratch.pairs
    }

    #[inline(always)]
    fn panels(columns: &PackedColumns) -> &[CacheLine<i16, 32>] {
        &columns.pairs
    }

    #[inline(always)]
    fn groups(dim: usize) -> usize {
        dim.div_ceil(2)
    }

    #[inline(always)]
    fn start(self, _: &Scratch, _: usize) -> __m256i {
        self.splat_index(0)
    }

    #[inline(always)]
    fn broadcast(self, group: [i16; 2]) -> __m256i {
        self.splat_index(bytemuck::cast(group))
    }

    #[inline(always)]
    fn column(self, group: &CacheLine<i16, 32>, vector: usize) -> __m256i {
        let (vectors, _) = group.0.as_chunks::<16>();
        // SAFETY: the array holds the 32 bytes read, and it is half of a cache line, which the
        // instruction's alignment of 32 bytes divides; `self` proves that the CPU has AVX2.
        unsafe { _mm256_load_si256(vectors[vector].as_ptr().cast()) }
    }

    #[inline(always)]
    fn add_products(self, sums: __m256i, columns: __m256i, row: __m256i) -> __m256i {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { add_products(sums, columns, row) }
    }

    #[inline(always)]
    fn to_floats(self, sums: __m256i) -> Avx2Floats {
        // SAFETY: `self` proves that the CPU has AVX2.
        Avx2Floats::new(self, unsafe { _mm256_cvtepi32_ps(sums) })
    }

    #[inline(always)]
    fn splat_index(self, index: i32) -> __m256i {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { _mm256_set1_epi32(index) }
    }

    #[inline(always)]
    fn indices_from(self, first: i32) -> __m256i {
        // SAFETY: `self` proves that the CPU has AVX2.
        unsafe { indices_from(first) }
    }

    #[inline(always)]
    fn load_indices(self, from: &[i32]) -> __m256i {
        let from: &[i32; 8] = first(from);
        // SAFETY: the array holds the 32 bytes read, at any address; `self` proves that the CPU has
        // AVX2.
        unsafe { _mm256_loadu_si256(from.as_ptr().cast()) }
    }

    #[inline(always)]
    fn store_indices(self, indices: __m256i, to: &mut [i32]) {
        let to: &mut [i32; 8] = first_mut(to);
        // SAFETY: the array has room for the 32 bytes written, at any address; `self` proves that
        // the CPU has AVX2.
        unsafe { _mm256_storeu_si256(to.as_mut_ptr().cast(), indices) }
    }

    #[inline(always)]
    fn better(self, current: LaneBests<Self>, challenger: LaneBests<Self>) -> LaneBests<Self> {
        let current_values = current.values.register();
        let values = challenger.values.register();
        // SAFETY: `self` proves that the CPU has AVX2.
        let (values, indices) =
            unsafe { better(current_values, current.indices, values, challenger.indices) };
        LaneBests {
            values: Avx2Floats::new(self, values),
            indices,
        }
    }
}

#[inline]
#[target_feature(enable = "avx2")]
fn add_products(sums: __m256i, columns: __m256i, row: __m256i) -> __m256i {
    _mm256_add_epi32(sums, _mm256_madd_epi16(row, columns))
}

#[inline]
#[target_feature(enable = "avx2")]
fn indices_from(first: i32) -> __m256i {
    let lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
    _mm256_add_epi32(_mm256_set1_epi32(first), lanes)
}

#[inline]
#[target_feature(enable = "avx2")]
fn better(
    current_values: __m256,
    current_indices: __m256i,
    values: __m256,
    indices: __m256i,
) -> (__m256, __m256i) {
    let is_better = _mm256_castps_si256(_mm256_cmp_ps::<_CMP_GT_OQ>(values, current_values));
    // If the first operand is NaN, the maximum is the second.
    let values = _mm256_max_ps(values, current_values);
    let indices = _mm256_blendv_epi8(current_indices, indices, is_better);
    (values, indices)
}

//! AVX-512 VNNI: tiles of 12 rows by 32 columns, products by `vpdpbusd`.
//!
//! The instruction multiplies unsigned by signed bytes, so rows are offset by 128 and 128 times each column's sum is
//! taken off again. Written on a CPU without it: [`super::check`] must pass before this level is used.

use super::{Best, BlockMaxima, Blocks, Line, PackedColumns, Quantised, SECTIONS, Scratch};
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

/// Dot products of twelve offset rows, `stride` bytes apart, with the 32 columns of a panel.
///
/// # Safety
/// `rows` must point at `12 * stride` readable bytes, with `stride = 2 * panel.len()`.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
unsafe fn dots(rows: *const u8, stride: usize, panel: &[Line<i8, 64>]) -> [[__m512i; 2]; TILE] {
    let mut sums = [[_mm512_setzero_si512(); 2]; TILE];
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

/// Lane-wise running maximum with its index; on a tie or NaN what was held stays.
#[inline]
#[target_feature(enable = "avx512f")]
fn challenge(value: &mut __m512, index: &mut __m512i, new_value: __m512, new_index: __m512i) {
    let better = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(new_value, *value);
    *value = _mm512_mask_mov_ps(*value, better, new_value);
    *index = _mm512_mask_mov_epi32(*index, better, new_index);
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
    offset(rows, scratch);
    let lines = columns.dim.div_ceil(4) * 2;
    let (mut panel_base, mut column_base) = (0, 0);
    for column_section in 0..SECTIONS {
        let count = columns.counts[column_section];
        scratch.reset_lanes(LANES);
        for panel in 0..count.div_ceil(PANEL) {
            let panel_index = panel_base + panel;
            let view = Panel {
                lines: &columns.quads[panel_index * lines..][..lines],
                factors: &columns.factors[panel_index * PANEL..][..PANEL],
                offsets: &columns.offsets[panel_index * PANEL..][..PANEL],
                first_column: column_base + panel * PANEL,
                columns: PANEL.min(count - panel * PANEL),
            };
            let mut tile_base = 0;
            for row_section in 0..SECTIONS {
                let tiles = rows.counts[row_section].div_ceil(TILE);
                if wanted[row_section][column_section] {
                    let first_row = rows.start(row_section);
                    let bests = &mut out.columns[row_section][view.first_column..][..view.columns];
                    panel_maxima(&view, tile_base..tile_base + tiles, first_row, scratch, bests);
                }
                tile_base += tiles;
            }
        }
        collect_rows(rows, scratch, &mut out.rows[column_section]);
        panel_base += count.div_ceil(PANEL);
        column_base += count;
    }
}

/// Thirty-two columns, of which the first `columns` exist.
struct Panel<'a> {
    lines: &'a [Line<i8, 64>],
    factors: &'a [f32],
    offsets: &'a [i32],
    first_column: usize,
    columns: usize,
}

/// Runs one panel over the tiles of one section of rows; the first of those is row `first_row`.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
fn panel_maxima(
    panel: &Panel<'_>,
    tiles: std::ops::Range<usize>,
    first_row: usize,
    scratch: &mut Scratch,
    bests: &mut [Best],
) {
    let stride = panel.lines.len() * 2;
    let padded = tiles.start * TILE..tiles.end * TILE;
    let offset = &scratch.offset[padded.start * stride..padded.end * stride];
    let row_factors = &scratch.factors[padded.clone()];
    let lane_values = &mut scratch.lane_values[padded.start * LANES..padded.end * LANES];
    let lane_indices = &mut scratch.lane_indices[padded.start * LANES..padded.end * LANES];
    assert!(panel.factors.len() == PANEL && panel.offsets.len() == PANEL);
    let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    let left_index = _mm512_add_epi32(_mm512_set1_epi32(panel.first_column as i32), lane);
    let indices = [left_index, _mm512_add_epi32(left_index, _mm512_set1_epi32(LANES as i32))];
    let mut best_values = [_mm512_set1_ps(f32::NEG_INFINITY); 2];
    let mut best_indices = [_mm512_set1_epi32(-1); 2];
    // SAFETY: the slices above hold `padded.len()` rows of `stride` bytes, one factor and sixteen lanes each; a tile
    // starts at a row that is a multiple of TILE below that, so its rows lie inside. The panel's slices hold 32 values.
    unsafe {
        let halves = |half: usize| half * LANES;
        let column_factors = [0, 1].map(|half| _mm512_loadu_ps(panel.factors.as_ptr().add(halves(half))));
        let column_offsets = [0, 1].map(|half| _mm512_loadu_si512(panel.offsets.as_ptr().add(halves(half)).cast()));
        for tile in 0..tiles.len() {
            let sums = dots(offset.as_ptr().add(tile * TILE * stride), stride, panel.lines);
            for (r, sums) in sums.iter().enumerate() {
                let row = tile * TILE + r;
                let row_factor = _mm512_set1_ps(*row_factors.get_unchecked(row));
                let row_index = _mm512_set1_epi32((first_row + row) as i32);
                let values_at = lane_values.as_mut_ptr().add(row * LANES);
                let indices_at = lane_indices.as_mut_ptr().add(row * LANES);
                let (mut value, mut index) = (_mm512_loadu_ps(values_at), _mm512_loadu_si512(indices_at.cast()));
                for half in 0..2 {
                    let dot = _mm512_cvtepi32_ps(_mm512_sub_epi32(sums[half], column_offsets[half]));
                    challenge(
                        &mut best_values[half],
                        &mut best_indices[half],
                        _mm512_mul_ps(dot, row_factor),
                        row_index,
                    );
                    challenge(&mut value, &mut index, _mm512_mul_ps(dot, column_factors[half]), indices[half]);
                }
                _mm512_storeu_ps(values_at, value);
                _mm512_storeu_si512(indices_at.cast(), index);
            }
        }
    }
    let (mut values, mut rows) = ([0f32; PANEL], [0i32; PANEL]);
    for half in 0..2 {
        // SAFETY: both arrays hold two vectors.
        unsafe {
            _mm512_storeu_ps(values.as_mut_ptr().add(half * LANES), best_values[half]);
            _mm512_storeu_si512(rows.as_mut_ptr().add(half * LANES).cast(), best_indices[half]);
        }
    }
    for (best, (&value, &row)) in bests.iter_mut().zip(values.iter().zip(&rows)) {
        *best = Best { value, index: row as u32 };
    }
}

/// Reduces the lanes of every row that exists.
fn collect_rows(rows: Quantised<'_>, scratch: &Scratch, bests: &mut [Best]) {
    let mut padded = 0;
    for section in 0..SECTIONS {
        for local in 0..rows.counts[section] {
            bests[rows.start(section) + local] = scratch.reduce_lanes(padded + local, LANES);
        }
        padded += rows.counts[section].next_multiple_of(TILE);
    }
}

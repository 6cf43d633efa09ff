//! AVX2: tiles of 6 rows by 16 columns, products by `vpmaddwd` on codes widened to i16.
//!
//! `vpmaddubsw` would take twice the products per instruction, but it saturates, so that exactness costs back a sign
//! transfer and a second widening multiplication; per exact product both need the same slots of the multiplier ports.

use super::{Best, BlockMaxima, Blocks, Line, PackedColumns, Quantised, SECTIONS, Scratch};
use std::arch::x86_64::*;

/// Columns of a panel: two vectors.
const PANEL: usize = 16;
/// Rows of a tile: 6 x 2 accumulators, two column vectors, a row value and a product fill the 16 registers.
const TILE: usize = 6;
const LANES: usize = 8;

/// Lays columns out in panels: line `k` holds values `2k` and `2k + 1` of 16 columns.
pub(super) fn pack(packed: &mut PackedColumns, columns: Quantised<'_>) {
    let dim = columns.dim;
    let depth = dim.div_ceil(2);
    packed.pack_factors(columns, PANEL);
    packed.pairs.clear();
    packed.pairs.resize(packed.factors.len() / PANEL * depth, Line([0; 32]));
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

/// Widens the rows to i16, each padded to an even length, sections padded to whole tiles.
#[target_feature(enable = "avx2")]
fn widen(rows: Quantised<'_>, scratch: &mut Scratch) {
    let stride = rows.dim.next_multiple_of(2);
    scratch.pad_factors(rows, TILE);
    scratch.wide.clear();
    for section in 0..SECTIONS {
        let start = rows.start(section);
        let codes = &rows.codes[start * rows.dim..(start + rows.counts[section]) * rows.dim];
        if stride == rows.dim {
            scratch.wide.extend(codes.iter().map(|&code| i16::from(code)));
        } else {
            for row in codes.chunks_exact(rows.dim) {
                scratch.wide.extend(row.iter().map(|&code| i16::from(code)));
                scratch.wide.push(0);
            }
        }
        scratch.wide.resize(scratch.wide.len().next_multiple_of(TILE * stride), 0);
    }
}

/// Dot products of six rows, `stride` values apart, with the 16 columns of a panel.
///
/// # Safety
/// `rows` must point at `6 * stride` readable values, with `stride = 2 * panel.len()`.
#[inline]
#[target_feature(enable = "avx2")]
unsafe fn dots(rows: *const i16, stride: usize, panel: &[Line<i16, 32>]) -> [[__m256i; 2]; TILE] {
    let mut sums = [[_mm256_setzero_si256(); 2]; TILE];
    for (k, line) in panel.iter().enumerate() {
        // SAFETY: a line holds 64 bytes; row `r` has values up to `stride`, and 2k + 1 < stride.
        unsafe {
            let columns = line.0.as_ptr().cast::<__m256i>();
            let (left, right) = (_mm256_load_si256(columns), _mm256_load_si256(columns.add(1)));
            // Written out: with a loop over rows the compiler keeps the sums in memory.
            macro_rules! rows {
                ($($r:literal)*) => {$(
                    let pair = _mm256_set1_epi32(rows.add($r * stride + 2 * k).cast::<i32>().read_unaligned());
                    sums[$r][0] = _mm256_add_epi32(sums[$r][0], _mm256_madd_epi16(pair, left));
                    sums[$r][1] = _mm256_add_epi32(sums[$r][1], _mm256_madd_epi16(pair, right));
                )*};
            }
            rows!(0 1 2 3 4 5);
        }
    }
    sums
}

/// Lane-wise running maximum with its index; on a tie or NaN what was held stays.
#[inline]
#[target_feature(enable = "avx2")]
fn challenge(value: &mut __m256, index: &mut __m256i, new_value: __m256, new_index: __m256i) {
    let better = _mm256_cmp_ps::<_CMP_GT_OQ>(new_value, *value);
    // Of (new, held) `max` gives the second when the first is NaN.
    *value = _mm256_max_ps(new_value, *value);
    *index = _mm256_blendv_epi8(*index, new_index, _mm256_castps_si256(better));
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
    widen(rows, scratch);
    let depth = columns.dim.div_ceil(2);
    let (mut panel_base, mut column_base) = (0, 0);
    for column_section in 0..SECTIONS {
        let count = columns.counts[column_section];
        scratch.reset_lanes(LANES);
        for panel in 0..count.div_ceil(PANEL) {
            let panel_index = panel_base + panel;
            let view = Panel {
                lines: &columns.pairs[panel_index * depth..][..depth],
                factors: &columns.factors[panel_index * PANEL..][..PANEL],
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

/// Sixteen columns, of which the first `columns` exist.
struct Panel<'a> {
    lines: &'a [Line<i16, 32>],
    factors: &'a [f32],
    first_column: usize,
    columns: usize,
}

/// Runs one panel over the tiles of one section of rows; the first of those is row `first_row`.
#[target_feature(enable = "avx2")]
fn panel_maxima(
    panel: &Panel<'_>,
    tiles: std::ops::Range<usize>,
    first_row: usize,
    scratch: &mut Scratch,
    bests: &mut [Best],
) {
    let stride = panel.lines.len() * 2;
    let padded = tiles.start * TILE..tiles.end * TILE;
    let wide = &scratch.wide[padded.start * stride..padded.end * stride];
    let row_factors = &scratch.factors[padded.clone()];
    let lane_values = &mut scratch.lane_values[padded.start * LANES..padded.end * LANES];
    let lane_indices = &mut scratch.lane_indices[padded.start * LANES..padded.end * LANES];
    assert!(panel.factors.len() == PANEL);
    let lane = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
    let left_index = _mm256_add_epi32(_mm256_set1_epi32(panel.first_column as i32), lane);
    let indices = [left_index, _mm256_add_epi32(left_index, _mm256_set1_epi32(LANES as i32))];
    let mut best_values = [_mm256_set1_ps(f32::NEG_INFINITY); 2];
    let mut best_indices = [_mm256_set1_epi32(-1); 2];
    // SAFETY: the slices above hold `padded.len()` rows of `stride` values, one factor and eight lanes each; a tile
    // starts at a row that is a multiple of TILE below that, so its six rows lie inside. `factors` holds 16 values.
    unsafe {
        let column_factors =
            [_mm256_loadu_ps(panel.factors.as_ptr()), _mm256_loadu_ps(panel.factors.as_ptr().add(LANES))];
        for tile in 0..tiles.len() {
            let sums = dots(wide.as_ptr().add(tile * TILE * stride), stride, panel.lines);
            for (r, sums) in sums.iter().enumerate() {
                let row = tile * TILE + r;
                let row_factor = _mm256_set1_ps(*row_factors.get_unchecked(row));
                let row_index = _mm256_set1_epi32((first_row + row) as i32);
                let values_at = lane_values.as_mut_ptr().add(row * LANES);
                let indices_at = lane_indices.as_mut_ptr().add(row * LANES).cast::<__m256i>();
                let (mut value, mut index) = (_mm256_loadu_ps(values_at), _mm256_loadu_si256(indices_at));
                for half in 0..2 {
                    let dot = _mm256_cvtepi32_ps(sums[half]);
                    challenge(
                        &mut best_values[half],
                        &mut best_indices[half],
                        _mm256_mul_ps(dot, row_factor),
                        row_index,
                    );
                    challenge(&mut value, &mut index, _mm256_mul_ps(dot, column_factors[half]), indices[half]);
                }
                _mm256_storeu_ps(values_at, value);
                _mm256_storeu_si256(indices_at, index);
            }
        }
    }
    let (mut values, mut rows) = ([0f32; PANEL], [0i32; PANEL]);
    for half in 0..2 {
        // SAFETY: both arrays hold two vectors.
        unsafe {
            _mm256_storeu_ps(values.as_mut_ptr().add(half * LANES), best_values[half]);
            _mm256_storeu_si256(rows.as_mut_ptr().add(half * LANES).cast(), best_indices[half]);
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

//! The way through panels of columns and tiles of rows, written once for the levels that have vectors.
//!
//! A panel is two vectors of columns wide. It stays in the first-level cache while all tiles of rows pass by; the
//! running maxima of its columns stay in registers, those of the rows are kept lane by lane and reduced at the end.

use super::{Best, BlockMaxima, Blocks, PackedColumns, Quantised, SECTIONS, Scratch};
use crate::kernels::lanes::Lanes;
use std::ops::Range;

/// What differs between the levels, for tiles of `TILE` rows.
///
/// # Safety
/// Methods that are `unsafe` may be called only where the level's instructions are available; pointers must be valid
/// for a vector's elements.
pub(super) trait Level<const TILE: usize> {
    /// A padded row's element.
    type Code;
    /// Successive values of the columns of a panel, on a cache line.
    type Line;
    /// A vector of f32.
    type Floats: Lanes;
    /// A vector of i32.
    type Integers: Copy;

    /// Lays the rows out in whole tiles.
    unsafe fn pad(rows: Quantised<'_>, scratch: &mut Scratch);
    /// What `pad` made.
    fn padded(scratch: &Scratch) -> &[Self::Code];
    /// The packed columns.
    fn lines(columns: &PackedColumns) -> &[Self::Line];
    /// Lines of one panel; twice as many elements make a padded row.
    fn lines_per_panel(dim: usize) -> usize;
    /// What every product with a column of a panel has too much, if the level has such.
    unsafe fn excess(columns: &PackedColumns, panel: usize) -> [Self::Integers; 2];
    /// Products of `TILE` rows, `stride` elements apart, with the columns of a panel.
    ///
    /// # Safety
    /// `rows` must point at `TILE * stride` readable elements, with `stride = 2 * panel.len()`.
    unsafe fn products(rows: *const Self::Code, stride: usize, panel: &[Self::Line]) -> [[Self::Integers; 2]; TILE];
    /// Products less their excess.
    unsafe fn exact(products: Self::Integers, excess: Self::Integers) -> Self::Floats;
    unsafe fn splat_index(index: i32) -> Self::Integers;
    /// `first`, `first + 1`, ...
    unsafe fn indices_from(first: i32) -> Self::Integers;
    unsafe fn load_indices(from: *const i32) -> Self::Integers;
    unsafe fn store_indices(to: *mut i32, indices: Self::Integers);
    /// Lane-wise running maximum with its index; on a tie or NaN what was held stays.
    unsafe fn challenge(
        value: &mut Self::Floats,
        index: &mut Self::Integers,
        new_value: Self::Floats,
        new_index: Self::Integers,
    );
}

/// See [`super::block_maxima`], which has checked the lengths.
///
/// # Safety
/// The level's instructions must be available.
#[inline(always)]
pub(super) unsafe fn block_maxima<L: Level<TILE>, const TILE: usize>(
    columns: &PackedColumns,
    rows: Quantised<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    // SAFETY: the caller's.
    unsafe { L::pad(rows, scratch) };
    let width = 2 * L::Floats::COUNT;
    let depth = L::lines_per_panel(columns.dim);
    let (mut panel_base, mut column_base) = (0, 0);
    for column_section in 0..SECTIONS {
        let count = columns.counts[column_section];
        scratch.reset_lanes(L::Floats::COUNT);
        for panel in 0..count.div_ceil(width) {
            let index = panel_base + panel;
            let view = Panel::<L, TILE> {
                lines: &L::lines(columns)[index * depth..][..depth],
                factors: &columns.factors[index * width..][..width],
                // SAFETY: the caller's.
                excess: unsafe { L::excess(columns, index) },
                first_column: column_base + panel * width,
                columns: width.min(count - panel * width),
            };
            let mut tile_base = 0;
            for row_section in 0..SECTIONS {
                let tiles = rows.counts[row_section].div_ceil(TILE);
                if wanted[row_section][column_section] {
                    let bests = &mut out.columns[row_section][view.first_column..][..view.columns];
                    let tiles = tile_base..tile_base + tiles;
                    // SAFETY: the caller's.
                    unsafe { panel_maxima(&view, tiles, rows.start(row_section), scratch, bests) };
                }
                tile_base += tiles;
            }
        }
        collect_rows::<TILE>(rows, scratch, L::Floats::COUNT, &mut out.rows[column_section]);
        panel_base += count.div_ceil(width);
        column_base += count;
    }
}

/// Two vectors of columns, of which the first `columns` exist.
struct Panel<'a, L: Level<TILE>, const TILE: usize> {
    lines: &'a [L::Line],
    factors: &'a [f32],
    excess: [L::Integers; 2],
    first_column: usize,
    columns: usize,
}

/// The best row of each column of a panel so far.
struct ColumnBests<L: Level<TILE>, const TILE: usize> {
    values: [L::Floats; 2],
    indices: [L::Integers; 2],
}

/// Runs one panel over the tiles of one section of rows; the first of those is row `first_row`.
///
/// # Safety
/// The level's instructions must be available.
#[inline(always)]
unsafe fn panel_maxima<L: Level<TILE>, const TILE: usize>(
    panel: &Panel<'_, L, TILE>,
    tiles: Range<usize>,
    first_row: usize,
    scratch: &mut Scratch,
    bests: &mut [Best],
) {
    let stride = panel.lines.len() * 2;
    let padded = tiles.start * TILE..tiles.end * TILE;
    let codes: *const L::Code = L::padded(scratch)[padded.start * stride..padded.end * stride].as_ptr();
    let row_factors = &scratch.factors[padded.clone()];
    let lanes = padded.start * L::Floats::COUNT..padded.end * L::Floats::COUNT;
    let (lane_values, lane_indices) = (&mut scratch.lane_values[lanes.clone()], &mut scratch.lane_indices[lanes]);
    assert!(panel.factors.len() == 2 * L::Floats::COUNT);
    // SAFETY: the slices above hold `padded.len()` rows of `stride` elements, one factor and LANES lanes each; a tile
    // starts at a row that is a multiple of TILE below that, so its rows lie inside. `factors` holds two vectors. The
    // instructions are the caller's.
    unsafe {
        let factors =
            [L::Floats::load(panel.factors.as_ptr()), L::Floats::load(panel.factors.as_ptr().add(L::Floats::COUNT))];
        let first_column = panel.first_column as i32;
        let indices = [L::indices_from(first_column), L::indices_from(first_column + L::Floats::COUNT as i32)];
        let mut best = ColumnBests::<L, TILE> {
            values: [L::Floats::splat(f32::NEG_INFINITY); 2],
            indices: [L::splat_index(-1); 2],
        };
        for tile in 0..tiles.len() {
            let products = L::products(codes.add(tile * TILE * stride), stride, panel.lines);
            for (r, products) in products.iter().enumerate() {
                let row = tile * TILE + r;
                let row_factor = L::Floats::splat(*row_factors.get_unchecked(row));
                let row_index = L::splat_index((first_row + row) as i32);
                let (values_at, indices_at) = (
                    lane_values.as_mut_ptr().add(row * L::Floats::COUNT),
                    lane_indices.as_mut_ptr().add(row * L::Floats::COUNT),
                );
                let (mut value, mut index) = (L::Floats::load(values_at), L::load_indices(indices_at));
                for half in 0..2 {
                    let dot = L::exact(products[half], panel.excess[half]);
                    let (best_value, best_index) = (&mut best.values[half], &mut best.indices[half]);
                    L::challenge(best_value, best_index, dot.mul(row_factor), row_index);
                    L::challenge(&mut value, &mut index, dot.mul(factors[half]), indices[half]);
                }
                value.store(values_at);
                L::store_indices(indices_at, index);
            }
        }
        best.write(bests);
    }
}

impl<L: Level<TILE>, const TILE: usize> ColumnBests<L, TILE> {
    /// Writes the columns that exist.
    ///
    /// # Safety
    /// The level's instructions must be available.
    #[inline(always)]
    unsafe fn write(&self, bests: &mut [Best]) {
        // Two vectors of the longest kind.
        let (mut values, mut rows) = ([0f32; 32], [0i32; 32]);
        assert!(2 * L::Floats::COUNT <= values.len());
        for half in 0..2 {
            // SAFETY: both arrays hold two vectors; the rest is the caller's.
            unsafe {
                self.values[half].store(values.as_mut_ptr().add(half * L::Floats::COUNT));
                L::store_indices(rows.as_mut_ptr().add(half * L::Floats::COUNT), self.indices[half]);
            }
        }
        for (best, (&value, &row)) in bests.iter_mut().zip(values.iter().zip(&rows)) {
            *best = Best { value, index: row as u32 };
        }
    }
}

/// Reduces the lanes of every row that exists.
#[inline(always)]
fn collect_rows<const TILE: usize>(rows: Quantised<'_>, scratch: &Scratch, lanes: usize, bests: &mut [Best]) {
    let mut padded = 0;
    for section in 0..SECTIONS {
        for local in 0..rows.counts[section] {
            bests[rows.start(section) + local] = scratch.reduce_lanes(padded + local, lanes);
        }
        padded += rows.counts[section].next_multiple_of(TILE);
    }
}

//! The way through panels of columns and tiles of rows, written once for the levels that have
//! vectors.
//!
//! A panel is two vectors of columns wide, or one where no more are left. It stays in the
//! first-level cache while all tiles of rows pass by; the running maxima of its columns stay in
//! registers, those of the rows are kept lane by lane and reduced at the end.

use super::{Best, BlockMaxima, Blocks, MOST_LANES, PackedColumns, Quantised, SECTIONS, Scratch};
use crate::lanes::Lanes;
use std::ops::Range;

/// What differs between the levels.
///
/// # Safety
/// Methods that are `unsafe` may be called only where the level's instructions are available;
/// pointers must be valid for a vector's elements.
pub(super) trait Level {
    /// A row's element as it is multiplied.
    type Code;
    /// Successive values of the columns of a panel, on a cache line.
    type Line;
    /// A vector of f32.
    type Floats: Lanes;
    /// A vector of i32.
    type Integers: Copy;

    /// Prepares the rows.
    unsafe fn lay_out(rows: Quantised<'_>, scratch: &mut Scratch);
    /// The rows as laid out, each [`lines_per_panel`](Self::lines_per_panel) times two elements
    /// long.
    fn rows<'a>(rows: Quantised<'a>, scratch: &'a Scratch) -> &'a [Self::Code];
    /// The packed columns.
    fn lines(columns: &PackedColumns) -> &[Self::Line];
    /// Lines of one panel.
    fn lines_per_panel(dim: usize) -> usize;
    /// What the sums of row `row` start from.
    unsafe fn start(scratch: &Scratch, row: usize) -> Self::Integers;
    /// Adds to `sums` the products of `ROWS` rows, `2 * panel.len()` elements apart, with the first
    /// `VECTORS` vectors of columns of a panel.
    ///
    /// # Safety
    /// `rows` must point at `2 * ROWS * panel.len()` readable elements.
    unsafe fn add_products<const ROWS: usize, const VECTORS: usize>(
        rows: *const Self::Code,
        panel: &[Self::Line],
        sums: &mut [[Self::Integers; VECTORS]; ROWS],
    );
    unsafe fn to_floats(sums: Self::Integers) -> Self::Floats;
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

/// See [`super::block_maxima`], which has checked the lengths. Tiles are `TILE` rows high, and
/// `STEP` where fewer are left.
///
/// # Safety
/// The level's instructions must be available.
#[inline(always)]
pub(super) unsafe fn block_maxima<L: Level, const TILE: usize, const STEP: usize>(
    columns: &PackedColumns,
    rows: Quantised<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    // SAFETY: the caller's.
    unsafe { L::lay_out(rows, scratch) };
    let width = 2 * L::Floats::COUNT;
    let depth = L::lines_per_panel(columns.dim);
    let (mut panel_base, mut column_base) = (0, 0);
    for column_section in 0..SECTIONS {
        let count = columns.counts[column_section];
        scratch.reset_lanes(rows.len(), L::Floats::COUNT);
        for panel in 0..count.div_ceil(width) {
            let index = panel_base + panel;
            let view = Panel::<L> {
                lines: &L::lines(columns)[index * depth..][..depth],
                factors: &columns.factors[index * width..][..width],
                first_column: column_base + panel * width,
            };
            let left = width.min(count - panel * width);
            for row_section in 0..SECTIONS {
                if wanted[row_section][column_section] {
                    let bests = &mut out.columns[row_section][view.first_column..][..left];
                    let range =
                        rows.start(row_section)..rows.start(row_section) + rows.counts[row_section];
                    // SAFETY: the caller's.
                    unsafe {
                        if left > L::Floats::COUNT {
                            panel_maxima::<L, TILE, STEP, 2>(&view, rows, range, scratch, bests);
                        } else {
                            panel_maxima::<L, TILE, STEP, 1>(&view, rows, range, scratch, bests);
                        }
                    }
                }
            }
        }
        for (row, best) in out.rows[column_section].iter_mut().enumerate() {
            *best = scratch.reduce_lanes(row, L::Floats::COUNT);
        }
        panel_base += count.div_ceil(width);
        column_base += count;
    }
}

/// Two vectors of columns.
struct Panel<'a, L: Level> {
    lines: &'a [L::Line],
    factors: &'a [f32],
    first_column: usize,
}

/// The best row of each column of a panel so far.
struct ColumnBests<L: Level, const VECTORS: usize> {
    values: [L::Floats; VECTORS],
    indices: [L::Integers; VECTORS],
}

/// Runs the first `VECTORS` vectors of a panel over the rows of one section.
///
/// The last tile ends with the last row: it may see rows again, which changes nothing, since a
/// maximum does not beat itself.
///
/// # Safety
/// The level's instructions must be available.
#[inline(always)]
unsafe fn panel_maxima<L: Level, const TILE: usize, const STEP: usize, const VECTORS: usize>(
    panel: &Panel<'_, L>,
    rows: Quantised<'_>,
    range: Range<usize>,
    scratch: &mut Scratch,
    bests: &mut [Best],
) {
    // SAFETY: the caller's.
    let mut found = unsafe { ColumnBests::<L, VECTORS>::none() };
    let mut row = range.start;
    // SAFETY: tiles lie within the range; the rest is the caller's.
    unsafe {
        while row + TILE <= range.end {
            tile_maxima::<L, TILE, VECTORS>(panel, rows, row, scratch, &mut found);
            row += TILE;
        }
        while row < range.end && range.len() >= STEP {
            row = row.min(range.end - STEP);
            tile_maxima::<L, STEP, VECTORS>(panel, rows, row, scratch, &mut found);
            row += STEP;
        }
        while row < range.end {
            tile_maxima::<L, 1, VECTORS>(panel, rows, row, scratch, &mut found);
            row += 1;
        }
        found.write(bests);
    }
}

/// Compares the `ROWS` rows from `first_row` on with `VECTORS` vectors of columns.
///
/// # Safety
/// The level's instructions must be available.
#[inline(always)]
unsafe fn tile_maxima<L: Level, const ROWS: usize, const VECTORS: usize>(
    panel: &Panel<'_, L>,
    rows: Quantised<'_>,
    first_row: usize,
    scratch: &mut Scratch,
    found: &mut ColumnBests<L, VECTORS>,
) {
    let stride = panel.lines.len() * 2;
    let codes = L::rows(rows, scratch)[first_row * stride..(first_row + ROWS) * stride].as_ptr();
    let row_factors = &rows.factors[first_row..first_row + ROWS];
    assert!(panel.factors.len() == 2 * L::Floats::COUNT);
    // SAFETY: the slice above holds `ROWS` rows of `stride` elements, `factors` two vectors. The
    // instructions are the caller's.
    unsafe {
        let mut sums: [[L::Integers; VECTORS]; ROWS] =
            std::array::from_fn(|r| [L::start(scratch, first_row + r); VECTORS]);
        L::add_products::<ROWS, VECTORS>(codes, panel.lines, &mut sums);
        let lanes = first_row * L::Floats::COUNT..(first_row + ROWS) * L::Floats::COUNT;
        let (lane_values, lane_indices) = (
            &mut scratch.lane_values[lanes.clone()],
            &mut scratch.lane_indices[lanes],
        );
        for (r, sums) in sums.iter().enumerate() {
            let row_factor = L::Floats::splat(row_factors[r]);
            let row_index = L::splat_index((first_row + r) as i32);
            // Inside the slices: they hold `ROWS` vectors.
            let (values_at, indices_at) = (
                lane_values.as_mut_ptr().add(r * L::Floats::COUNT),
                lane_indices.as_mut_ptr().add(r * L::Floats::COUNT),
            );
            let (mut value, mut index) = (L::Floats::load(values_at), L::load_indices(indices_at));
            for vector in 0..VECTORS {
                let dot = L::to_floats(sums[vector]);
                let factors =
                    L::Floats::load(panel.factors.as_ptr().add(vector * L::Floats::COUNT));
                let columns =
                    L::indices_from((panel.first_column + vector * L::Floats::COUNT) as i32);
                L::challenge(
                    &mut found.values[vector],
                    &mut found.indices[vector],
                    dot.mul(row_factor),
                    row_index,
                );
                L::challenge(&mut value, &mut index, dot.mul(factors), columns);
            }
            value.store(values_at);
            L::store_indices(indices_at, index);
        }
    }
}

impl<L: Level, const VECTORS: usize> ColumnBests<L, VECTORS> {
    /// # Safety
    /// The level's instructions must be available.
    #[inline(always)]
    unsafe fn none() -> Self {
        // SAFETY: the caller's.
        unsafe {
            Self {
                values: [L::Floats::splat(f32::NEG_INFINITY); VECTORS],
                indices: [L::splat_index(-1); VECTORS],
            }
        }
    }

    /// Writes the columns that exist.
    ///
    /// # Safety
    /// The level's instructions must be available.
    #[inline(always)]
    unsafe fn write(&self, bests: &mut [Best]) {
        // Two vectors of the longest kind.
        let (mut values, mut rows) = ([0f32; 2 * MOST_LANES], [0i32; 2 * MOST_LANES]);
        assert!(VECTORS * L::Floats::COUNT <= values.len());
        for vector in 0..VECTORS {
            // SAFETY: both arrays hold the vectors; the rest is the caller's.
            unsafe {
                self.values[vector].store(values.as_mut_ptr().add(vector * L::Floats::COUNT));
                L::store_indices(
                    rows.as_mut_ptr().add(vector * L::Floats::COUNT),
                    self.indices[vector],
                );
            }
        }
        for (best, (&value, &row)) in bests.iter_mut().zip(values.iter().zip(&rows)) {
            *best = Best {
                value,
                index: row as u32,
            };
        }
    }
}

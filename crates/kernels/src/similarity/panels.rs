//! The walk over panels of columns and tiles of rows, generic over the instruction set.
//!
//! A panel is two vectors of columns wide. It stays in the first-level cache while it is compared
//! with all rows. The running maxima of its columns stay in registers; those of the rows are kept
//! for each lane of a vector and reduced to one when all columns of a section have been seen.

use super::scratch::MAX_LANES;
use super::{Best, BlockMaxima, Blocks, Int8Descriptors, PackedColumns, SECTIONS, Scratch};
use crate::registers::{FloatVector, VectorIsa};
use std::ops::Range;

/// What the comparison needs of an instruction set beyond [`VectorIsa`].
pub(super) trait SimilarityIsa: VectorIsa {
    /// Successive values of a row that one instruction multiplies: 32 bits.
    type RowGroup: Copy;
    /// The same values of all columns of a panel.
    type PanelGroup;
    /// A vector of i32, as many as [`VectorIsa::Floats`] has elements.
    type Integers: Copy;

    /// Prepares the rows.
    fn lay_out(self, rows: Int8Descriptors<'_>, scratch: &mut Scratch);
    /// The prepared rows, `[rows][groups]`.
    fn rows<'a>(rows: Int8Descriptors<'a>, scratch: &'a Scratch) -> &'a [Self::RowGroup];
    /// The packed columns, `[panels][groups]`.
    fn panels(columns: &PackedColumns) -> &[Self::PanelGroup];
    /// Number of groups that the values of a descriptor are divided into.
    fn groups(dim: usize) -> usize;

    /// What the sums of a row start from.
    fn start(self, scratch: &Scratch, row: usize) -> Self::Integers;
    /// One group of a row in every place.
    fn broadcast(self, group: Self::RowGroup) -> Self::Integers;
    /// The first or second vector of columns of a panel's group.
    fn column(self, group: &Self::PanelGroup, vector: usize) -> Self::Integers;
    /// `sums` plus, lane by lane, the products of a row's group with the columns.
    fn add_products(
        self,
        sums: Self::Integers,
        columns: Self::Integers,
        row: Self::Integers,
    ) -> Self::Integers;

    /// The integers as floats.
    fn to_floats(self, sums: Self::Integers) -> Self::Floats;
    /// One index in every place.
    fn splat_index(self, index: i32) -> Self::Integers;
    /// `first`, `first + 1`, and so on.
    fn indices_from(self, first: i32) -> Self::Integers;
    /// The first indices of a slice, as many as a vector holds.
    fn load_indices(self, from: &[i32]) -> Self::Integers;
    /// Writes indices to the start of a slice.
    fn store_indices(self, indices: Self::Integers, to: &mut [i32]);
    /// Lane by lane the challenger if its value is larger, else what is `current`, also on a tie or
    /// NaN.
    fn better(self, current: LaneBests<Self>, challenger: LaneBests<Self>) -> LaneBests<Self>;
}

/// In each lane a similarity, and whose it is.
#[derive(Clone, Copy)]
pub(super) struct LaneBests<I: SimilarityIsa> {
    pub(super) values: I::Floats,
    pub(super) indices: I::Integers,
}

/// See [`super::block_maxima`], which has checked the lengths. Tiles are `TILE` rows high, or
/// `STEP` if fewer are left.
#[expect(
    clippy::needless_range_loop,
    reason = "a section indexes several arrays"
)]
#[inline(always)]
pub(super) fn block_maxima<I: SimilarityIsa, const TILE: usize, const STEP: usize>(
    isa: I,
    columns: &PackedColumns,
    rows: Int8Descriptors<'_>,
    wanted: &Blocks,
    scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    isa.lay_out(rows, scratch);
    let lanes = I::Floats::COUNT;
    let width = 2 * lanes;
    let groups = I::groups(rows.dim);
    let mut first_panel = 0;
    let mut first_column = 0;
    for column_section in 0..SECTIONS {
        let count = columns.counts[column_section];
        scratch.reset_lanes(rows.len(), lanes);
        for number in 0..count.div_ceil(width) {
            let index = first_panel + number;
            let panel = ColumnPanel::<I> {
                groups: &I::panels(columns)[index * groups..][..groups],
                factors: &columns.factors[index * width..][..width],
                first_column: first_column + number * width,
            };
            let left = width.min(count - number * width);
            for row_section in (0..SECTIONS).filter(|&section| wanted[section][column_section]) {
                let bests = &mut out.columns[row_section][panel.first_column..][..left];
                let start = rows.start(row_section);
                let range = start..start + rows.counts[row_section];
                if left > lanes {
                    panel_maxima::<I, TILE, STEP, 2>(isa, &panel, rows, range, scratch, bests);
                } else {
                    panel_maxima::<I, TILE, STEP, 1>(isa, &panel, rows, range, scratch, bests);
                }
            }
        }
        for (row, best) in out.rows[column_section].iter_mut().enumerate() {
            *best = scratch.reduce_lanes(row, lanes);
        }
        first_panel += count.div_ceil(width);
        first_column += count;
    }
}

/// Two vectors of columns.
struct ColumnPanel<'a, I: SimilarityIsa> {
    groups: &'a [I::PanelGroup],
    factors: &'a [f32],
    first_column: usize,
}

/// Compares the first `VECTORS` vectors of a panel with the rows of one section.
///
/// The last tile ends with the section's last row. It may overlap the tile before; comparing a row
/// twice changes nothing, since a value does not beat itself.
#[inline(always)]
fn panel_maxima<I: SimilarityIsa, const TILE: usize, const STEP: usize, const VECTORS: usize>(
    isa: I,
    panel: &ColumnPanel<'_, I>,
    rows: Int8Descriptors<'_>,
    range: Range<usize>,
    scratch: &mut Scratch,
    bests: &mut [Best],
) {
    let mut column_bests = [LaneBests {
        values: isa.splat(f32::NEG_INFINITY),
        indices: isa.splat_index(-1),
    }; VECTORS];
    let mut row = range.start;
    while row + TILE <= range.end {
        tile_maxima::<I, TILE, VECTORS>(isa, panel, rows, row, scratch, &mut column_bests);
        row += TILE;
    }
    while row < range.end && range.len() >= STEP {
        row = row.min(range.end - STEP);
        tile_maxima::<I, STEP, VECTORS>(isa, panel, rows, row, scratch, &mut column_bests);
        row += STEP;
    }
    while row < range.end {
        tile_maxima::<I, 1, VECTORS>(isa, panel, rows, row, scratch, &mut column_bests);
        row += 1;
    }
    write_bests(isa, &column_bests, bests);
}

/// Compares the `ROWS` rows from `first_row` on with `VECTORS` vectors of columns.
#[inline(always)]
fn tile_maxima<I: SimilarityIsa, const ROWS: usize, const VECTORS: usize>(
    isa: I,
    panel: &ColumnPanel<'_, I>,
    rows: Int8Descriptors<'_>,
    first_row: usize,
    scratch: &mut Scratch,
    column_bests: &mut [LaneBests<I>; VECTORS],
) {
    let sums = tile_sums::<I, ROWS, VECTORS>(isa, panel, rows, first_row, scratch);
    let lanes = I::Floats::COUNT;
    let row_factors = &rows.factors[first_row..first_row + ROWS];
    let range = first_row * lanes..(first_row + ROWS) * lanes;
    let lane_values = &mut scratch.lane_values[range.clone()];
    let lane_indices = &mut scratch.lane_indices[range];
    for (r, sums) in sums.iter().enumerate() {
        let row_factor = isa.splat(row_factors[r]);
        let row_index = isa.splat_index((first_row + r) as i32);
        let values = &mut lane_values[r * lanes..(r + 1) * lanes];
        let indices = &mut lane_indices[r * lanes..(r + 1) * lanes];
        let mut row_bests = LaneBests {
            values: isa.load(values),
            indices: isa.load_indices(indices),
        };
        for vector in 0..VECTORS {
            let dots = isa.to_floats(sums[vector]);
            let of_columns = LaneBests {
                values: dots.mul(row_factor),
                indices: row_index,
            };
            column_bests[vector] = isa.better(column_bests[vector], of_columns);
            let first_column = panel.first_column + vector * lanes;
            let of_row = LaneBests {
                values: dots.mul(isa.load(&panel.factors[vector * lanes..])),
                indices: isa.indices_from(first_column as i32),
            };
            row_bests = isa.better(row_bests, of_row);
        }
        row_bests.values.store(values);
        isa.store_indices(row_bests.indices, indices);
    }
}

/// The dot products of `ROWS` rows with `VECTORS` vectors of columns.
#[expect(
    clippy::needless_range_loop,
    reason = "indices keep the sums in registers; iterators leave them in memory"
)]
#[inline(always)]
fn tile_sums<I: SimilarityIsa, const ROWS: usize, const VECTORS: usize>(
    isa: I,
    panel: &ColumnPanel<'_, I>,
    rows: Int8Descriptors<'_>,
    first_row: usize,
    scratch: &Scratch,
) -> [[I::Integers; VECTORS]; ROWS] {
    let groups = panel.groups.len();
    let all_rows = I::rows(rows, scratch);
    let rows: [&[I::RowGroup]; ROWS] =
        std::array::from_fn(|r| &all_rows[(first_row + r) * groups..][..groups]);
    let mut sums = [[isa.splat_index(0); VECTORS]; ROWS];
    for r in 0..ROWS {
        sums[r] = [isa.start(scratch, first_row + r); VECTORS];
    }
    for (k, group) in panel.groups.iter().enumerate() {
        let mut columns = [isa.splat_index(0); VECTORS];
        for vector in 0..VECTORS {
            columns[vector] = isa.column(group, vector);
        }
        for r in 0..ROWS {
            let values = isa.broadcast(rows[r][k]);
            for vector in 0..VECTORS {
                sums[r][vector] = isa.add_products(sums[r][vector], columns[vector], values);
            }
        }
    }
    sums
}

/// Writes the best rows of the columns that exist.
#[inline(always)]
fn write_bests<I: SimilarityIsa, const VECTORS: usize>(
    isa: I,
    column_bests: &[LaneBests<I>; VECTORS],
    bests: &mut [Best],
) {
    let lanes = I::Floats::COUNT;
    let mut values = [0f32; 2 * MAX_LANES];
    let mut rows = [0i32; 2 * MAX_LANES];
    for (vector, column_bests) in column_bests.iter().enumerate() {
        column_bests.values.store(&mut values[vector * lanes..]);
        isa.store_indices(column_bests.indices, &mut rows[vector * lanes..]);
    }
    for (best, (&value, &row)) in bests.iter_mut().zip(values.iter().zip(&rows)) {
        *best = Best {
            value,
            index: row as u32,
        };
    }
}

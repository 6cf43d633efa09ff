//! Portable code, and the reference for the other instruction sets.

use super::{BlockMaxima, Blocks, Int8Descriptors, PackedColumns, SECTIONS, Scratch};

/// See [`PackedColumns::pack`]: the columns stay as they are.
pub(super) fn pack(packed: &mut PackedColumns, columns: Int8Descriptors<'_>) {
    packed.codes.clear();
    packed.codes.extend_from_slice(columns.codes);
    packed.factors.clear();
    packed.factors.extend_from_slice(columns.factors);
}

/// See [`super::block_maxima`].
#[expect(
    clippy::needless_range_loop,
    reason = "a section indexes several arrays"
)]
pub(super) fn block_maxima(
    columns: &PackedColumns,
    rows: Int8Descriptors<'_>,
    wanted: &Blocks,
    _scratch: &mut Scratch,
    out: &mut BlockMaxima,
) {
    let dim = rows.dim;
    let mut column_start = 0;
    for column_section in 0..SECTIONS {
        let column_range = column_start..column_start + columns.counts[column_section];
        column_start = column_range.end;
        for row_section in (0..SECTIONS).filter(|&section| wanted[section][column_section]) {
            let row_start = rows.start(row_section);
            for row in row_start..row_start + rows.counts[row_section] {
                let row_codes = &rows.codes[row * dim..][..dim];
                let best_column = &mut out.rows[column_section][row];
                for column in column_range.clone() {
                    let dot = dot(row_codes, &columns.codes[column * dim..][..dim]) as f32;
                    let best_row = &mut out.columns[row_section][column];
                    best_column.challenge(dot * columns.factors[column], column as u32);
                    best_row.challenge(dot * rows.factors[row], row as u32);
                }
            }
        }
    }
}

/// The exact dot product of two descriptors' codes.
fn dot(a: &[i8], b: &[i8]) -> i32 {
    let products = a.iter().zip(b).map(|(&a, &b)| i32::from(a) * i32::from(b));
    products.sum()
}

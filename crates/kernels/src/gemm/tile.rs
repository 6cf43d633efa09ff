//! The register tile: sums stay in registers while k advances, generic over the format's
//! instructions and the size of the tile.

use super::dot::DotIsa;
use super::job::PanelJob;

/// Multiplies all rows of a job by tiles of `ROWS` rows and `VECTORS` registers of columns, those
/// beyond the last whole tile by tiles of `STEP` rows.
#[inline(always)]
pub(super) fn multiply<D: DotIsa, const ROWS: usize, const STEP: usize, const VECTORS: usize>(
    isa: D,
    job: &mut PanelJob<'_>,
) {
    let whole = job.rows() / ROWS * ROWS;
    for row in (0..whole).step_by(ROWS) {
        multiply_tile::<D, ROWS, VECTORS>(isa, job, row);
    }
    for row in (whole..job.rows()).step_by(STEP) {
        multiply_tile::<D, STEP, VECTORS>(isa, job, row);
    }
}

/// Computes the sums of `ROWS` rows from `first` on. Loops over sums use indices of constant range:
/// with iterators the compiler leaves the sums in memory.
#[inline(always)]
fn multiply_tile<D: DotIsa, const ROWS: usize, const VECTORS: usize>(
    isa: D,
    job: &mut PanelJob<'_>,
    first: usize,
) {
    let width = VECTORS * D::COUNT;
    let left = job.left_from(first);
    let left_stride = job.left_stride();
    let out_stride = job.out_stride();

    let mut sums = [[isa.zero(); VECTORS]; ROWS];
    if job.accumulates() {
        let out = job.out_from(first);
        for row in 0..ROWS {
            for vector in 0..VECTORS {
                sums[row][vector] = isa.load(&out[row * out_stride + vector * D::COUNT..]);
            }
        }
    }

    // What is left of each row.
    let mut rows: [&[u32]; ROWS] = [&[]; ROWS];
    for row in 0..ROWS {
        rows[row] = &left[row * left_stride..];
    }

    for (_, segment) in job.segments() {
        let count = segment.len() / width;
        // The compiler sees that these slices are `count` long, so that the loop below needs no
        // bounds checks.
        let mut words: [&[u32]; ROWS] = [&[]; ROWS];
        for row in 0..ROWS {
            let (of_segment, rest) = rows[row].split_at(count);
            words[row] = of_segment;
            rows[row] = rest;
        }
        for (at, line) in segment.chunks_exact(width).enumerate().take(count) {
            let mut columns = [isa.zero(); VECTORS];
            for vector in 0..VECTORS {
                columns[vector] = isa.load(&line[vector * D::COUNT..]);
            }
            for row in 0..ROWS {
                let word = isa.broadcast(words[row][at]);
                for vector in 0..VECTORS {
                    sums[row][vector] = isa.add_products(sums[row][vector], word, columns[vector]);
                }
            }
        }
    }

    let out = job.out_from(first);
    for row in 0..ROWS {
        for vector in 0..VECTORS {
            isa.store(
                sums[row][vector],
                &mut out[row * out_stride + vector * D::COUNT..],
            );
        }
    }
}

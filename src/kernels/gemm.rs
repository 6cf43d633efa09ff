//! Matrix products with the right-hand side packed once: the linear layers of the transformer, and the two products
//! of attention.
//!
//! The right-hand side lies in panels of [`Tiling::columns`] columns, `[panel][k][columns]`, so that a register tile of
//! [`Tiling::rows`] x `columns` sums reads it in order. The left-hand side stays row-major. One call multiplies a whole
//! block of rows with one panel, which thereby stays in the first-level cache, and leaves a small dense block that the
//! caller's epilogue reads while it is hot.
//!
//! Every sum runs over k in ascending order whatever the number of rows or threads, so a row's result depends on
//! nothing but that row.

use super::Simd;
use super::aligned::AlignedBuffer;
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::lanes::{Lanes, Portable, at_level};
use super::simd::SimdLevel;

/// Sums held in registers at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tiling {
    /// Rows of the left-hand side.
    pub rows: usize,
    /// Columns of the right-hand side: the width of a panel.
    pub columns: usize,
}

impl Tiling {
    /// The tile of a level: as many sums as its registers hold beside one row of the panel.
    pub fn of(simd: Simd) -> Self {
        match simd.level() {
            SimdLevel::Scalar => Self { rows: 4, columns: 8 },
            SimdLevel::Avx2 => Self { rows: 6, columns: 16 },
            SimdLevel::Avx512 => Self { rows: 8, columns: 32 },
        }
    }
}

/// A `[k, n]` matrix in panels; columns beyond n are zero.
#[derive(Debug, Clone)]
pub struct PackedMatrix {
    data: AlignedBuffer<f32>,
    k: usize,
    n: usize,
    columns: usize,
}

impl PackedMatrix {
    /// Packs the matrix whose element in row `k` and column `n` is `element(k, n)`.
    pub fn pack(simd: Simd, k: usize, n: usize, element: impl Fn(usize, usize) -> f32) -> Self {
        let columns = Tiling::of(simd).columns;
        let mut data = AlignedBuffer::zeroed(n.div_ceil(columns) * k * columns);
        for column in 0..n {
            let (panel, lane) = (column / columns, column % columns);
            for row in 0..k {
                data[(panel * k + row) * columns + lane] = element(row, column);
            }
        }
        Self { data, k, n, columns }
    }

    /// Rows, the length of the sums.
    pub fn k(&self) -> usize {
        self.k
    }

    /// Columns.
    pub fn n(&self) -> usize {
        self.n
    }

    /// Panels, the last possibly not full.
    pub fn panels(&self) -> usize {
        self.n.div_ceil(self.columns)
    }

    /// Rows `from..to` of one panel, `[to - from, columns]`.
    pub fn panel_rows(&self, panel: usize, from: usize, to: usize) -> &[f32] {
        &self.data[(panel * self.k + from) * self.columns..(panel * self.k + to) * self.columns]
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val::<[f32]>(&self.data)
    }
}

/// Row-major rows: row `i` starts at `i * stride`.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a> {
    /// All rows.
    pub data: &'a [f32],
    /// Elements from one row to the next.
    pub stride: usize,
}

/// One panel of a right-hand side, cut along k into segments that need not be adjacent.
#[derive(Debug, Clone, Copy)]
pub struct Panel<'a> {
    /// From the first element of the first segment; each segment is `[<= segment_rows, columns]`.
    pub data: &'a [f32],
    /// Length of the sums.
    pub k: usize,
    /// Rows of a segment; the last may be cut short by `k`.
    pub segment_rows: usize,
    /// Elements from one segment to the next.
    pub segment_stride: usize,
}

impl<'a> Panel<'a> {
    /// A panel in one piece, `[k, columns]`.
    pub fn whole(data: &'a [f32], k: usize) -> Self {
        Self { data, k, segment_rows: k.max(1), segment_stride: 0 }
    }

    fn extent(&self, columns: usize) -> usize {
        match self.k.checked_sub(1) {
            None => 0,
            Some(last) => last / self.segment_rows * self.segment_stride + (last % self.segment_rows + 1) * columns,
        }
    }
}

/// `out = left x panel`, or `out += left x panel` if `accumulate`, for `rows` rows (a multiple of [`Tiling::rows`]);
/// row `i` of the result is the first `columns` elements at `out[i * out_stride]`.
///
/// # Panics
/// If a slice is too short for what it is said to hold.
pub fn multiply_panel(
    simd: Simd,
    rows: usize,
    left: Rows<'_>,
    panel: Panel<'_>,
    out: &mut [f32],
    out_stride: usize,
    accumulate: bool,
) {
    let tile = Tiling::of(simd);
    assert_eq!(rows % tile.rows, 0, "rows must be whole tiles");
    if rows == 0 {
        return;
    }
    assert!(left.data.len() >= (rows - 1) * left.stride + panel.k, "left-hand side too short");
    assert!(panel.data.len() >= panel.extent(tile.columns), "panel too short");
    assert!(out.len() >= (rows - 1) * out_stride + tile.columns, "result too short");
    let job = TileJob {
        rows,
        left: left.data.as_ptr(),
        left_stride: left.stride,
        right: panel.data.as_ptr(),
        k: panel.k,
        segment_rows: panel.segment_rows,
        segment_stride: panel.segment_stride,
        out: out.as_mut_ptr(),
        out_stride,
        accumulate,
    };
    at_level!(
        simd,
        (job: &TileJob = &job),
        job.run::<Portable, 4, 1>(),
        job.run::<Avx2, 6, 2>(),
        job.run::<Avx512, 8, 2>(),
    );
}

/// The checked arguments of [`multiply_panel`].
struct TileJob {
    rows: usize,
    left: *const f32,
    left_stride: usize,
    right: *const f32,
    k: usize,
    segment_rows: usize,
    segment_stride: usize,
    out: *mut f32,
    out_stride: usize,
    accumulate: bool,
}

impl TileJob {
    #[inline(always)]
    unsafe fn run<V: Lanes, const MR: usize, const NV: usize>(&self) {
        for row in (0..self.rows).step_by(MR) {
            // SAFETY: `multiply_panel` has checked that MR rows from here lie inside both slices.
            unsafe {
                self.tile::<V, MR, NV>(self.left.add(row * self.left_stride), self.out.add(row * self.out_stride));
            }
        }
    }

    // Pointers advance by `wrapping_add` because builds with assertions check `add` at every step, which this loop cannot
    // afford; `multiply_panel` has checked once that every access lies inside its slice.
    #[allow(clippy::needless_range_loop)] // Indices keep the sums in registers; iterators leave them in memory.
    #[inline(always)]
    unsafe fn tile<V: Lanes, const MR: usize, const NV: usize>(&self, left: *const f32, out: *mut f32) {
        let vectors: [usize; NV] = std::array::from_fn(|vector| vector * V::COUNT);
        let mut rows: [*const f32; MR] = std::array::from_fn(|row| left.wrapping_add(row * self.left_stride));
        let places: [*mut f32; MR] = std::array::from_fn(|row| out.wrapping_add(row * self.out_stride));
        // SAFETY: the extents were checked by `multiply_panel`; the level's instructions are available.
        unsafe {
            let mut sums = [[V::splat(0.0); NV]; MR];
            if self.accumulate {
                for row in 0..MR {
                    for vector in 0..NV {
                        sums[row][vector] = V::load(places[row].wrapping_add(vectors[vector]));
                    }
                }
            }
            let (mut segment, mut remaining) = (self.right, self.k);
            while remaining > 0 {
                let count = remaining.min(self.segment_rows);
                let mut right = segment;
                for at in 0..count {
                    let mut columns = [V::splat(0.0); NV];
                    for vector in 0..NV {
                        columns[vector] = V::load(right.wrapping_add(vectors[vector]));
                    }
                    for row in 0..MR {
                        let factor = V::broadcast(rows[row].wrapping_add(at));
                        for vector in 0..NV {
                            sums[row][vector] = factor.mul_add(columns[vector], sums[row][vector]);
                        }
                    }
                    right = right.wrapping_add(NV * V::COUNT);
                }
                rows = rows.map(|row| row.wrapping_add(count));
                remaining -= count;
                segment = segment.wrapping_add(self.segment_stride);
            }
            for row in 0..MR {
                for vector in 0..NV {
                    sums[row][vector].store(places[row].wrapping_add(vectors[vector]));
                }
            }
        }
    }
}

/// The kernel against a plain sum on small odd sizes.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    use super::testing::{differ, ramp};
    let tile = Tiling::of(simd);
    for (k, n) in [(1, 1), (7, 37), (61, 64)] {
        let (rows, stride) = (2 * tile.rows, k + 3);
        let (left, right) = (ramp(rows * stride, 1), ramp(k * n, 2));
        let packed = PackedMatrix::pack(simd, k, n, |row, column| right[row * n + column]);
        for panel in 0..packed.panels() {
            let mut out = vec![0.5; rows * tile.columns];
            let whole = Panel::whole(packed.panel_rows(panel, 0, k), k);
            multiply_panel(simd, rows, Rows { data: &left, stride }, whole, &mut out, tile.columns, true);
            for (index, &actual) in out.iter().enumerate() {
                let (row, column) = (index / tile.columns, panel * tile.columns + index % tile.columns);
                let term = |i: usize| f64::from(left[row * stride + i]) * f64::from(right[i * n + column]);
                let expected = 0.5 + if column < n { (0..k).map(term).sum::<f64>() } else { 0.0 };
                if differ(actual, expected, 1e-4) {
                    return Err(format!("k {k}, n {n}, row {row}, column {column}: {actual} is not {expected}"));
                }
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::ramp;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn equals_the_plain_sum(k in 1usize..90, n in 1usize..70, tiles in 1usize..4, seed in 0u32..1000) {
            for simd in Simd::all() {
                let tile = Tiling::of(simd);
                let rows = tiles * tile.rows;
                let (left, right) = (ramp(rows * k, seed), ramp(k * n, seed + 1));
                let packed = PackedMatrix::pack(simd, k, n, |row, column| right[row * n + column]);
                let mut out = vec![f32::NAN; rows * tile.columns];
                for panel in 0..packed.panels() {
                    let whole = Panel::whole(packed.panel_rows(panel, 0, k), k);
                    multiply_panel(simd, rows, Rows { data: &left, stride: k }, whole, &mut out, tile.columns, false);
                    for row in 0..rows {
                        for lane in 0..tile.columns.min(n - panel * tile.columns) {
                            let column = panel * tile.columns + lane;
                            let expected: f64 = (0..k)
                                .map(|i| f64::from(left[row * k + i]) * f64::from(right[i * n + column])).sum();
                            prop_assert!((f64::from(out[row * tile.columns + lane]) - expected).abs() < 1e-4);
                        }
                    }
                }
            }
        }

        #[test]
        fn segments_give_bit_for_bit_what_one_piece_gives(k in 1usize..60, segment_rows in 1usize..20) {
            for simd in Simd::all() {
                let tile = Tiling::of(simd);
                let (left, right) = (ramp(tile.rows * k, 3), ramp(k * tile.columns, 4));
                let segment_stride = segment_rows * tile.columns + 5;
                let mut scattered = vec![f32::NAN; k.div_ceil(segment_rows) * segment_stride];
                for row in 0..k {
                    let at = row / segment_rows * segment_stride + row % segment_rows * tile.columns;
                    scattered[at..at + tile.columns]
                        .copy_from_slice(&right[row * tile.columns..(row + 1) * tile.columns]);
                }
                let run = |panel| {
                    let mut out = vec![0.0; tile.rows * tile.columns];
                    let left = Rows { data: &left, stride: k };
                    multiply_panel(simd, tile.rows, left, panel, &mut out, tile.columns, false);
                    out
                };
                let panel = Panel { data: &scattered, k, segment_rows, segment_stride };
                prop_assert_eq!(run(panel), run(Panel::whole(&right, k)));
            }
        }
    }

    #[test]
    #[should_panic(expected = "panel too short")]
    fn a_short_panel_is_refused() {
        let tile = Tiling::of(Simd::SCALAR);
        let left = Rows { data: &[0.0; 64], stride: 8 };
        multiply_panel(Simd::SCALAR, tile.rows, left, Panel::whole(&[0.0; 9], 8), &mut [0.0; 64], 8, false);
    }
}

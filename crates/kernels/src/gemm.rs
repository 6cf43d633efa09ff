//! Matrix products with the right-hand side packed once: the linear layers of the transformer, and
//! the two products of attention, in any [`Format`].
//!
//! The right-hand side lies in panels of [`Tiling::columns`] columns, `[panel][k in
//! words][columns]`, so that a register tile of [`Tiling::rows`] x `columns` sums reads it in
//! order. The left-hand side stays row-major. One call multiplies a whole block of rows with one
//! panel, which thereby stays in the first-level cache, and leaves a small dense block that the
//! caller's epilogue reads while it is hot.
//!
//! Every sum runs over k in ascending order whatever the number of rows or threads, so a row's
//! result depends on nothing but that row.

use super::Simd;
use super::aligned::AlignedBuffer;
#[cfg(target_arch = "x86_64")]
use super::dot::{Avx512Bf16, Avx512Int8};
use super::dot::{Dot, PortableBf16, PortableInt8};
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::lanes::{Portable, at_bf16_level, at_level};
use super::operand::{Format, Rows};
use super::simd::SimdLevel;
#[cfg(target_arch = "x86_64")]
use super::tiles;

/// Sums held in registers at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tiling {
    /// Rows of the left-hand side.
    pub rows: usize,
    /// Rows come in multiples of this; those that fill no tile are multiplied so many at a time,
    /// which is slower.
    pub row_step: usize,
    /// Columns of the right-hand side: the width of a panel.
    pub columns: usize,
}

impl Tiling {
    /// The tile of a level: as many sums as its registers hold beside one row of the panel.
    pub fn of(simd: Simd) -> Self {
        match simd.level() {
            SimdLevel::Scalar => Self {
                rows: 4,
                row_step: 4,
                columns: 8,
            },
            SimdLevel::Avx2 => Self {
                rows: 6,
                row_step: 2,
                columns: 16,
            },
            SimdLevel::Avx512 => Self {
                rows: 12,
                row_step: 4,
                columns: 32,
            },
            // Two matrix registers wide; their height, of which twice as many rows are taken at
            // once where there are.
            SimdLevel::Amx => Self {
                rows: 16,
                row_step: 16,
                columns: 32,
            },
        }
    }
}

/// What turns a panel's integer sums into numbers.
#[derive(Debug, Clone, Copy)]
pub struct PanelCodes<'a> {
    /// What a code of each column is worth.
    pub factors: &'a [f32],
    /// What the left-hand side's offset of 128 adds to the sum of each column.
    pub offsets: &'a [i32],
}

/// A `[k, n]` matrix in panels; columns beyond n are zero.
#[derive(Debug, Clone)]
pub struct PackedMatrix {
    format: Format,
    data: AlignedBuffer<u32>,
    k: usize,
    n: usize,
    columns: usize,
    /// Rows of k that are multiplied at a time.
    slice: usize,
    /// Of each column; empty unless the format is int8.
    factors: Vec<f32>,
    /// `[slices][columns]`, likewise.
    offsets: Vec<i32>,
}

impl PackedMatrix {
    /// Packs the matrix whose element in row `k` and column `n` is `element(k, n)`, to be
    /// multiplied by `slice` rows at a time (k for all).
    ///
    /// # Panics
    /// If slices are not whole words.
    pub fn pack(
        simd: Simd,
        format: Format,
        (k, n): (usize, usize),
        slice: usize,
        element: impl Fn(usize, usize) -> f32,
    ) -> Self {
        assert!(
            slice >= k || slice.is_multiple_of(format.per_word()),
            "slices must be whole words"
        );
        let (columns, words) = (Tiling::of(simd).columns, format.words(k));
        let (padded, slices) = (n.next_multiple_of(columns), k.div_ceil(slice.max(1)));
        let mut packed = Self {
            format,
            data: AlignedBuffer::zeroed(padded * words),
            k,
            n,
            columns,
            slice,
            factors: vec![0.0; if format == Format::Int8 { padded } else { 0 }],
            offsets: vec![
                0;
                if format == Format::Int8 {
                    padded * slices
                } else {
                    0
                }
            ],
        };
        let mut values = vec![0.0; words * format.per_word()];
        for column in 0..n {
            values[..k]
                .iter_mut()
                .enumerate()
                .for_each(|(row, value)| *value = element(row, column));
            packed.pack_column(column, words, &values);
        }
        packed
    }

    fn pack_column(&mut self, column: usize, words: usize, values: &[f32]) {
        let largest = values
            .iter()
            .fold(f32::MIN_POSITIVE * 256.0, |a, b| a.max(b.abs()));
        // Rounds to the nearest, ties to even, like `round_ties_even`, which is a call where SSE4.1
        // is not a given: beyond 2^23 floats have no fraction left.
        const TO_WHOLE: f32 = 12_582_912.0;
        let code = |value: f32| (value / largest * 127.0 + TO_WHOLE - TO_WHOLE) as i8;
        let place = column / self.columns * words * self.columns + column % self.columns;
        for (word, numbers) in values.chunks_exact(self.format.per_word()).enumerate() {
            self.data[place + word * self.columns] = match *numbers {
                [value] => value.to_bits(),
                [low, high] => {
                    let bits = |value| u32::from(half::bf16::from_f32(value).to_bits());
                    bits(low) | bits(high) << 16
                }
                _ => u32::from_le_bytes(std::array::from_fn(|part| {
                    code(numbers[part]).cast_unsigned()
                })),
            };
        }
        if self.format == Format::Int8 {
            self.factors[column] = largest / 127.0;
            let padded = self.factors.len();
            for (slice, values) in values[..self.k].chunks(self.slice).enumerate() {
                self.offsets[slice * padded + column] =
                    128 * values.iter().map(|&v| i32::from(code(v))).sum::<i32>();
            }
        }
    }

    /// How its numbers are stored.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Columns.
    pub fn n(&self) -> usize {
        self.n
    }

    /// Panels, the last possibly not full.
    pub fn panels(&self) -> usize {
        self.n.div_ceil(self.columns)
    }

    /// Slice `slice` of one panel.
    pub fn panel(&self, panel: usize, slice: usize) -> Panel<'_> {
        let (from, to) = (slice * self.slice, self.k.min((slice + 1) * self.slice));
        let (start, words) = (
            panel * self.format.words(self.k),
            self.format.words(to) - self.format.words(from),
        );
        let first = (start + self.format.words(from)) * self.columns;
        Panel::whole(&self.data[first..first + words * self.columns], words)
    }

    /// What turns that slice's sums into numbers; `None` where they are numbers already.
    pub fn codes(&self, panel: usize, slice: usize) -> Option<PanelCodes<'_>> {
        let at = panel * self.columns;
        let offsets = slice * self.factors.len() + at;
        (self.format == Format::Int8).then(|| PanelCodes {
            factors: &self.factors[at..at + self.columns],
            offsets: &self.offsets[offsets..offsets + self.columns],
        })
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val::<[u32]>(&self.data)
            + size_of_val(&self.factors[..])
            + size_of_val(&self.offsets[..])
    }
}

/// One panel of a right-hand side, cut along k into segments that need not be adjacent.
#[derive(Debug, Clone, Copy)]
pub struct Panel<'a> {
    /// From the first word of the first segment; each segment is `[<= segment_rows, columns]`.
    pub data: &'a [u32],
    /// Length of the sums in words.
    pub k: usize,
    /// Rows of a segment; the last may be cut short by `k`.
    pub segment_rows: usize,
    /// Words from one segment to the next.
    pub segment_stride: usize,
}

impl<'a> Panel<'a> {
    /// A panel in one piece, `[k, columns]`.
    pub fn whole(data: &'a [u32], k: usize) -> Self {
        Self {
            data,
            k,
            segment_rows: k.max(1),
            segment_stride: 0,
        }
    }

    /// Words up to the end of the segment that reaches farthest: the last, as long as segments do
    /// not lie across each other; `None` if they do, or no memory holds that many.
    fn extent(&self, columns: usize) -> Option<usize> {
        let Some(last) = self.k.checked_sub(1) else {
            return Some(0);
        };
        let segment = last.checked_div(self.segment_rows)?;
        if segment > 0 && self.segment_stride < self.segment_rows.checked_mul(columns)? {
            return None;
        }
        let rest = (last % self.segment_rows + 1).checked_mul(columns)?;
        segment.checked_mul(self.segment_stride)?.checked_add(rest)
    }
}

/// Keeps this thread ready for products: where there are matrix registers, they stay configured
/// until the last of these is dropped. Products do without, only slower.
#[must_use = "dropped at once, it speeds nothing up"]
pub struct Readiness {
    #[cfg(target_arch = "x86_64")]
    _registers: Option<tiles::Registers>,
}

impl Readiness {
    /// Of the thread that calls.
    pub fn new(simd: Simd) -> Self {
        let _ = simd;
        Self {
            #[cfg(target_arch = "x86_64")]
            _registers: (simd.level() == SimdLevel::Amx).then(|| tiles::Registers::take(simd)),
        }
    }
}

/// `out = left x panel` for `rows` rows (a multiple of [`Tiling::row_step`]); row `i` of the result
/// is the first `columns` elements at `out[i * out_stride]`. Both sides are in `format`; for int8
/// the results are the bits of i32.
///
/// # Panics
/// If a slice is too short for what it is said to hold, or the format is not available at this
/// level.
pub fn multiply_panel(
    simd: Simd,
    format: Format,
    rows: usize,
    left: Rows<'_>,
    panel: Panel<'_>,
    out: &mut [f32],
    out_stride: usize,
) {
    let tile = Tiling::of(simd);
    assert_eq!(rows % tile.row_step, 0, "rows must be whole steps");
    if rows == 0 {
        return;
    }
    assert!(
        covers(left.data.len(), rows, left.stride, panel.k),
        "left-hand side too short"
    );
    assert!(
        panel
            .extent(tile.columns)
            .is_some_and(|extent| panel.data.len() >= extent),
        "panel too short"
    );
    assert!(
        covers(out.len(), rows, out_stride, tile.columns),
        "result too short"
    );
    let job = TileJob {
        rows,
        left: left.data.as_ptr(),
        left_stride: left.stride,
        right: panel.data.as_ptr(),
        k: panel.k,
        segment_rows: panel.segment_rows,
        segment_stride: panel.segment_stride,
        out: out.as_mut_ptr().cast(),
        out_stride,
        adds: false,
    };
    #[cfg(target_arch = "x86_64")]
    if simd.level() == SimdLevel::Amx {
        return job.run_tiles(simd, format);
    }
    match format {
        Format::F32 => at_level!(
            simd,
            (job: &TileJob = &job),
            job.run::<Portable, 4, 4, 1>(),
            job.run::<Avx2, 6, 2, 2>(),
            job.run::<Avx512, 12, 4, 2>(),
        ),
        Format::Bf16 => at_bf16_level!(
            simd,
            (job: &TileJob = &job),
            job.run::<PortableBf16, 4, 4, 1>(),
            job.run::<PortableBf16, 6, 2, 2>(),
            job.run::<Avx512Bf16, 12, 4, 2>(),
        ),
        Format::Int8 => at_level!(
            simd,
            (job: &TileJob = &job),
            job.run::<PortableInt8, 4, 4, 1>(),
            job.run::<PortableInt8, 6, 2, 2>(),
            job.run::<Avx512Int8, 12, 4, 2>(),
        ),
    }
}

/// Whether `len` elements hold `rows` (at least one) rows of `width`, each `stride` after the one
/// before.
pub(super) fn covers(len: usize, rows: usize, stride: usize, width: usize) -> bool {
    let end = (rows - 1)
        .checked_mul(stride)
        .and_then(|start| start.checked_add(width));
    end.is_some_and(|end| len >= end)
}

/// The checked arguments of [`multiply_panel`].
#[derive(Clone, Copy)]
pub(super) struct TileJob {
    pub rows: usize,
    pub left: *const u32,
    pub left_stride: usize,
    pub right: *const u32,
    pub k: usize,
    pub segment_rows: usize,
    pub segment_stride: usize,
    pub out: *mut u32,
    pub out_stride: usize,
    /// Whether the sums go on from what `out` holds.
    adds: bool,
}

impl TileJob {
    /// As much of the sums as fills matrix registers there, the rest of k in vectors.
    #[cfg(target_arch = "x86_64")]
    fn run_tiles(&self, simd: Simd, format: Format) {
        let whole = match format {
            Format::F32 => 0,
            // A step of the tiles must not reach across the end of a segment.
            _ if self.k > self.segment_rows && !self.segment_rows.is_multiple_of(tiles::STEP) => 0,
            _ => self.k / tiles::STEP * tiles::STEP,
        };
        let mut rest = *self;
        if whole > 0 {
            // SAFETY: `multiply_panel` has checked the extents, of which this is a part, and that
            // rows are whole tiles; segments are whole steps.
            unsafe { tiles::multiply(simd, format, &Self { k: whole, ..*self }) };
            if whole == self.k {
                return;
            }
            let (segment, within) = (whole / self.segment_rows, whole % self.segment_rows);
            rest.left = self.left.wrapping_add(whole);
            rest.right = self
                .right
                .wrapping_add(segment * self.segment_stride + within * Tiling::of(simd).columns);
            rest.k -= whole;
            // What is left lies in one segment.
            rest.segment_rows = rest.k;
            rest.adds = true;
        }
        // SAFETY: `multiply_panel` has checked the extents, of which this is the rest; AMX includes
        // these instructions.
        unsafe {
            match format {
                Format::F32 => rest_f32(&rest),
                Format::Bf16 => rest_bf16(&rest),
                Format::Int8 => rest_int8(&rest),
            }
        }
    }

    #[inline(always)]
    unsafe fn run<D: Dot, const MR: usize, const STEP: usize, const NV: usize>(&self) {
        let whole = self.rows / MR * MR;
        // SAFETY: `multiply_panel` has checked that all rows, which are whole steps, lie inside
        // both slices.
        unsafe {
            for row in (0..whole).step_by(MR) {
                self.tile::<D, MR, NV>(
                    self.left.add(row * self.left_stride),
                    self.out.add(row * self.out_stride),
                );
            }
            for row in (whole..self.rows).step_by(STEP) {
                self.tile::<D, STEP, NV>(
                    self.left.add(row * self.left_stride),
                    self.out.add(row * self.out_stride),
                );
            }
        }
    }

    // Pointers advance by `wrapping_add` because builds with assertions check `add` at every step,
    // which this loop cannot afford; `multiply_panel` has checked once that every access lies
    // inside its slice.
    #[allow(
        clippy::needless_range_loop,
        reason = "indices keep the sums in registers; iterators leave them in memory"
    )]
    #[inline(always)]
    unsafe fn tile<D: Dot, const MR: usize, const NV: usize>(
        &self,
        left: *const u32,
        out: *mut u32,
    ) {
        let vectors: [usize; NV] = std::array::from_fn(|vector| vector * D::COUNT);
        let mut rows: [*const u32; MR] =
            std::array::from_fn(|row| left.wrapping_add(row * self.left_stride));
        // SAFETY: the extents were checked by `multiply_panel`; the level's instructions are
        // available.
        unsafe {
            let mut sums = [[D::zero(); NV]; MR];
            if self.adds {
                for row in 0..MR {
                    for vector in 0..NV {
                        sums[row][vector] =
                            D::load(out.wrapping_add(row * self.out_stride + vectors[vector]));
                    }
                }
            }
            let (mut segment, mut remaining) = (self.right, self.k);
            while remaining > 0 {
                let count = remaining.min(self.segment_rows);
                let mut right = segment;
                for at in 0..count {
                    let mut columns = [D::zero(); NV];
                    for vector in 0..NV {
                        columns[vector] = D::load(right.wrapping_add(vectors[vector]));
                    }
                    for row in 0..MR {
                        let word = D::broadcast(rows[row].wrapping_add(at));
                        for vector in 0..NV {
                            sums[row][vector] = sums[row][vector].add_dot(word, columns[vector]);
                        }
                    }
                    right = right.wrapping_add(NV * D::COUNT);
                }
                rows = rows.map(|row| row.wrapping_add(count));
                remaining -= count;
                segment = segment.wrapping_add(self.segment_stride);
            }
            for row in 0..MR {
                for vector in 0..NV {
                    sums[row][vector]
                        .store(out.wrapping_add(row * self.out_stride + vectors[vector]));
                }
            }
        }
    }
}

/// What tiles leave over, half a tile's height at a time: its sums fill half of the vector
/// registers.
macro_rules! rest {
    ($name:ident, $dot:ty, $features:literal) => {
        /// # Safety
        /// The CPU has the instructions; the job's extents are checked.
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = $features)]
        unsafe fn $name(job: &TileJob) {
            // SAFETY: the caller's.
            unsafe { job.run::<$dot, 8, 8, 2>() }
        }
    };
}

rest!(rest_f32, Avx512, "avx512f,avx512bw,avx512dq,avx512vl");
rest!(
    rest_bf16,
    Avx512Bf16,
    "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16"
);
rest!(
    rest_int8,
    Avx512Int8,
    "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni"
);

/// The kernel against a plain sum on small odd sizes, in every format of the level.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    for format in Format::ALL
        .into_iter()
        .filter(|format| format.is_available(simd))
    {
        for (k, n, slice) in [(16, 1, 16), (48, 37, 32), (64, 64, 64)] {
            compare_with_plain_sums(simd, format, 2, (k, n), slice)?;
        }
    }
    Ok(())
}

/// Multiplies as the transformer does, slice by slice through the epilogue, and compares with f64
/// sums over what both sides hold.
fn compare_with_plain_sums(
    simd: Simd,
    format: Format,
    tiles: usize,
    (k, n): (usize, usize),
    slice: usize,
) -> Result<(), String> {
    use super::elementwise::{Epilogue, Product, finish_block};
    use super::operand::OperandBuffer;
    use super::testing::{differ, ramp};
    let (tile, stride) = (Tiling::of(simd), k + 3);
    let rows = tiles * tile.rows + tile.row_step;
    let (left, right) = (ramp(rows * stride, 1), ramp(k * n, 2));
    let matrix = PackedMatrix::pack(simd, format, (k, n), slice, |row, column| {
        right[row * n + column]
    });
    let bias = vec![0.25; tile.columns];
    // A code is off by half a step of its row or column; a sum of k products by what that adds up
    // to, and rarely so much.
    let tolerance = match format {
        Format::F32 => 1e-4,
        Format::Bf16 => 4e-3 * (k as f64).sqrt() + 1e-3,
        Format::Int8 => 1e-2 * (k as f64).sqrt() + 1e-3,
    };
    for panel in 0..matrix.panels() {
        let mut out = vec![0.5f32; rows * tile.columns];
        for (index, from) in (0..k).step_by(slice).enumerate() {
            let mut buffer = OperandBuffer::default();
            let width = slice.min(k - from);
            let packed = buffer.pack(simd, format, rows, width, (&left[from..], stride));
            let mut block = vec![f32::NAN; rows * tile.columns];
            multiply_panel(
                simd,
                format,
                rows,
                packed.rows,
                matrix.panel(panel, index),
                &mut block,
                tile.columns,
            );
            let bias = if index == 0 { Some(&bias[..]) } else { None };
            let product = Product {
                rows,
                block: &block,
                codes: matrix.codes(panel, index),
                factors: packed.factors,
                bias,
            };
            finish_block(
                simd,
                Epilogue::BiasResidual,
                product,
                &mut out,
                tile.columns,
            );
        }
        for (at, &actual) in out.iter().enumerate() {
            let (row, column) = (at / tile.columns, panel * tile.columns + at % tile.columns);
            let term =
                |i: usize| f64::from(left[row * stride + i]) * f64::from(right[i * n + column]);
            let expected = 0.75
                + if column < n {
                    (0..k).map(term).sum::<f64>()
                } else {
                    0.0
                };
            if differ(actual, expected, tolerance) {
                return Err(format!(
                    "{format:?}, k {k}, n {n}, row {row}, column {column}: {actual} is not {expected}"
                ));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;

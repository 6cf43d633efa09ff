//! Matrix products whose right-hand side is packed once and used many times: the linear layers of
//! the transformer, and the two products of attention, in any [`Format`].
//!
//! A product is fast if every number that is read from memory takes part in many multiply-adds. So
//! a block of sums (a register tile, [`Tiling`]) stays in registers while the sum runs, and the
//! right-hand side is stored in the order in which tiles read it: cut into panels of
//! [`Tiling::columns`] columns, `[panel][k in words][columns]`. The left-hand side stays row-major.
//!
//! One call multiplies a block of rows with one panel, which stays in the first-level cache
//! meanwhile. The result is a small dense block that the caller's epilogue reads while it is still
//! in the cache.
//!
//! Every sum runs over k in ascending order, whatever the number of rows or threads, so the result
//! of a row depends on nothing but that row.

#[cfg(target_arch = "x86_64")]
mod amx;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod check;
mod dot;
mod job;
mod packed;
mod scalar;
#[cfg(test)]
mod tests;
mod tile;

use crate::dispatch::dispatch;
use crate::operand::{Format, WordRows};
use crate::{Simd, SimdLevel};
pub(crate) use check::check;
use job::PanelJob;
pub use packed::{PackedMatrix, PanelCodes};

/// The size of the block of sums that a level keeps in registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tiling {
    /// Rows of the left-hand side.
    pub rows: usize,
    /// Products take multiples of this many rows. Rows beyond the last whole tile are multiplied
    /// `row_step` at a time, which is slower.
    pub row_step: usize,
    /// Columns of the right-hand side: the width of a panel.
    pub columns: usize,
}

impl Tiling {
    /// The tile of a level: as many sums as fit into its registers together with one row of the
    /// panel.
    pub fn of(simd: Simd) -> Self {
        let (rows, row_step, columns) = match simd.level() {
            SimdLevel::Scalar => (4, 4, 8),
            SimdLevel::Avx2 => (6, 2, 16),
            SimdLevel::Avx512 => (12, 4, 32),
            // A matrix register is 16 rows high and 16 sums wide. Two of them side by side make a
            // tile; if there are 32 rows or more, two tiles are computed at once.
            SimdLevel::Amx => (16, 16, 32),
        };
        Self {
            rows,
            row_step,
            columns,
        }
    }
}

/// One panel of a right-hand side. Along k it may be cut into segments that need not be adjacent,
/// as the values of attention are, which are written chunk by chunk.
#[derive(Debug, Clone, Copy)]
pub struct RightPanel<'a> {
    /// From the first word of the first segment on; a segment is `[segment_rows, columns]`.
    pub data: &'a [u32],
    /// Length of the sums in words.
    pub k: usize,
    /// Rows of a segment; the last one ends where `k` does.
    pub segment_rows: usize,
    /// Words from the start of one segment to that of the next.
    pub segment_stride: usize,
}

impl<'a> RightPanel<'a> {
    /// A panel in one piece, `[k, columns]`.
    pub fn whole(data: &'a [u32], k: usize) -> Self {
        Self {
            data,
            k,
            segment_rows: k.max(1),
            segment_stride: 0,
        }
    }

    /// The number of words up to the end of the last segment. `None` if segments overlap, so that
    /// the last one need not be the one that ends last, or if no memory holds that many words.
    fn extent(&self, columns: usize) -> Option<usize> {
        let Some(last) = self.k.checked_sub(1) else {
            return Some(0);
        };
        let segment = last.checked_div(self.segment_rows)?;
        if segment > 0 && self.segment_stride < self.segment_rows.checked_mul(columns)? {
            return None;
        }
        let rows_of_last = last % self.segment_rows + 1;
        let start = segment.checked_mul(self.segment_stride)?;
        start.checked_add(rows_of_last.checked_mul(columns)?)
    }
}

/// Keeps the matrix registers of AMX configured for this thread while it exists, which makes many
/// products in a row faster: otherwise every product configures and releases them, which takes as
/// long as half a product of 32 rows. At other levels it does nothing.
#[must_use = "the registers are released as soon as this is dropped"]
pub struct MatrixUnitGuard {
    #[cfg(target_arch = "x86_64")]
    _registers: Option<crate::registers::amx::Registers>,
}

impl MatrixUnitGuard {
    /// Configures the registers of the calling thread.
    #[cfg_attr(
        not(target_arch = "x86_64"),
        expect(unused_variables, reason = "AMX is x86 only")
    )]
    pub fn new(simd: Simd) -> Self {
        Self {
            #[cfg(target_arch = "x86_64")]
            _registers: (simd.level() == SimdLevel::Amx)
                .then(crate::registers::amx::Registers::configure),
        }
    }
}

/// Multiplies `rows` rows (a multiple of [`Tiling::row_step`]) of `left`, `[rows, k]`, with a
/// panel, `[k, columns]`, both in `format`. Row `i` of the result is the first [`Tiling::columns`]
/// elements at `out[i * out_stride]`. For int8 the elements are the bits of i32 sums of products of
/// codes.
///
/// # Panics
/// If a slice is too short for what it is said to hold, or the format is bf16 at
/// [`SimdLevel::Avx512`] on a CPU without AVX-512 BF16.
pub fn multiply_panel(
    simd: Simd,
    format: Format,
    rows: usize,
    left: WordRows<'_>,
    panel: RightPanel<'_>,
    out: &mut [f32],
    out_stride: usize,
) {
    if rows == 0 {
        return;
    }
    let mut job = PanelJob::new(
        simd,
        rows,
        left,
        panel,
        bytemuck::cast_slice_mut(out),
        out_stride,
    );
    let job = &mut job;
    match format {
        Format::F32 => dispatch!(simd, multiply_f32(job), amx),
        Format::Bf16 => dispatch!(simd, multiply_bf16(job), amx),
        Format::Int8 => dispatch!(simd, multiply_int8(job), amx),
    }
}

/// Whether `len` elements hold `rows` (at least one) rows of `width` elements, each starting
/// `stride` after the one before.
pub(crate) fn covers(len: usize, rows: usize, stride: usize, width: usize) -> bool {
    let start = (rows - 1).checked_mul(stride);
    let end = start.and_then(|start| start.checked_add(width));
    end.is_some_and(|end| len >= end)
}

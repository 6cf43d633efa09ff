//! AMX: products in matrix registers, each of sixteen rows of 64 bytes, and in AVX-512 registers
//! what does not fill them.
//!
//! One instruction multiplies sixteen rows of sixteen words with sixteen rows of sixteen columns.
//! Registers 0 to 3 hold the sums of 32 rows by 32 columns (two above two), 4 and 5 hold rows of
//! the left-hand side, 6 and 7 columns of the panel. If only sixteen rows are left, registers 2, 3
//! and 5 are idle.
//!
//! The stable compiler has no intrinsics for these instructions, so they are written in assembly.
//! Compiled code does not touch matrix registers: they keep their contents from one `asm!` block to
//! the next.

use super::dot::avx512::{Avx512Bf16Dot, Avx512Int8Dot};
use super::dot::{DotIsa, F32Dot};
use super::job::PanelJob;
use super::tile;
use crate::registers::amx::{ROWS, Registers, STEP};
use crate::registers::avx512::{Avx512Bf16Isa, Avx512Isa};
use std::arch::asm;

/// See [`super::multiply_panel`]; there are no matrix instructions for f32.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn multiply_f32(job: &mut PanelJob<'_>) {
    multiply_in_vectors(F32Dot(Avx512Isa::new()), job);
}

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx512bf16,popcnt")]
pub(super) fn multiply_bf16(job: &mut PanelJob<'_>) {
    let vectors = Avx512Bf16Dot(Avx512Bf16Isa::new());
    multiply_with::<Bf16Product>(vectors, job);
}

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn multiply_int8(job: &mut PanelJob<'_>) {
    let vectors = Avx512Int8Dot(Avx512Isa::new());
    multiply_with::<Int8Product>(vectors, job);
}

/// Multiplies as much of the sums as fills matrix registers there, the rest in vectors.
#[inline(always)]
fn multiply_with<P: MatrixProduct>(vectors: impl DotIsa, job: &mut PanelJob<'_>) {
    let whole = whole_steps(job);
    if whole == 0 {
        multiply_in_vectors(vectors, job);
        return;
    }
    multiply_in_matrices::<P>(&Registers::configure(), job.shortened(whole));
    if whole < job.k() {
        multiply_in_vectors(vectors, &mut job.remainder(whole));
    }
}

/// Words of k that make whole steps of the matrix instructions. A step must not reach across the
/// end of a segment, so there is none if segments are not whole steps long.
fn whole_steps(job: &PanelJob<'_>) -> usize {
    let in_one_segment = job.k() <= job.segment_rows();
    if in_one_segment || job.segment_rows().is_multiple_of(STEP) {
        job.k() / STEP * STEP
    } else {
        0
    }
}

/// Tiles of eight rows: sixteen rows are whole tiles, and their sums take half of the registers.
#[inline(always)]
fn multiply_in_vectors(isa: impl DotIsa, job: &mut PanelJob<'_>) {
    tile::multiply::<_, 8, 8, 2>(isa, job);
}

/// Computes a job of whole steps: its `k` and all its segments are as [`whole_steps`] has them.
fn multiply_in_matrices<P: MatrixProduct>(registers: &Registers, mut job: PanelJob<'_>) {
    let mut row = 0;
    while row < job.rows() {
        let pair = job.rows() - row >= 2 * ROWS;
        zero_sums(registers);
        for (start, segment) in job.segments() {
            let words = segment.len() / COLUMNS;
            assert!(
                words > 0 && words.is_multiple_of(STEP),
                "segments are whole steps"
            );
            let operands = Operands {
                upper: job.left_from(row)[start..].as_ptr(),
                left_stride: size_of::<u32>() * job.left_stride(),
                right: segment.as_ptr(),
                steps: words / STEP,
            };
            if pair {
                let lower = job.left_from(row + ROWS)[start..].as_ptr();
                // SAFETY: the segment holds `steps` times sixteen lines, and the left-hand side as
                // many words from `start` on in each of 32 rows (see `PanelJob`).
                unsafe { P::add_pair(registers, operands, lower) };
            } else {
                // SAFETY: as above, for sixteen rows.
                unsafe { P::add_single(registers, operands) };
            }
        }

        let out_stride = size_of::<u32>() * job.out_stride();
        let out = job.out_from(row).as_mut_ptr();
        // SAFETY: the result has 32 words in each of sixteen rows from here on (see `PanelJob`).
        unsafe { store_upper(registers, out, out_stride) };
        row += ROWS;
        if pair {
            let out = job.out_from(row).as_mut_ptr();
            // SAFETY: as above, for the other sixteen rows.
            unsafe { store_lower(registers, out, out_stride) };
            row += ROWS;
        }
    }
}

/// Columns of a panel.
const COLUMNS: usize = 32;

/// Bytes from one line of a panel to the next.
const LINE: usize = size_of::<u32>() * COLUMNS;

/// What the matrix instructions read: sixteen rows of the left-hand side, whose starts are
/// `left_stride` bytes apart, and the lines of a panel, for `steps` (not zero) steps.
struct Operands {
    upper: *const u32,
    left_stride: usize,
    right: *const u32,
    steps: usize,
}

/// The product of one format. The configured registers prove that the CPU has the instruction.
trait MatrixProduct {
    /// Adds the products of sixteen rows to the upper sums.
    ///
    /// # Safety
    /// The pointers must be valid for what `operands` says, sixteen words a step in each row and
    /// sixteen lines of [`COLUMNS`] words a step.
    unsafe fn add_single(registers: &Registers, operands: Operands);

    /// Adds the products of sixteen rows to the upper sums, and those of the sixteen rows from
    /// `lower` on to the lower sums.
    ///
    /// # Safety
    /// As [`add_single`](Self::add_single), and the same for `lower`.
    unsafe fn add_pair(registers: &Registers, operands: Operands, lower: *const u32);
}

/// Implements [`MatrixProduct`] by one instruction, given by its name.
macro_rules! matrix_product {
    ($name:ident, $instruction:literal) => {
        struct $name;

        impl MatrixProduct for $name {
            #[inline(always)]
            unsafe fn add_single(_: &Registers, operands: Operands) {
                // SAFETY: reads only what the caller guarantees, through configured registers.
                unsafe {
                    asm!(
                        "2:",
                        "tileloadd tmm6, [{right} + {line}*1]",
                        "tileloadd tmm7, [{right} + {line}*1 + 64]",
                        "tileloadd tmm4, [{upper} + {stride}*1]",
                        concat!($instruction, " tmm0, tmm4, tmm6"),
                        concat!($instruction, " tmm1, tmm4, tmm7"),
                        "add {upper}, 64",
                        "add {right}, 2048",
                        "dec {steps}",
                        "jnz 2b",
                        upper = inout(reg) operands.upper => _,
                        right = inout(reg) operands.right => _,
                        steps = inout(reg) operands.steps => _,
                        stride = in(reg) operands.left_stride,
                        line = in(reg) LINE,
                        options(nostack, readonly),
                    );
                }
            }

            #[inline(always)]
            unsafe fn add_pair(_: &Registers, operands: Operands, lower: *const u32) {
                // SAFETY: reads only what the caller guarantees, through configured registers.
                unsafe {
                    asm!(
                        "2:",
                        "tileloadd tmm4, [{upper} + {stride}*1]",
                        "tileloadd tmm6, [{right} + {line}*1]",
                        concat!($instruction, " tmm0, tmm4, tmm6"),
                        "tileloadd tmm7, [{right} + {line}*1 + 64]",
                        concat!($instruction, " tmm1, tmm4, tmm7"),
                        "tileloadd tmm5, [{lower} + {stride}*1]",
                        concat!($instruction, " tmm2, tmm5, tmm6"),
                        concat!($instruction, " tmm3, tmm5, tmm7"),
                        "add {upper}, 64",
                        "add {lower}, 64",
                        "add {right}, 2048",
                        "dec {steps}",
                        "jnz 2b",
                        upper = inout(reg) operands.upper => _,
                        lower = inout(reg) lower => _,
                        right = inout(reg) operands.right => _,
                        steps = inout(reg) operands.steps => _,
                        stride = in(reg) operands.left_stride,
                        line = in(reg) LINE,
                        options(nostack, readonly),
                    );
                }
            }
        }
    };
}

matrix_product!(Bf16Product, "tdpbf16ps");
matrix_product!(Int8Product, "tdpbusd");

/// Writes the upper sums to sixteen rows of [`COLUMNS`] words, `stride` bytes apart.
///
/// # Safety
/// `out` must be valid for writing that much.
#[inline(always)]
unsafe fn store_upper(_: &Registers, out: *mut u32, stride: usize) {
    // SAFETY: writes only what the caller guarantees, from configured registers.
    unsafe {
        asm!(
            "tilestored [{out} + {stride}*1], tmm0",
            "tilestored [{out} + {stride}*1 + 64], tmm1",
            out = in(reg) out,
            stride = in(reg) stride,
            options(nostack, preserves_flags),
        );
    }
}

/// As [`store_upper`], for the lower sums.
///
/// # Safety
/// As [`store_upper`].
#[inline(always)]
unsafe fn store_lower(_: &Registers, out: *mut u32, stride: usize) {
    // SAFETY: writes only what the caller guarantees, from configured registers.
    unsafe {
        asm!(
            "tilestored [{out} + {stride}*1], tmm2",
            "tilestored [{out} + {stride}*1 + 64], tmm3",
            out = in(reg) out,
            stride = in(reg) stride,
            options(nostack, preserves_flags),
        );
    }
}

/// Zeroes the four registers of sums.
#[inline(always)]
fn zero_sums(_: &Registers) {
    // SAFETY: touches no memory, and no registers but those of sums; `Registers` proves that they
    // are configured.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            options(nostack, preserves_flags, nomem),
        );
    }
}

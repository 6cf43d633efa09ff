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
    multiply_with(bf16_product, vectors, job);
}

/// See [`super::multiply_panel`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,popcnt")]
pub(super) fn multiply_int8(job: &mut PanelJob<'_>) {
    let vectors = Avx512Int8Dot(Avx512Isa::new());
    multiply_with(int8_product, vectors, job);
}

/// Multiplies as much of the sums as fills matrix registers there, the rest in vectors.
#[inline(always)]
fn multiply_with(
    matrix_product: fn(&Registers, PanelJob<'_>),
    vectors: impl DotIsa,
    job: &mut PanelJob<'_>,
) {
    let whole = whole_steps(job);
    if whole == 0 {
        multiply_in_vectors(vectors, job);
        return;
    }
    matrix_product(&Registers::configure(), job.shortened(whole));
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

/// The product by one instruction, given by its name.
macro_rules! matrix_product {
    ($name:ident, $instruction:literal) => {
        /// The job's `k` and all its segments must be whole steps long, as [`whole_steps`] has it.
        fn $name(registers: &Registers, mut job: PanelJob<'_>) {
            // Strides in bytes, and those of the lines of a panel of 32 columns.
            let left_stride = 4 * job.left_stride();
            let out_stride = 4 * job.out_stride();
            let line = 128usize;

            let mut row = 0;
            while row < job.rows() {
                let pair = job.rows() - row >= 2 * ROWS;
                zero_sums(registers);
                for (start, segment) in job.segments() {
                    assert!(segment.len().is_multiple_of(STEP * 32));
                    let steps = segment.len() / (STEP * 32);
                    let upper = job.left_from(row)[start..].as_ptr();
                    let right = segment.as_ptr();
                    if pair {
                        let lower = job.left_from(row + ROWS)[start..].as_ptr();
                        // SAFETY: reads `steps` times sixteen words of 32 rows of the left-hand
                        // side, which has that many rows and words left in each (see `PanelJob`),
                        // and as many lines of the segment. `steps` is not zero, since segments are
                        // not empty. `Registers` proves that the registers are configured.
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
                                upper = inout(reg) upper => _,
                                lower = inout(reg) lower => _,
                                right = inout(reg) right => _,
                                steps = inout(reg) steps => _,
                                stride = in(reg) left_stride,
                                line = in(reg) line,
                                options(nostack, readonly),
                            );
                        }
                    } else {
                        // SAFETY: as above, for sixteen rows of the left-hand side.
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
                                upper = inout(reg) upper => _,
                                right = inout(reg) right => _,
                                steps = inout(reg) steps => _,
                                stride = in(reg) left_stride,
                                line = in(reg) line,
                                options(nostack, readonly),
                            );
                        }
                    }
                }

                let out = job.out_from(row).as_mut_ptr();
                // SAFETY: writes 32 words of sixteen rows, which the result has (see `PanelJob`).
                unsafe {
                    asm!(
                        "tilestored [{out} + {stride}*1], tmm0",
                        "tilestored [{out} + {stride}*1 + 64], tmm1",
                        out = in(reg) out,
                        stride = in(reg) out_stride,
                        options(nostack, preserves_flags),
                    );
                }
                row += ROWS;
                if pair {
                    let out = job.out_from(row).as_mut_ptr();
                    // SAFETY: as above, for the other sixteen rows.
                    unsafe {
                        asm!(
                            "tilestored [{out} + {stride}*1], tmm2",
                            "tilestored [{out} + {stride}*1 + 64], tmm3",
                            out = in(reg) out,
                            stride = in(reg) out_stride,
                            options(nostack, preserves_flags),
                        );
                    }
                    row += ROWS;
                }
            }
        }
    };
}

matrix_product!(bf16_product, "tdpbf16ps");
matrix_product!(int8_product, "tdpbusd");

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

//! Products in matrix registers (Intel AMX): eight of them, each sixteen rows of 64 bytes.
//!
//! The stable compiler has no intrinsics for them, but its assembler knows the instructions. No
//! compiled code touches these registers, so they keep what they hold from one `asm!` block to the
//! next; a thread drops what it left there when it has no more products to compute, so that the
//! system need not save it.

use super::Simd;
use super::gemm::TileJob;
use super::operand::Format;
use super::simd::SimdLevel;
use std::arch::asm;
use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
use std::cell::Cell;
use std::marker::PhantomData;
use std::sync::OnceLock;

/// Words of k that one instruction sums: what a row of a register holds.
pub(super) const STEP: usize = 16;
/// Rows of a register.
const ROWS: usize = 16;
/// Multiply-adds of one instruction, each counted as two operations.
pub(super) const BF16_OPERATIONS: usize = 2 * ROWS * 16 * 2 * STEP;
/// The same for int8.
pub(super) const INT8_OPERATIONS: usize = 2 * BF16_OPERATIONS;

/// Whether the CPU has tiles of bf16 and int8 and the system lets this process use them.
pub(super) fn are_available() -> bool {
    static ANSWER: OnceLock<bool> = OnceLock::new();
    *ANSWER.get_or_init(|| cpu_has_tiles() && system_saves_tiles() && request_permission())
}

fn cpu_has_tiles() -> bool {
    const BF16: u32 = 1 << 22;
    const TILES: u32 = 1 << 24;
    const INT8: u32 = 1 << 25;
    __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & (BF16 | TILES | INT8) == BF16 | TILES | INT8
}

fn system_saves_tiles() -> bool {
    const XSAVE_IN_USE: u32 = 1 << 27;
    const TILES: u64 = 0b11 << 17;
    // SAFETY: the instruction exists where the system has switched XSAVE on.
    __cpuid(1).ecx & XSAVE_IN_USE != 0 && unsafe { extended_state() } & TILES == TILES
}

#[target_feature(enable = "xsave")]
fn extended_state() -> u64 {
    // SAFETY: register 0 exists on every CPU with XSAVE.
    unsafe { _xgetbv(0) }
}

/// Linux hands the state of tiles out on request only, to the whole process (its
/// `Documentation/arch/x86/xstate.rst`).
#[cfg(target_os = "linux")]
fn request_permission() -> bool {
    const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
    const TILE_DATA: libc::c_long = 18;
    // SAFETY: this call takes no pointers and changes nothing but what the process may use.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, TILE_DATA) == 0 }
}

#[cfg(not(target_os = "linux"))]
fn request_permission() -> bool {
    false
}

/// What `ldtilecfg` reads.
#[repr(C, align(64))]
struct Configuration {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

/// All eight registers at their full size.
static FULL: Configuration = Configuration {
    palette: 1,
    start_row: 0,
    reserved: [0; 14],
    row_bytes: [64, 64, 64, 64, 64, 64, 64, 64, 0, 0, 0, 0, 0, 0, 0, 0],
    rows: [16, 16, 16, 16, 16, 16, 16, 16, 0, 0, 0, 0, 0, 0, 0, 0],
};

thread_local! {
    /// How many [`Registers`] this thread has.
    static HOLDERS: Cell<usize> = const { Cell::new(0) };
}

/// This thread's registers, configured to their full size until the last of these is dropped.
/// Configuring and releasing them takes as long as half a product of 32 rows, so whoever multiplies
/// many panels holds one meanwhile.
pub(super) struct Registers {
    /// They are the thread's own: this must not go to another.
    _thread: PhantomData<*const ()>,
}

impl Registers {
    pub(super) fn take(simd: Simd) -> Self {
        assert!(
            simd.level() == SimdLevel::Amx,
            "level {} has no tiles",
            simd.level()
        );
        if HOLDERS.replace(HOLDERS.get() + 1) == 0 {
            // SAFETY: the token proves that the CPU has tiles and the system lets them be used;
            // FULL is 64 bytes.
            unsafe {
                asm!("ldtilecfg [{}]", in(reg) &raw const FULL, options(nostack, preserves_flags, readonly))
            };
        }
        Self {
            _thread: PhantomData,
        }
    }
}

impl Drop for Registers {
    fn drop(&mut self) {
        if HOLDERS.replace(HOLDERS.get() - 1) == 1 {
            // SAFETY: a `Registers` exists only where there are tiles; nobody else on this thread
            // has one.
            unsafe { asm!("tilerelease", options(nostack, preserves_flags, nomem)) };
        }
    }
}

/// The loops over rows and segments, and the loop over a segment, for one instruction. Tiles 0 to 3
/// hold the sums (two below each other by two beside each other), 4 and 5 rows of the left, 6 and 7
/// of the right.
macro_rules! product {
    ($name:ident, $dot:literal) => {
        /// # Safety
        /// There are tiles, configured to their full size; extents are those that the fields tell,
        /// `rows` and `k` are whole tiles and steps, and so is `segment_rows` unless it covers `k`.
        unsafe fn $name(job: &TileJob) {
            let mut row = 0;
            while row < job.rows {
                let (left, out) =
                    (job.left.wrapping_add(row * job.left_stride), job.out.wrapping_add(row * job.out_stride));
                let pair = job.rows - row >= 2 * ROWS;
                let (mut left, mut segment, mut remaining) = (left, job.right, job.k);
                // SAFETY: zeroes registers that nothing else uses.
                unsafe {
                    asm!("tilezero tmm0", "tilezero tmm1", "tilezero tmm2", "tilezero tmm3",
                        options(nostack, preserves_flags, nomem));
                }
                while remaining > 0 {
                    let count = remaining.min(job.segment_rows);
                    // SAFETY: reads `count` words of each of the rows and as many lines of the
                    // panel, which the caller vouches for; strides are in bytes.
                    unsafe {
                        if pair {
                            asm!(
                                "2:",
                                "tileloadd tmm4, [{upper} + {stride}*1]",
                                "tileloadd tmm6, [{right} + {line}*1]",
                                concat!($dot, " tmm0, tmm4, tmm6"),
                                "tileloadd tmm7, [{right} + {line}*1 + 64]",
                                concat!($dot, " tmm1, tmm4, tmm7"),
                                "tileloadd tmm5, [{lower} + {stride}*1]",
                                concat!($dot, " tmm2, tmm5, tmm6"),
                                concat!($dot, " tmm3, tmm5, tmm7"),
                                "add {upper}, 64",
                                "add {lower}, 64",
                                "add {right}, 2048",
                                "dec {steps}",
                                "jnz 2b",
                                upper = inout(reg) left => _,
                                lower = inout(reg) left.wrapping_add(ROWS * job.left_stride) => _,
                                right = inout(reg) segment => _,
                                steps = inout(reg) count / STEP => _,
                                stride = in(reg) 4 * job.left_stride,
                                line = in(reg) 128usize,
                                options(nostack, readonly),
                            );
                        } else {
                            asm!(
                                "2:",
                                "tileloadd tmm6, [{right} + {line}*1]",
                                "tileloadd tmm7, [{right} + {line}*1 + 64]",
                                "tileloadd tmm4, [{upper} + {stride}*1]",
                                concat!($dot, " tmm0, tmm4, tmm6"),
                                concat!($dot, " tmm1, tmm4, tmm7"),
                                "add {upper}, 64",
                                "add {right}, 2048",
                                "dec {steps}",
                                "jnz 2b",
                                upper = inout(reg) left => _,
                                right = inout(reg) segment => _,
                                steps = inout(reg) count / STEP => _,
                                stride = in(reg) 4 * job.left_stride,
                                line = in(reg) 128usize,
                                options(nostack, readonly),
                            );
                        }
                    }
                    left = left.wrapping_add(count);
                    remaining -= count;
                    segment = segment.wrapping_add(job.segment_stride);
                }
                // SAFETY: writes 32 words of 16 rows, or of 32, which the caller vouches for.
                unsafe {
                    asm!(
                        "tilestored [{out} + {stride}*1], tmm0",
                        "tilestored [{out} + {stride}*1 + 64], tmm1",
                        out = in(reg) out,
                        stride = in(reg) 4 * job.out_stride,
                        options(nostack, preserves_flags),
                    );
                    if pair {
                        asm!(
                            "tilestored [{out} + {stride}*1], tmm2",
                            "tilestored [{out} + {stride}*1 + 64], tmm3",
                            out = in(reg) out.wrapping_add(ROWS * job.out_stride),
                            stride = in(reg) 4 * job.out_stride,
                            options(nostack, preserves_flags),
                        );
                    }
                }
                row += if pair { 2 * ROWS } else { ROWS };
            }
        }
    };
}

product!(bf16_product, "tdpbf16ps");
product!(int8_product, "tdpbusd");

/// The whole of a product.
///
/// # Safety
/// The job's pointers are valid for what its fields tell; `rows` are whole registers, the panel is
/// two registers wide, `k` is whole steps, and so is `segment_rows` unless it covers `k`.
pub(super) unsafe fn multiply(simd: Simd, format: Format, job: &TileJob) {
    let _registers = Registers::take(simd);
    // SAFETY: the caller's; the registers are configured.
    unsafe {
        match format {
            Format::Bf16 => bf16_product(job),
            Format::Int8 => int8_product(job),
            Format::F32 => unreachable!("tiles have no f32 products"),
        }
    }
}

macro_rules! repeat {
    ($(#[$doc:meta])* $name:ident, $dot:literal) => {
        $(#[$doc])*
        pub(super) fn $name(simd: Simd, instructions: usize) -> f32 {
            let _registers = Registers::take(simd);
            // SAFETY: register arithmetic only; whatever they hold does.
            unsafe {
                asm!(
                    "2:",
                    concat!($dot, " tmm0, tmm4, tmm6"),
                    concat!($dot, " tmm1, tmm4, tmm7"),
                    concat!($dot, " tmm2, tmm5, tmm6"),
                    concat!($dot, " tmm3, tmm5, tmm7"),
                    "dec {rounds}",
                    "jnz 2b",
                    rounds = inout(reg) instructions / 4 => _,
                    options(nostack, nomem),
                );
            }
            0.0
        }
    };
}

repeat!(
    /// So many bf16 products of registers, four independent sums at a time.
    repeat_bf16,
    "tdpbf16ps"
);
repeat!(
    /// So many int8 products of registers, four independent sums at a time.
    repeat_int8,
    "tdpbusd"
);

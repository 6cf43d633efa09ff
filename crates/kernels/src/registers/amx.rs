//! The matrix registers of Intel AMX: eight of them, each of sixteen rows of 64 bytes.
//!
//! Besides the CPU, the operating system must agree to save them when threads are switched; Linux
//! does so on request. A thread configures the registers before it uses them and releases them
//! afterwards, so that the system need not save what they hold.

use std::arch::asm;
use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
use std::cell::Cell;
use std::marker::PhantomData;
use std::sync::OnceLock;

/// Words of k that one instruction sums over: the length of a register's row.
pub(crate) const STEP: usize = 16;

/// Rows of a register.
pub(crate) const ROWS: usize = 16;

/// Whether the CPU has matrix products of bf16 and int8 and the system lets this process use them.
pub(crate) fn is_available() -> bool {
    static ANSWER: OnceLock<bool> = OnceLock::new();
    *ANSWER.get_or_init(|| cpu_has_tiles() && system_saves_tiles() && request_permission())
}

fn cpu_has_tiles() -> bool {
    const BF16: u32 = 1 << 22;
    const TILES: u32 = 1 << 24;
    const INT8: u32 = 1 << 25;
    const ALL: u32 = BF16 | TILES | INT8;
    __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & ALL == ALL
}

fn system_saves_tiles() -> bool {
    const XSAVE_IN_USE: u32 = 1 << 27;
    const TILES: u64 = 0b11 << 17;
    if __cpuid(1).ecx & XSAVE_IN_USE == 0 {
        return false;
    }
    // SAFETY: the CPU has XSAVE, since the system has switched it on.
    let saved = unsafe { extended_state() };
    saved & TILES == TILES
}

#[target_feature(enable = "xsave")]
fn extended_state() -> u64 {
    // SAFETY: control register 0 exists on every CPU with XSAVE.
    unsafe { _xgetbv(0) }
}

/// Asks Linux to allocate room for matrix registers for this process (see the kernel's
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
    static USERS: Cell<usize> = const { Cell::new(0) };
}

/// Proof that this thread's registers are configured to their full size. They stay so until the
/// last of these values is dropped.
///
/// Configuring and releasing them takes as long as half a product of 32 rows, so that code which
/// multiplies many panels keeps such a value meanwhile.
pub(crate) struct Registers {
    /// The registers belong to the thread, so the value must not be sent to another.
    _thread: PhantomData<*const ()>,
}

impl Registers {
    /// Configures the registers of the calling thread, unless they are configured already.
    ///
    /// # Panics
    /// If there are none, or the system does not let this process use them.
    pub(crate) fn configure() -> Self {
        assert!(is_available(), "this CPU has no matrix registers");
        let users = USERS.get();
        if users == 0 {
            // SAFETY: the first line has found that the CPU has the instruction and the system
            // permits it; it reads the 64 bytes of FULL.
            unsafe {
                asm!(
                    "ldtilecfg [{}]",
                    in(reg) &raw const FULL,
                    options(nostack, preserves_flags, readonly),
                );
            }
        }
        USERS.set(users + 1);
        Self {
            _thread: PhantomData,
        }
    }
}

impl Drop for Registers {
    fn drop(&mut self) {
        let others = USERS.get() - 1;
        USERS.set(others);
        if others == 0 {
            // SAFETY: the CPU has the instruction, since `configure` made this value; no other
            // code on this thread relies on the registers.
            unsafe { asm!("tilerelease", options(nostack, preserves_flags, nomem)) };
        }
    }
}

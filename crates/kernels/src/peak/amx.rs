//! AMX: products of matrix registers, four independent sums at a time.

use super::{ROUNDS, SUMS};
use crate::registers::amx::Registers;
use std::arch::asm;

macro_rules! product_loop {
    ($(#[$doc:meta])* $name:ident($seed:ty), $instruction:literal) => {
        $(#[$doc])*
        #[target_feature(enable = "avx512f")]
        pub(super) fn $name(_: $seed) -> f32 {
            let _registers = Registers::configure();
            // SAFETY: touches no memory; `Registers` proves that the registers are configured, and
            // it does not matter what they hold.
            unsafe {
                asm!(
                    "2:",
                    concat!($instruction, " tmm0, tmm4, tmm6"),
                    concat!($instruction, " tmm1, tmm4, tmm7"),
                    concat!($instruction, " tmm2, tmm5, tmm6"),
                    concat!($instruction, " tmm3, tmm5, tmm7"),
                    "dec {rounds}",
                    "jnz 2b",
                    rounds = inout(reg) ROUNDS * SUMS / 4 => _,
                    options(nostack, nomem),
                );
            }
            0.0
        }
    };
}

product_loop!(
    /// See [`super::bf16_operations`].
    bf16_loop(i16),
    "tdpbf16ps"
);

product_loop!(
    /// See [`super::int8_operations`].
    int8_loop(i8),
    "tdpbusd"
);

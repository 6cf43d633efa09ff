//! What the machine can compute at most, so that benchmarks can give a measured time as a share of
//! it.
//!
//! Each loop keeps enough independent sums in registers to hide the latency of its instruction and
//! touches no memory. No kernel made of the same instruction can be faster.

#[cfg(target_arch = "x86_64")]
mod amx;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod f32_loop;
mod scalar;
#[cfg(test)]
mod tests;

use crate::dispatch::dispatch;
use crate::{Simd, SimdLevel};
use std::time::{Duration, Instant};

/// Independent sums: an addition takes four cycles and two start in each, hence eight, and some
/// more to be sure; they fit into sixteen registers.
const SUMS: usize = 12;

/// Instructions for each sum in one unit of work, between two looks at the clock.
const ROUNDS: usize = 20_000;

/// Operations on f32 per second of this thread, a multiply-add counted as two, measured over at
/// least `time`.
pub fn f32_operations(simd: Simd, time: Duration) -> f64 {
    let lanes = if simd.level() >= SimdLevel::Avx512 {
        16
    } else {
        8
    };
    operations_per_second(time, 2 * lanes, || {
        let seed = std::hint::black_box(0.5);
        dispatch!(simd, f32_loop(seed))
    })
}

/// Operations on bf16 with f32 sums per second of this thread, a multiply-add counted as two,
/// measured over at least `time`; `None` if the CPU has no such instruction.
pub fn bf16_operations(simd: Simd, time: Duration) -> Option<f64> {
    if simd.level() == SimdLevel::Scalar || !simd.has_bf16_dot() {
        return None;
    }
    let operations = if simd.level() == SimdLevel::Amx {
        // Sixteen rows by sixteen columns by sixteen words of two numbers.
        2 * 16 * 16 * 32
    } else {
        2 * 32
    };
    Some(operations_per_second(time, operations, || {
        let seed = std::hint::black_box(1);
        dispatch!(simd, bf16_loop(seed), amx)
    }))
}

/// Operations on int8 with i32 sums per second of this thread, a multiply-add counted as two,
/// measured over at least `time`; `None` if the CPU has no such instruction.
pub fn int8_operations(simd: Simd, time: Duration) -> Option<f64> {
    if simd.level() < SimdLevel::Avx512 {
        return None;
    }
    let operations = if simd.level() == SimdLevel::Amx {
        // Sixteen rows by sixteen columns by sixteen words of four numbers.
        2 * 16 * 16 * 64
    } else {
        2 * 64
    };
    Some(operations_per_second(time, operations, || {
        let seed = std::hint::black_box(1);
        dispatch!(simd, int8_loop(seed), amx)
    }))
}

/// Repeats `work`, a unit of [`ROUNDS`] x [`SUMS`] instructions, until `time` has passed.
fn operations_per_second(
    time: Duration,
    operations_per_instruction: usize,
    mut work: impl FnMut() -> f32,
) -> f64 {
    let started = Instant::now();
    let mut units = 0u64;
    while started.elapsed() < time {
        std::hint::black_box(work());
        units += 1;
    }
    let operations_per_unit = ROUNDS * SUMS * operations_per_instruction;
    units as f64 * operations_per_unit as f64 / started.elapsed().as_secs_f64()
}

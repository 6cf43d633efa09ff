//! What the machine can do at most, so that a measured time can be given as a share of it.
//!
//! Each loop keeps enough independent sums in registers to hide the latency of its instruction and
//! touches no memory; what it reaches is the most that any kernel made of that instruction can.

use super::Simd;
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::lanes::{Lanes, Portable, at_level};
use super::simd::SimdLevel;
#[cfg(target_arch = "x86_64")]
use super::tiles;
use std::time::{Duration, Instant};

/// Independent sums: latency 4 times two per cycle, with some to spare, within sixteen registers.
const SUMS: usize = 12;
/// Instructions per sum between two looks at the clock.
const ROUNDS: usize = 20_000;

/// Multiply-adds of f32 per second on this thread, each counted as two operations, over at least
/// `time`.
pub fn f32_operations(simd: Simd, time: Duration) -> f64 {
    let lanes = if simd.level() >= SimdLevel::Avx512 {
        16
    } else {
        8
    };
    repeated(time, 2 * lanes, || {
        at_level!(
            simd,
            (seed: f32 = std::hint::black_box(0.5)) -> f32,
            f32_loop::<Portable>(seed),
            f32_loop::<Avx2>(seed),
            f32_loop::<Avx512>(seed),
        )
    })
}

/// Multiply-adds of bf16 with f32 sums per second on this thread; `None` where the CPU has no such
/// instruction.
pub fn bf16_operations(simd: Simd, time: Duration) -> Option<f64> {
    #[cfg(target_arch = "x86_64")]
    if simd.level() == SimdLevel::Amx {
        return Some(repeated(time, tiles::BF16_OPERATIONS, || {
            tiles::repeat_bf16(simd, ROUNDS * SUMS)
        }));
    }
    #[cfg(target_arch = "x86_64")]
    if simd.has_bf16_dot() {
        // SAFETY: `has_bf16_dot` has just told that the CPU has the instruction.
        return Some(repeated(time, 64, || unsafe {
            x86::bf16_loop(std::hint::black_box(1))
        }));
    }
    let _ = (simd, time);
    None
}

/// Multiply-adds of int8 with i32 sums per second on this thread; `None` where the CPU has no such
/// instruction.
pub fn int8_operations(simd: Simd, time: Duration) -> Option<f64> {
    #[cfg(target_arch = "x86_64")]
    if simd.level() == SimdLevel::Amx {
        return Some(repeated(time, tiles::INT8_OPERATIONS, || {
            tiles::repeat_int8(simd, ROUNDS * SUMS)
        }));
    }
    #[cfg(target_arch = "x86_64")]
    if simd.level() == SimdLevel::Avx512 {
        // SAFETY: the token proves the level, which includes VNNI.
        return Some(repeated(time, 128, || unsafe {
            x86::int8_loop(std::hint::black_box(1))
        }));
    }
    let _ = (simd, time);
    None
}

/// Runs `work` (one unit: [`ROUNDS`] x [`SUMS`] instructions) until `time` is over.
fn repeated(
    time: Duration,
    operations_per_instruction: usize,
    mut work: impl FnMut() -> f32,
) -> f64 {
    let (started, mut units) = (Instant::now(), 0u64);
    while started.elapsed() < time {
        std::hint::black_box(work());
        units += 1;
    }
    let operations = units as f64 * (ROUNDS * SUMS * operations_per_instruction) as f64;
    operations / started.elapsed().as_secs_f64()
}

#[inline(always)]
unsafe fn f32_loop<V: Lanes>(seed: f32) -> f32 {
    // SAFETY: only register arithmetic; the caller runs it at the level of `V`.
    unsafe {
        let factor = V::splat(seed);
        let mut sums = [V::splat(seed); SUMS];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = sum.mul_add(factor, factor);
            }
        }
        sums.into_iter().map(|sum| sum.sum()).sum()
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{ROUNDS, SUMS};
    use std::arch::x86_64::*;

    /// # Safety
    /// The CPU has AVX-512 F and BF16.
    #[target_feature(enable = "avx512f,avx512bf16")]
    pub unsafe fn bf16_loop(seed: i16) -> f32 {
        // SAFETY: a bit pattern of 512 bits is a valid vector of bf16.
        let factor: __m512bh = unsafe { std::mem::transmute(_mm512_set1_epi16(seed)) };
        let mut sums = [_mm512_setzero_ps(); SUMS];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = _mm512_dpbf16_ps(*sum, factor, factor);
            }
        }
        sums.into_iter().map(|sum| _mm512_reduce_add_ps(sum)).sum()
    }

    /// # Safety
    /// The CPU has AVX-512 F and VNNI.
    #[target_feature(enable = "avx512f,avx512vnni")]
    pub unsafe fn int8_loop(seed: i8) -> f32 {
        let factor = _mm512_set1_epi32(i32::from(seed));
        let mut sums = [_mm512_setzero_si512(); SUMS];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = _mm512_dpbusd_epi32(*sum, factor, factor);
            }
        }
        sums.into_iter()
            .map(|sum| _mm512_reduce_add_epi32(sum) as f32)
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_level_reaches_something_and_lower_precision_is_offered_where_the_cpu_has_it() {
        let time = Duration::from_millis(1);
        for simd in Simd::all() {
            assert!(f32_operations(simd, time) > 0.0);
            assert_eq!(bf16_operations(simd, time).is_some(), simd.has_bf16_dot());
            assert_eq!(
                int8_operations(simd, time).is_some(),
                simd.level() >= SimdLevel::Avx512
            );
        }
    }
}

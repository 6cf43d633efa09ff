//! Multiply-adds of f32, generic over the instruction set.

use super::{ROUNDS, SUMS};
use crate::registers::{FloatVector, VectorIsa};

/// One unit of work.
#[inline(always)]
pub(super) fn f32_loop<I: VectorIsa>(isa: I, seed: f32) -> f32 {
    let factor = isa.splat(seed);
    let mut sums = [isa.splat(seed); SUMS];
    for _ in 0..ROUNDS {
        for sum in &mut sums {
            *sum = sum.mul_add(factor, factor);
        }
    }
    let mut total = 0.0;
    for sum in sums {
        total += sum.sum();
    }
    total
}

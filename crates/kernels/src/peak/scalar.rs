//! Portable code.

use crate::registers::scalar::ScalarIsa;

/// See [`super::f32_operations`].
pub(super) fn f32_loop(seed: f32) -> f32 {
    super::f32_loop::f32_loop(ScalarIsa, seed)
}

/// There is no instruction to measure.
pub(super) fn bf16_loop(_: i16) -> f32 {
    unreachable!("not asked for at this level")
}

/// There is no instruction to measure.
pub(super) fn int8_loop(_: i8) -> f32 {
    unreachable!("not asked for at this level")
}

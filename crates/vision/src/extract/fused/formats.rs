//! Which number format each product of the transformer uses.
//!
//! A [`Precision`] is what the configuration asks for; what it stands for depends on the CPU.
//! Layers are multiplied in f32, bf16 or int8, and this may differ from block to block. The two
//! products of attention (scores, and the weighted sum of the values) have formats of their own.

use crate::extract::encoder::Precision;
use crate::extract::error::ExtractError;
use placeformer_kernels::operand::Format;
use placeformer_kernels::{Simd, SimdLevel};
use std::ops::Range;

/// The formats of all products of an encoder.
#[derive(Debug, Clone)]
pub(super) struct Formats {
    /// The precision that these formats implement; never [`Precision::Auto`].
    pub precision: Precision,
    /// Blocks whose linear layers are multiplied in int8.
    pub int8_blocks: Range<usize>,
    /// Format of the linear layers of all other blocks.
    pub other_layers: Format,
    /// Format of queries times keys.
    pub scores: Format,
    /// Format of attention weights times values.
    pub mix: Format,
}

impl Formats {
    fn all_f32() -> Self {
        Self {
            precision: Precision::F32,
            int8_blocks: 0..0,
            other_layers: Format::F32,
            scores: Format::F32,
            mix: Format::F32,
        }
    }
}

/// The formats that `precision` stands for with the instructions of `simd`, for a transformer of
/// `blocks` blocks.
///
/// # Errors
/// [`ExtractError::Precision`] if the CPU lacks the instructions that the precision needs.
pub(super) fn choose_formats(
    simd: Simd,
    precision: Precision,
    blocks: usize,
) -> Result<Formats, ExtractError> {
    let has_bf16 = Format::Bf16.is_available(simd);
    let has_int8 = Format::Int8.is_available(simd);
    let mix = if has_bf16 { Format::Bf16 } else { Format::F32 };
    // Int8 scores are about as exact as bf16 scores, because each head has a scale of its own. With
    // matrix registers bf16 products are so fast that converting integer sums back would cost more
    // time than int8 saves.
    let scores = if has_int8 && simd.level() < SimdLevel::Amx {
        Format::Int8
    } else {
        mix
    };
    let reduced = |int8_blocks: Range<usize>, other_layers: Format| Formats {
        precision,
        int8_blocks,
        other_layers,
        scores,
        mix,
    };

    match precision {
        Precision::Auto => choose_formats(simd, fastest(simd), blocks),
        Precision::F32 => Ok(Formats::all_f32()),
        Precision::Bf16 if has_bf16 => Ok(reduced(0..0, Format::Bf16)),
        Precision::Mixed if has_int8 => Ok(reduced(mixed_int8_blocks(blocks), mix)),
        Precision::Int8 if has_int8 => Ok(reduced(0..blocks, mix)),
        Precision::Bf16 => Err(lacks(simd, precision, "AVX-512 BF16")),
        Precision::Mixed | Precision::Int8 => Err(lacks(simd, precision, "AVX-512 VNNI")),
    }
}

/// What [`Precision::Auto`] stands for.
///
/// The scalar level can multiply int8 too, but there it is slower than f32. So the level decides,
/// and not whether the format is available.
fn fastest(simd: Simd) -> Precision {
    if simd.level() >= SimdLevel::Avx512 {
        Precision::Mixed
    } else {
        Precision::F32
    }
}

fn lacks(simd: Simd, precision: Precision, instructions: &str) -> ExtractError {
    let level = simd.level();
    ExtractError::Precision {
        precision: precision.name(),
        reason: format!(
            "it needs a CPU with {instructions}, used at level avx512; this is level {level}"
        ),
    }
}

/// The blocks that [`Precision::Mixed`] multiplies in int8, of a transformer of `blocks` blocks:
/// from the second one to the middle.
///
/// Rounding costs least there. The first block has the inputs with the widest range, and an error
/// made in a late block is not averaged out by the blocks after it.
pub fn mixed_int8_blocks(blocks: usize) -> Range<usize> {
    let end = blocks.div_ceil(2).max(1);
    1..end
}

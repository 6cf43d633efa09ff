//! How the numbers of a product are stored, and left-hand sides packed so.
//!
//! A product of f32 costs four bytes a number and one multiply-add a lane; bf16 halves and int8 quarters both. Sums stay
//! f32 (i32 for int8), and so does everything between the products.

use super::Simd;
use super::aligned::AlignedBuffer;
use super::attention::ScoreFormat;
use super::gemm::covers;
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::lanes::{Lanes, Portable, at_bf16_level, at_level};
use super::simd::SimdLevel;

/// How the numbers on both sides of a product are stored, always in whole 32-bit words along the sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// One 32-bit float to a word.
    F32,
    /// Two bfloat16, rounded to the nearest, the earlier in the low half.
    Bf16,
    /// Four integers with a factor for each row: on the left unsigned, value = (code - 128) x factor; on the right
    /// signed with a factor for each column.
    Int8,
}

impl Format {
    /// Every format.
    pub const ALL: [Self; 3] = [Self::F32, Self::Bf16, Self::Int8];

    /// Numbers in a word.
    pub fn per_word(self) -> usize {
        match self {
            Self::F32 => 1,
            Self::Bf16 => 2,
            Self::Int8 => 4,
        }
    }

    /// Words that `count` numbers take.
    pub fn words(self, count: usize) -> usize {
        count.div_ceil(self.per_word())
    }

    /// Whether the level has an instruction for it, or is the portable one, which can everything and slowly.
    pub fn is_available(self, simd: Simd) -> bool {
        match self {
            Self::F32 => true,
            Self::Bf16 => simd.level() == SimdLevel::Scalar || simd.has_bf16_dot(),
            Self::Int8 => simd.level() == SimdLevel::Scalar || simd.level() >= SimdLevel::Avx512,
        }
    }
}

/// Row-major words: row `i` starts at `i * stride`.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a> {
    /// All rows.
    pub data: &'a [u32],
    /// Words from one row to the next.
    pub stride: usize,
}

impl<'a> Rows<'a> {
    /// Rows of f32 as they are.
    pub fn f32(data: &'a [f32], stride: usize) -> Self {
        Self { data: bytemuck::cast_slice(data), stride }
    }
}

/// The left-hand side of a product.
#[derive(Debug, Clone, Copy)]
pub struct Left<'a> {
    /// Its rows.
    pub rows: Rows<'a>,
    /// What a code of each row is worth; empty unless the format is [`Format::Int8`].
    pub factors: &'a [f32],
}

/// Room for a packed left-hand side, used again and again.
#[derive(Default)]
pub struct OperandBuffer {
    words: AlignedBuffer<u32>,
    factors: AlignedBuffer<f32>,
    /// The greater and the lesser parts of a row.
    parts: AlignedBuffer<f32>,
}

/// Which side of the scores' product a row is on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScoreSide {
    /// Its left-hand side.
    Query,
    /// Its right-hand side.
    Key,
}

/// Widths that [`OperandBuffer::pack`] takes are multiples of this: a vector's length.
pub fn width_step(simd: Simd) -> usize {
    if simd.level() >= SimdLevel::Avx512 { 16 } else { 8 }
}

impl OperandBuffer {
    /// `rows` rows of `width` f32, row `i` at `i * stride`, in `format`: as they are for f32, else packed into the
    /// buffer.
    ///
    /// # Panics
    /// If `source` is too short, or `width` is not a multiple of [`width_step`], or the format is not available.
    pub fn pack<'a>(
        &'a mut self,
        simd: Simd,
        format: Format,
        rows: usize,
        width: usize,
        (source, stride): (&'a [f32], usize),
    ) -> Left<'a> {
        if format == Format::F32 {
            return Left { rows: Rows::f32(source, stride), factors: &[] };
        }
        assert_eq!(width % width_step(simd), 0, "rows must be whole vectors wide");
        assert!(rows == 0 || covers(source.len(), rows, stride, width), "source too short");
        let words = format.words(width);
        self.words.resize(rows * words);
        self.factors.resize(if format == Format::Int8 { rows } else { 0 });
        for (row, packed) in self.words.chunks_exact_mut(words).enumerate() {
            let source = &source[row * stride..row * stride + width];
            if format == Format::Bf16 {
                round_row(simd, source, packed);
            } else {
                self.factors[row] = quantise_row(simd, source, packed);
            }
        }
        Left { rows: Rows { data: &self.words, stride: words }, factors: &self.factors }
    }

    /// As [`pack`](Self::pack), for rows of queries or keys, whose order of parts depends on their `side`.
    ///
    /// # Panics
    /// As there.
    pub fn pack_scores<'a>(
        &'a mut self,
        simd: Simd,
        format: ScoreFormat,
        side: ScoreSide,
        (rows, width): (usize, usize),
        (source, stride): (&'a [f32], usize),
    ) -> Rows<'a> {
        if format != ScoreFormat::SplitBf16 {
            return self.pack(simd, format.product(), rows, width, (source, stride)).rows;
        }
        assert_eq!(width % width_step(simd), 0, "rows must be whole vectors wide");
        assert!(rows == 0 || covers(source.len(), rows, stride, width), "source too short");
        let words = Format::Bf16.words(width);
        self.words.resize(rows * 3 * words);
        self.parts.resize(2 * width);
        let (greater, lesser) = self.parts.split_at_mut(width);
        for (row, packed) in self.words.chunks_exact_mut(3 * words).enumerate() {
            split_row(&source[row * stride..row * stride + width], greater, lesser);
            let order: [&[f32]; 3] = match side {
                ScoreSide::Query => [greater, lesser, greater],
                ScoreSide::Key => [greater, greater, lesser],
            };
            for (part, packed) in order.into_iter().zip(packed.chunks_exact_mut(words)) {
                round_row(simd, part, packed);
            }
        }
        Rows { data: &self.words, stride: 3 * words }
    }
}

/// The greater part of each number, its first eight bits, which bf16 holds exactly, and the lesser, what is left.
fn split_row(source: &[f32], greater: &mut [f32], lesser: &mut [f32]) {
    for ((value, greater), lesser) in source.iter().zip(greater).zip(lesser) {
        *greater = f32::from_bits(value.to_bits() & 0xffff_0000);
        *lesser = value - *greater;
    }
}

/// bf16 of a row; lengths are checked by the only caller.
fn round_row(simd: Simd, source: &[f32], packed: &mut [u32]) {
    at_bf16_level!(
        simd,
        (source: &[f32] = source, packed: &mut [u32] = packed),
        round::<Portable>(source, packed),
        round::<Avx2>(source, packed),
        round::<Avx512>(source, packed),
    );
}

#[inline(always)]
unsafe fn round<V: Lanes>(source: &[f32], packed: &mut [u32]) {
    // SAFETY: `pack` gives whole vectors and half as many words.
    unsafe {
        for at in (0..source.len()).step_by(V::COUNT) {
            V::load(source.as_ptr().add(at)).store_bf16(packed.as_mut_ptr().add(at / 2));
        }
    }
}

/// Codes of a row, the largest magnitude becoming 127; what one is worth.
fn quantise_row(simd: Simd, source: &[f32], packed: &mut [u32]) -> f32 {
    at_level!(
        simd,
        (source: &[f32] = source, packed: &mut [u32] = packed) -> f32,
        quantise::<Portable>(source, packed),
        quantise::<Avx2>(source, packed),
        quantise::<Avx512>(source, packed),
    )
}

#[inline(always)]
unsafe fn quantise<V: Lanes>(source: &[f32], packed: &mut [u32]) -> f32 {
    // SAFETY: `pack` gives whole vectors and a quarter as many words.
    unsafe {
        let mut highest = V::splat(0.0);
        for at in (0..source.len()).step_by(V::COUNT) {
            let value = V::load(source.as_ptr().add(at));
            highest = highest.max(value.max(V::splat(0.0).sub(value)));
        }
        let largest = highest.maximum().max(f32::MIN_POSITIVE * 256.0);
        let (scale, centre) = (V::splat(127.0 / largest), V::splat(128.0));
        for at in (0..source.len()).step_by(V::COUNT) {
            // Two roundings, as every level has them: the codes are the same everywhere.
            let code = V::load(source.as_ptr().add(at)).mul(scale).add(centre);
            code.store_u8(packed.as_mut_ptr().cast::<u8>().add(at));
        }
        largest / 127.0
    }
}

/// What packed rows are worth, `[rows, width]`: for comparisons.
#[cfg(test)]
pub(super) fn unpack(format: Format, left: Left<'_>, rows: usize, width: usize) -> Vec<f32> {
    let value = |row: usize, column: usize| {
        let word = left.rows.data[row * left.rows.stride + column / format.per_word()];
        let part = column % format.per_word();
        match format {
            Format::F32 => f32::from_bits(word),
            Format::Bf16 => f32::from_bits((word >> (16 * part)) << 16),
            Format::Int8 => (f32::from(word.to_le_bytes()[part]) - 128.0) * left.factors[row],
        }
    };
    (0..rows * width).map(|at| value(at / width, at % width)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::ramp;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn packing_keeps_values_within_the_formats_step(rows in 1usize..5, steps in 1usize..9, scale in 1e-3f32..1e3) {
            let (width, stride) = (steps * 16, steps * 16 + 5);
            let source: Vec<f32> = ramp(rows * stride, 3).iter().map(|value| value * scale).collect();
            for simd in Simd::all() {
                for format in Format::ALL.into_iter().filter(|format| format.is_available(simd)) {
                    let mut buffer = OperandBuffer::default();
                    let left = buffer.pack(simd, format, rows, width, (&source, stride));
                    for (at, actual) in unpack(format, left, rows, width).into_iter().enumerate() {
                        let expected = source[at / width * stride + at % width];
                        let step = match format {
                            Format::F32 => 0.0,
                            Format::Bf16 => expected.abs() / 256.0,
                            Format::Int8 => scale / 253.0,
                        };
                        prop_assert!((actual - expected).abs() <= step, "{format:?}: {actual} for {expected}");
                    }
                }
            }
        }
    }

    #[test]
    fn rows_of_zeros_and_of_no_numbers_are_packed_as_such() {
        for simd in Simd::all().filter(|&simd| Format::Int8.is_available(simd)) {
            let mut buffer = OperandBuffer::default();
            let left = buffer.pack(simd, Format::Int8, 1, 16, (&[0.0; 16], 16));
            assert_eq!(unpack(Format::Int8, left, 1, 16), [0.0; 16]);
        }
        for simd in Simd::all().filter(|&simd| Format::Bf16.is_available(simd)) {
            let mut nan = OperandBuffer::default();
            let left = nan.pack(simd, Format::Bf16, 1, 16, (&[f32::NAN; 16], 16));
            assert!(unpack(Format::Bf16, left, 1, 16).iter().all(|value| value.is_nan()));
        }
    }
}

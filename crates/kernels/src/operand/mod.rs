//! How the numbers of a matrix product are stored, and packing of left-hand sides.
//!
//! A product of f32 reads four bytes a number and needs one multiply-add for each. bf16 halves both
//! and int8 quarters them, at the price of precision. Sums stay f32 (i32 for int8), and so does
//! everything between the products, so activations are converted to the format of each product just
//! before it.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod packing;
mod scalar;
#[cfg(test)]
mod tests;

use crate::aligned::AlignedBuffer;
use crate::dispatch::dispatch;
use crate::gemm::covers;
use crate::{Simd, SimdLevel};
use packing::SourceRows;

/// How the numbers on both sides of a product are stored, always in whole 32-bit words along the
/// dimension that is summed over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// One 32-bit float to a word.
    F32,
    /// Two bfloat16, rounded to the nearest, the earlier in the low half.
    Bf16,
    /// Four 8-bit integers, the earliest in the lowest byte. On the left they are unsigned and
    /// stand for `(code - 128) * factor` with a factor for each row; on the right they are signed
    /// and stand for `code * factor` with a factor for each column.
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

    /// Whether products in this format pay off at a level: it has an instruction for them. The
    /// scalar level computes everything, slowly, as the reference for the others.
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
pub struct WordRows<'a> {
    /// All rows.
    pub data: &'a [u32],
    /// Words from one row to the next.
    pub stride: usize,
}

impl<'a> WordRows<'a> {
    /// The bits of rows of f32, of which row `i` starts at `i * stride`.
    pub fn f32(data: &'a [f32], stride: usize) -> Self {
        Self {
            data: bytemuck::cast_slice(data),
            stride,
        }
    }
}

/// The left-hand side of a product.
#[derive(Debug, Clone, Copy)]
pub struct LeftOperand<'a> {
    /// Its rows.
    pub rows: WordRows<'a>,
    /// `[rows]`: value of one code unit of each row; empty unless the format is [`Format::Int8`].
    pub factors: &'a [f32],
}

impl LeftOperand<'_> {
    /// The rows from number `first` on.
    pub fn from_row(&self, first: usize) -> Self {
        let rows = WordRows {
            data: &self.rows.data[first * self.rows.stride..],
            ..self.rows
        };
        let factors = if self.factors.is_empty() {
            &[]
        } else {
            &self.factors[first..]
        };
        Self { rows, factors }
    }
}

/// Memory for a packed left-hand side; it grows as needed and is reused.
#[derive(Default)]
pub struct OperandBuffer {
    words: AlignedBuffer<u32>,
    factors: AlignedBuffer<f32>,
}

/// Widths that [`OperandBuffer::pack`] takes are multiples of this: elements of a vector.
pub fn width_step(simd: Simd) -> usize {
    if simd.level() >= SimdLevel::Avx512 {
        16
    } else {
        8
    }
}

impl OperandBuffer {
    /// Converts `rows` rows of `width` f32, of which row `i` starts at `i * stride` of
    /// `source = (values, stride)`, to `format`. Rows of f32 are returned as they are, others are
    /// packed into the buffer.
    ///
    /// # Panics
    /// If `source` is too short, `width` is not a multiple of [`width_step`], or the format is bf16
    /// at [`SimdLevel::Avx512`] on a CPU without AVX-512 BF16.
    pub fn pack<'a>(
        &'a mut self,
        simd: Simd,
        format: Format,
        rows: usize,
        width: usize,
        source: (&'a [f32], usize),
    ) -> LeftOperand<'a> {
        self.pack_scaled(simd, format, rows, width, source, ChannelScaling::default())
    }

    /// As [`pack`](Self::pack), but int8 codes are made of the values after `scaling`.
    ///
    /// # Panics
    /// As [`pack`](Self::pack), and if `scaling` is neither empty nor has `width` columns.
    pub fn pack_scaled<'a>(
        &'a mut self,
        simd: Simd,
        format: Format,
        rows: usize,
        width: usize,
        (source, stride): (&'a [f32], usize),
        scaling: ChannelScaling<'_>,
    ) -> LeftOperand<'a> {
        if format == Format::F32 {
            return LeftOperand {
                rows: WordRows::f32(source, stride),
                factors: &[],
            };
        }

        let source = SourceRows::new(simd, source, stride, rows, width);
        let words = format.words(width);
        self.words.resize(rows * words);
        let packed = &mut self.words[..];
        if format == Format::Bf16 {
            self.factors.resize(0);
            dispatch!(simd, round_rows(source, packed));
        } else {
            self.factors.resize(rows);
            let factors = &mut self.factors[..];
            quantise_rows(simd, source, scaling, packed, words, factors);
        }
        LeftOperand {
            rows: WordRows {
                data: &self.words,
                stride: words,
            },
            factors: &self.factors,
        }
    }

    /// Room for `rows` rows of `width` numbers in `format` one after another, `[rows, words]`, for
    /// an epilogue to write to.
    pub fn rows(&mut self, format: Format, rows: usize, width: usize) -> &mut [u32] {
        self.words.resize(rows * format.words(width));
        &mut self.words
    }
}

/// Quantises rows of `width` f32 to the unsigned codes of a left-hand side ([`Format::Int8`]).
/// There are as many rows as `factors`, `[rows]`, which receive the value of one code unit of each.
/// Row `i` is read from `i * stride` of `source = (values, stride)` and written from `i *
/// out_stride` of `(out, out_stride)` on.
///
/// # Panics
/// If a slice is too short, or `width` is not a multiple of [`width_step`].
pub fn quantise_into(
    simd: Simd,
    width: usize,
    (source, stride): (&[f32], usize),
    (out, out_stride): (&mut [u32], usize),
    factors: &mut [f32],
) {
    let rows = factors.len();
    let words = Format::Int8.words(width);
    let source = SourceRows::new(simd, source, stride, rows, width);
    assert!(
        rows == 0 || covers(out.len(), rows, out_stride, words),
        "result too short"
    );
    quantise_rows(
        simd,
        source,
        ChannelScaling::default(),
        out,
        out_stride,
        factors,
    );
}

/// What is done to a value before it becomes a code: `value * gain + shift`, by column. If both
/// arrays are empty, values stay as they are.
#[derive(Debug, Clone, Copy, Default)]
pub struct ChannelScaling<'a> {
    /// `[width]`.
    pub gain: &'a [f32],
    /// `[width]`.
    pub shift: &'a [f32],
}

/// Quantises as many rows as there are factors to `packed`, rows `stride` words apart. The largest
/// magnitude of each row becomes the code 127 or -127.
fn quantise_rows(
    simd: Simd,
    rows: SourceRows<'_>,
    scaling: ChannelScaling<'_>,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    let counts = (scaling.gain.len(), scaling.shift.len());
    assert!(
        counts == (0, 0) || counts == (rows.width(), rows.width()),
        "every column needs its gain and shift"
    );
    dispatch!(simd, quantise_rows(rows, scaling, packed, stride, factors));
}

//! How the numbers of a product are stored, and left-hand sides packed so.
//!
//! A product of f32 costs four bytes a number and one multiply-add a lane; bf16 halves and int8
//! quarters both. Sums stay f32 (i32 for int8), and so does everything between the products.

use super::Simd;
use super::aligned::AlignedBuffer;
use super::gemm::covers;
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::lanes::{Lanes, Portable, at_bf16_level, at_level};
use super::simd::SimdLevel;

/// How the numbers on both sides of a product are stored, always in whole 32-bit words along the
/// sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// One 32-bit float to a word.
    F32,
    /// Two bfloat16, rounded to the nearest, the earlier in the low half.
    Bf16,
    /// Four integers with a factor for each row: on the left unsigned, value = (code - 128) x
    /// factor; on the right signed with a factor for each column.
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

    /// Whether the level has an instruction for it, or is the portable one, which can everything
    /// and slowly.
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
        Self {
            data: bytemuck::cast_slice(data),
            stride,
        }
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

impl Left<'_> {
    /// What is left of it from row `first` on.
    pub fn from_row(&self, first: usize) -> Self {
        let rows = Rows {
            data: &self.rows.data[first * self.rows.stride..],
            ..self.rows
        };
        Self {
            rows,
            factors: if self.factors.is_empty() {
                &[]
            } else {
                &self.factors[first..]
            },
        }
    }
}

/// Room for a packed left-hand side, used again and again.
#[derive(Default)]
pub struct OperandBuffer {
    words: AlignedBuffer<u32>,
    factors: AlignedBuffer<f32>,
}

/// Widths that [`OperandBuffer::pack`] takes are multiples of this: a vector's length.
pub fn width_step(simd: Simd) -> usize {
    if simd.level() >= SimdLevel::Avx512 {
        16
    } else {
        8
    }
}

impl OperandBuffer {
    /// `rows` rows of `width` f32, row `i` at `i * stride`, in `format`: as they are for f32, else
    /// packed into the buffer.
    ///
    /// # Panics
    /// If `source` is too short, or `width` is not a multiple of [`width_step`], or the format is
    /// not available.
    pub fn pack<'a>(
        &'a mut self,
        simd: Simd,
        format: Format,
        rows: usize,
        width: usize,
        source: (&'a [f32], usize),
    ) -> Left<'a> {
        self.pack_scaled(simd, format, rows, width, source, Channels::default())
    }

    /// The same; what becomes codes goes through `channels` first.
    ///
    /// # Panics
    /// As [`pack`](Self::pack), and if there are channels but not as many as columns.
    pub fn pack_scaled<'a>(
        &'a mut self,
        simd: Simd,
        format: Format,
        rows: usize,
        width: usize,
        (source, stride): (&'a [f32], usize),
        channels: Channels<'_>,
    ) -> Left<'a> {
        if format == Format::F32 {
            return Left {
                rows: Rows::f32(source, stride),
                factors: &[],
            };
        }
        let checked = SourceRows::new(simd, (source, stride), rows, width);
        let words = format.words(width);
        self.words.resize(rows * words);
        self.factors
            .resize(if format == Format::Int8 { rows } else { 0 });
        if format == Format::Bf16 {
            round_rows(simd, checked, &mut self.words);
        } else {
            quantise_rows(
                simd,
                checked,
                channels,
                (&mut self.words, words),
                &mut self.factors,
            );
        }
        Left {
            rows: Rows {
                data: &self.words,
                stride: words,
            },
            factors: &self.factors,
        }
    }

    /// Room for `rows` rows of `width` numbers in `format`, a row after the other, for an epilogue
    /// to fill.
    pub fn rows(&mut self, format: Format, rows: usize, width: usize) -> &mut [u32] {
        self.words.resize(rows * format.words(width));
        &mut self.words
    }
}

/// Codes of `factors.len()` rows of `width` f32 as in [`Format::Int8`] on the left, row `i` from `i
/// * stride` of `source` to `i * out_stride` of `out`, and what a code of each is worth.
///
/// # Panics
/// If a slice is too short, or `width` is not a multiple of [`width_step`].
pub fn quantise_into(
    simd: Simd,
    width: usize,
    source: (&[f32], usize),
    (out, out_stride): (&mut [u32], usize),
    factors: &mut [f32],
) {
    let (rows, words) = (factors.len(), Format::Int8.words(width));
    let source = SourceRows::new(simd, source, rows, width);
    assert!(
        rows == 0 || covers(out.len(), rows, out_stride, words),
        "result too short"
    );
    quantise_rows(
        simd,
        source,
        Channels::default(),
        (out, out_stride),
        factors,
    );
}

/// What becomes codes: `value * gain + shift`, by column; where both are empty, the value as it is.
#[derive(Debug, Clone, Copy, Default)]
pub struct Channels<'a> {
    /// `[width]`.
    pub gain: &'a [f32],
    /// `[width]`.
    pub shift: &'a [f32],
}

/// Checked rows of whole vectors, as many as what is made of them has room for.
#[derive(Clone, Copy)]
struct SourceRows {
    source: *const f32,
    stride: usize,
    width: usize,
}

impl SourceRows {
    /// # Panics
    /// If `source` is too short, or `width` is not a multiple of [`width_step`].
    fn new(simd: Simd, (source, stride): (&[f32], usize), rows: usize, width: usize) -> Self {
        assert_eq!(
            width % width_step(simd),
            0,
            "rows must be whole vectors wide"
        );
        assert!(
            rows == 0 || covers(source.len(), rows, stride, width),
            "source too short"
        );
        Self {
            source: source.as_ptr(),
            stride,
            width,
        }
    }

    /// Where one begins.
    #[inline(always)]
    unsafe fn row(&self, index: usize) -> *const f32 {
        // SAFETY: the caller counts the rows of the result, and so many were checked.
        unsafe { self.source.add(index * self.stride) }
    }
}

/// bf16 of rows.
fn round_rows(simd: Simd, rows: SourceRows, packed: &mut [u32]) {
    at_bf16_level!(
        simd,
        (rows: SourceRows = rows, packed: &mut [u32] = packed),
        round::<Portable>(rows, packed),
        round::<Avx2>(rows, packed),
        round::<Avx512>(rows, packed),
    );
}

#[inline(always)]
unsafe fn round<V: Lanes>(rows: SourceRows, packed: &mut [u32]) {
    for (index, packed) in packed.chunks_exact_mut(rows.width / 2).enumerate() {
        // SAFETY: rows are whole vectors and take half as many words.
        unsafe {
            for at in (0..rows.width).step_by(V::COUNT) {
                V::load(rows.row(index).add(at)).store_bf16(packed.as_mut_ptr().add(at / 2));
            }
        }
    }
}

/// Codes of as many rows as there are factors, the largest magnitude of each becoming 127, and what
/// one is worth.
fn quantise_rows(
    simd: Simd,
    rows: SourceRows,
    channels: Channels<'_>,
    (packed, stride): (&mut [u32], usize),
    factors: &mut [f32],
) {
    let counts = (channels.gain.len(), channels.shift.len());
    assert!(
        counts == (0, 0) || counts == (rows.width, rows.width),
        "every column needs its gain and shift"
    );
    at_level!(
        simd,
        (
            rows: SourceRows = rows,
            channels: Channels<'_> = channels,
            packed: &mut [u32] = packed,
            stride: usize = stride,
            factors: &mut [f32] = factors
        ),
        quantise::<Portable>(rows, channels, packed, stride, factors),
        quantise::<Avx2>(rows, channels, packed, stride, factors),
        quantise::<Avx512>(rows, channels, packed, stride, factors),
    );
}

#[inline(always)]
unsafe fn quantise<V: Lanes>(
    rows: SourceRows,
    channels: Channels<'_>,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    let Channels { gain, shift } = channels;
    // SAFETY: there is a gain and a shift for every column, or the first is chosen; the rest is the
    // caller's.
    unsafe {
        if gain.is_empty() {
            quantise_as::<V>(rows, |_, value| value, packed, stride, factors);
        } else {
            // Two roundings, as every level has them: the codes are the same everywhere.
            let scaled = |at, value: V| {
                value
                    .mul(V::load(gain.as_ptr().add(at)))
                    .add(V::load(shift.as_ptr().add(at)))
            };
            quantise_as::<V>(rows, scaled, packed, stride, factors);
        }
    }
}

#[inline(always)]
unsafe fn quantise_as<V: Lanes>(
    rows: SourceRows,
    scaled: impl Fn(usize, V) -> V,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    for (index, factor) in factors.iter_mut().enumerate() {
        // SAFETY: rows are whole vectors and take a quarter as many words, for which there is room.
        unsafe {
            let packed = packed.as_mut_ptr().add(index * stride).cast::<u8>();
            let mut highest = V::splat(0.0);
            for at in (0..rows.width).step_by(V::COUNT) {
                let value = scaled(at, V::load(rows.row(index).add(at)));
                highest = highest.max(value.max(V::splat(0.0).sub(value)));
            }
            let largest = highest.maximum().max(f32::MIN_POSITIVE * 256.0);
            let (scale, centre) = (V::splat(127.0 / largest), V::splat(128.0));
            for at in (0..rows.width).step_by(V::COUNT) {
                // Two roundings here too.
                let code = scaled(at, V::load(rows.row(index).add(at)))
                    .mul(scale)
                    .add(centre);
                code.store_u8(packed.add(at));
            }
            *factor = largest / 127.0;
        }
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
    (0..rows * width)
        .map(|at| value(at / width, at % width))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::ramp;
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

    proptest! {
        #[test]
        fn codes_are_those_of_what_the_channels_make_of_a_value(rows in 1usize..4, steps in 1usize..5, seed in 0u32..99) {
            let width = steps * 16;
            let (source, gain, shift) = (ramp(rows * width, seed), ramp(width, seed + 1), ramp(width, seed + 2));
            let scaled: Vec<f32> =
                source.iter().enumerate().map(|(at, value)| value * gain[at % width] + shift[at % width]).collect();
            for simd in Simd::all() {
                let (mut ours, mut plain) = (OperandBuffer::default(), OperandBuffer::default());
                let channels = Channels { gain: &gain, shift: &shift };
                let ours = ours.pack_scaled(simd, Format::Int8, rows, width, (&source, width), channels);
                let plain = plain.pack(simd, Format::Int8, rows, width, (&scaled, width));
                prop_assert_eq!((ours.rows.data, ours.factors), (plain.rows.data, plain.factors));
            }
        }
    }

    #[test]
    #[should_panic(expected = "every column needs its gain and shift")]
    fn channels_that_are_too_few_are_refused() {
        let channels = Channels {
            gain: &[1.0; 16],
            shift: &[0.0; 15],
        };
        OperandBuffer::default().pack_scaled(
            Simd::SCALAR,
            Format::Int8,
            1,
            16,
            (&[1.0; 16], 16),
            channels,
        );
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
            assert!(
                unpack(Format::Bf16, left, 1, 16)
                    .iter()
                    .all(|value| value.is_nan())
            );
        }
    }
}

//! The right-hand side of a product, packed into panels.

use super::{RightPanel, Tiling};
use crate::Simd;
use crate::aligned::AlignedBuffer;
use crate::operand::Format;
use crate::registers::ROUNDING;

/// What converts the integer sums of one panel to numbers.
#[derive(Debug, Clone, Copy)]
pub struct PanelCodes<'a> {
    /// `[columns]`: value of one code unit of each column.
    pub factors: &'a [f32],
    /// `[columns]`: what the sums are too high by, because the codes of the left-hand side have an
    /// offset of 128.
    pub offsets: &'a [i32],
}

/// A `[k, n]` matrix cut into panels, `[panels][k in words][columns]`. Columns beyond n are zero.
///
/// For int8 products, k may be cut into slices that are multiplied one at a time: the left-hand
/// side then has a factor for each row and slice, which is more exact.
#[derive(Debug, Clone)]
pub struct PackedMatrix {
    format: Format,
    data: AlignedBuffer<u32>,
    k: usize,
    n: usize,
    /// Width of a panel.
    columns: usize,
    /// Rows of k in a slice.
    slice: usize,
    /// `[panels * columns]`: value of one code unit of each column; empty unless the format is
    /// int8.
    factors: Vec<f32>,
    /// `[slices][panels * columns]`: see [`PanelCodes::offsets`]; empty unless the format is int8.
    offsets: Vec<i32>,
}

impl PackedMatrix {
    /// Packs the matrix with the number `element(i, j)` in row `i` and column `j`, to be multiplied
    /// by slices of `slice` rows (`k` if all at once).
    ///
    /// # Panics
    /// If slices are not whole words.
    pub fn pack(
        simd: Simd,
        format: Format,
        (k, n): (usize, usize),
        slice: usize,
        element: impl Fn(usize, usize) -> f32,
    ) -> Self {
        assert!(
            slice >= k || slice.is_multiple_of(format.per_word()),
            "slices must be whole words"
        );
        let columns = Tiling::of(simd).columns;
        let words = format.words(k);
        let padded = n.next_multiple_of(columns);
        let slices = k.div_ceil(slice.max(1));
        let columns_with_codes = if format == Format::Int8 { padded } else { 0 };
        let mut packed = Self {
            format,
            data: AlignedBuffer::zeroed(padded * words),
            k,
            n,
            columns,
            slice,
            factors: vec![0.0; columns_with_codes],
            offsets: vec![0; columns_with_codes * slices],
        };

        let mut values = vec![0.0; words * format.per_word()];
        for column in 0..n {
            for (row, value) in values[..k].iter_mut().enumerate() {
                *value = element(row, column);
            }
            packed.pack_column(column, words, &values);
        }
        packed
    }

    /// Packs one column of `words` words; `values` is filled up with zeros to whole words.
    fn pack_column(&mut self, column: usize, words: usize, values: &[f32]) {
        let codes = ColumnCodes::new(values);
        let panel = column / self.columns;
        let first = panel * words * self.columns + column % self.columns;
        for (word, numbers) in values.chunks_exact(self.format.per_word()).enumerate() {
            self.data[first + word * self.columns] = match *numbers {
                [value] => value.to_bits(),
                [low, high] => {
                    let bits = |value| u32::from(half::bf16::from_f32(value).to_bits());
                    bits(low) | bits(high) << 16
                }
                _ => {
                    let bytes = |part: usize| codes.code(numbers[part]).cast_unsigned();
                    u32::from_le_bytes(std::array::from_fn(bytes))
                }
            };
        }
        if self.format == Format::Int8 {
            self.factors[column] = codes.largest / 127.0;
            let padded = self.factors.len();
            for (slice, values) in values[..self.k].chunks(self.slice).enumerate() {
                let sum: i32 = values
                    .iter()
                    .map(|&value| i32::from(codes.code(value)))
                    .sum();
                self.offsets[slice * padded + column] = 128 * sum;
            }
        }
    }

    /// How its numbers are stored.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Number of columns.
    pub fn n(&self) -> usize {
        self.n
    }

    /// Number of panels; the last one may have fewer than [`Tiling::columns`] columns of the
    /// matrix.
    pub fn panels(&self) -> usize {
        self.n.div_ceil(self.columns)
    }

    /// The rows of one slice of one panel.
    pub fn panel(&self, panel: usize, slice: usize) -> RightPanel<'_> {
        let start = slice * self.slice;
        let end = self.k.min(start + self.slice);
        let first_word = self.format.words(start);
        let words = self.format.words(end) - first_word;
        let first = (panel * self.format.words(self.k) + first_word) * self.columns;
        RightPanel::whole(&self.data[first..first + words * self.columns], words)
    }

    /// What converts that slice's sums to numbers; `None` unless the format is int8.
    pub fn codes(&self, panel: usize, slice: usize) -> Option<PanelCodes<'_>> {
        if self.format != Format::Int8 {
            return None;
        }
        let first = panel * self.columns;
        let first_offset = slice * self.factors.len() + first;
        Some(PanelCodes {
            factors: &self.factors[first..first + self.columns],
            offsets: &self.offsets[first_offset..first_offset + self.columns],
        })
    }

    /// Size of the packed numbers in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val::<[u32]>(&self.data)
            + size_of_val(&self.factors[..])
            + size_of_val(&self.offsets[..])
    }
}

/// How the numbers of a column become int8 codes.
struct ColumnCodes {
    /// The magnitude that becomes 127.
    largest: f32,
}

impl ColumnCodes {
    fn new(values: &[f32]) -> Self {
        // A column of zeros keeps a factor by which it can be divided.
        let smallest = f32::MIN_POSITIVE * 256.0;
        let largest = values.iter().fold(smallest, |a, b| a.max(b.abs()));
        Self { largest }
    }

    fn code(&self, value: f32) -> i8 {
        // Rounds to the nearest integer. `round_ties_even` gives the same, but without SSE4.1,
        // which a build for every x86-64 CPU cannot assume, it is a function call for each weight.
        (value / self.largest * 127.0 + ROUNDING - ROUNDING) as i8
    }
}

//! Rounding rows to bf16 and quantising them to int8, generic over the instruction set.

use super::{ChannelScaling, width_step};
use crate::Simd;
use crate::gemm::covers;
use crate::registers::{Bf16Isa, FloatVector, VectorIsa};

/// Rows of f32 whose width is a multiple of a vector's length.
#[derive(Clone, Copy)]
pub(super) struct SourceRows<'a> {
    values: &'a [f32],
    stride: usize,
    width: usize,
}

impl<'a> SourceRows<'a> {
    /// The rows that start at multiples of `stride`.
    ///
    /// # Panics
    /// If `values` is too short for `rows` rows, or `width` is not a multiple of [`width_step`].
    pub(super) fn new(
        simd: Simd,
        values: &'a [f32],
        stride: usize,
        rows: usize,
        width: usize,
    ) -> Self {
        assert_eq!(
            width % width_step(simd),
            0,
            "rows must be whole vectors wide"
        );
        assert!(
            rows == 0 || covers(values.len(), rows, stride, width),
            "source too short"
        );
        Self {
            values,
            stride,
            width,
        }
    }

    /// Values of a row.
    pub(super) fn width(&self) -> usize {
        self.width
    }

    #[inline(always)]
    fn row(&self, index: usize) -> &'a [f32] {
        &self.values[index * self.stride..][..self.width]
    }
}

/// Rounds rows to bf16, one after another, as many as `packed` has room for.
#[inline(always)]
pub(super) fn round_rows<I: Bf16Isa>(isa: I, rows: SourceRows<'_>, packed: &mut [u32]) {
    let count = I::Floats::COUNT;
    for (index, packed) in packed.chunks_exact_mut(rows.width / 2).enumerate() {
        let vectors = rows.row(index).chunks_exact(count);
        for (values, words) in vectors.zip(packed.chunks_exact_mut(count / 2)) {
            isa.store_bf16(isa.load(values), words);
        }
    }
}

/// See [`super::quantise_rows`].
#[inline(always)]
pub(super) fn quantise_rows<'a, I: VectorIsa>(
    isa: I,
    rows: SourceRows<'a>,
    scaling: ChannelScaling<'_>,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    let ChannelScaling { gain, shift } = scaling;
    let count = I::Floats::COUNT;
    if gain.is_empty() {
        let vectors = |row: &'a [f32]| row.chunks_exact(count).map(|values| isa.load(values));
        quantise_vectors(isa, rows, vectors, packed, stride, factors);
        return;
    }
    let vectors = |row: &'a [f32]| {
        let gains = gain.chunks_exact(count);
        let shifts = shift.chunks_exact(count);
        let values = row.chunks_exact(count);
        // Not fused, since the portable code rounds twice: the codes are the same everywhere.
        values
            .zip(gains.zip(shifts))
            .map(|(values, (gain, shift))| {
                let value = isa.load(values);
                value.mul(isa.load(gain)).add(isa.load(shift))
            })
    };
    quantise_vectors(isa, rows, vectors, packed, stride, factors);
}

/// Quantises the rows; `vectors_of` gives the vectors of a row after scaling.
#[inline(always)]
fn quantise_vectors<'a, I: VectorIsa, V: Iterator<Item = I::Floats>>(
    isa: I,
    rows: SourceRows<'a>,
    vectors_of: impl Fn(&'a [f32]) -> V,
    packed: &mut [u32],
    stride: usize,
    factors: &mut [f32],
) {
    let count = I::Floats::COUNT;
    for (index, factor) in factors.iter_mut().enumerate() {
        let row = rows.row(index);
        let mut highest = isa.splat(0.0);
        for value in vectors_of(row) {
            let magnitude = value.max(isa.splat(0.0).sub(value));
            highest = highest.max(magnitude);
        }

        // A row of zeros keeps a factor by which it can be divided.
        let largest = highest.maximum().max(f32::MIN_POSITIVE * 256.0);
        let scale = isa.splat(127.0 / largest);
        let zero_code = isa.splat(128.0);
        let codes: &mut [u8] = bytemuck::cast_slice_mut(&mut packed[index * stride..]);
        for (value, codes) in vectors_of(row).zip(codes.chunks_exact_mut(count)) {
            // Not fused, as above.
            value.mul(scale).add(zero_code).store_u8(codes);
        }
        *factor = largest / 127.0;
    }
}

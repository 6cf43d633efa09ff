//! Epilogues: what is done with a block of a matrix product as soon as it is computed.

use super::polynomials::{GELU, GELU_SHORT, gelu};
use super::scalar;
#[cfg(target_arch = "x86_64")]
use super::{avx2, avx512};
use crate::Simd;
use crate::dispatch::dispatch;
use crate::gemm::{PanelCodes, Tiling, covers};
use crate::operand::Format;
use crate::registers::{Bf16Isa, FloatVector, VectorIsa};

/// What is done with a finished block of a matrix product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Epilogue {
    /// `out = block + bias`.
    Bias,
    /// `out = gelu(block + bias)`, with the exact (erf) GELU.
    BiasGelu,
    /// As `BiasGelu`, with an absolute error of up to 8e-5, which is invisible once the result is
    /// rounded to eight bits.
    BiasShortGelu,
    /// `out += block + bias`.
    BiasResidual,
}

impl Epilogue {
    /// Every epilogue.
    pub(super) const ALL: [Self; 4] = [
        Self::Bias,
        Self::BiasGelu,
        Self::BiasShortGelu,
        Self::BiasResidual,
    ];
}

/// A finished block of a matrix product, `[rows, columns]` with [`Tiling::columns`] columns.
#[derive(Debug, Clone, Copy)]
pub struct Product<'a> {
    /// Rows.
    pub rows: usize,
    /// `[rows, columns]`: the sums as floats, or as the bits of i32 if there are `codes`.
    pub block: &'a [f32],
    /// What converts the sums of an int8 product to numbers.
    pub codes: Option<PanelCodes<'a>>,
    /// `[rows]`: value of one code unit of each row; read only if there are `codes`.
    pub factors: &'a [f32],
    /// `[columns]`: added to each row, if present.
    pub bias: Option<&'a [f32]>,
}

impl Product<'_> {
    /// The number of columns, after checking that all slices are long enough.
    fn checked_columns(&self, simd: Simd) -> usize {
        let columns = Tiling::of(simd).columns;
        let rows = self.rows;
        assert!(
            covers(self.block.len(), rows, columns, columns),
            "block too short"
        );
        assert!(
            self.bias.is_none_or(|bias| bias.len() >= columns),
            "bias too short"
        );
        if let Some(codes) = self.codes {
            assert!(self.factors.len() >= rows, "factors of the rows too short");
            assert!(
                codes.factors.len() >= columns && codes.offsets.len() >= columns,
                "factors of the columns too short"
            );
        }
        columns
    }
}

/// Applies `epilogue` to a product and writes f32: row `i` of `out` starts at `i * out_stride`.
///
/// # Panics
/// If a slice is too short.
pub fn finish_block(
    simd: Simd,
    epilogue: Epilogue,
    product: Product<'_>,
    out: &mut [f32],
    out_stride: usize,
) {
    if product.rows == 0 {
        return;
    }
    let columns = product.checked_columns(simd);
    assert!(
        covers(out.len(), product.rows, out_stride, columns),
        "result too short"
    );
    let product = &product;
    dispatch!(
        simd,
        finish_f32(epilogue, product, columns, out, out_stride)
    );
}

/// Applies `epilogue` to a product and writes words of `format`: row `i` of `out` starts at
/// `i * out_stride` and is [`Format::words`] of the product's columns long.
///
/// # Panics
/// If a slice is too short, the epilogue is [`Epilogue::BiasResidual`], the format is int8, or it
/// is bf16 at [`SimdLevel::Avx512`](crate::SimdLevel) on a CPU without AVX-512 BF16.
pub fn finish_words(
    simd: Simd,
    format: Format,
    epilogue: Epilogue,
    product: Product<'_>,
    out: &mut [u32],
    out_stride: usize,
) {
    assert!(
        format != Format::Int8 && epilogue != Epilogue::BiasResidual,
        "{epilogue:?} does not end in {format:?}"
    );
    if format == Format::F32 {
        let out = bytemuck::cast_slice_mut(out);
        return finish_block(simd, epilogue, product, out, out_stride);
    }
    if product.rows == 0 {
        return;
    }
    let columns = product.checked_columns(simd);
    let words = format.words(columns);
    assert!(
        covers(out.len(), product.rows, out_stride, words),
        "result too short"
    );
    let product = &product;
    dispatch!(
        simd,
        finish_bf16(epilogue, product, columns, out, out_stride)
    );
}

/// See [`finish_block`].
#[inline(always)]
pub(super) fn finish_f32<I: VectorIsa>(
    isa: I,
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [f32],
    out_stride: usize,
) {
    if epilogue == Epilogue::BiasResidual {
        for_each_vector(isa, product, columns, |value, row, column| {
            let place = &mut out[row * out_stride + column..];
            value.add(isa.load(place)).store(place);
        });
    } else {
        for_each_activation(isa, epilogue, product, columns, |value, row, column| {
            value.store(&mut out[row * out_stride + column..]);
        });
    }
}

/// See [`finish_words`].
#[inline(always)]
pub(super) fn finish_bf16<I: Bf16Isa>(
    isa: I,
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: &mut [u32],
    out_stride: usize,
) {
    for_each_activation(isa, epilogue, product, columns, |value, row, column| {
        isa.store_bf16(value, &mut out[row * out_stride + column / 2..]);
    });
}

/// Calls `finish` with every vector of the product after bias and activation, with its row and its
/// first column.
#[inline(always)]
fn for_each_activation<I: VectorIsa>(
    isa: I,
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    mut finish: impl FnMut(I::Floats, usize, usize),
) {
    match epilogue {
        Epilogue::BiasGelu => for_each_vector(isa, product, columns, |value, row, column| {
            finish(gelu(isa, value, &GELU), row, column);
        }),
        Epilogue::BiasShortGelu => for_each_vector(isa, product, columns, |value, row, column| {
            finish(gelu(isa, value, &GELU_SHORT), row, column);
        }),
        Epilogue::Bias | Epilogue::BiasResidual => for_each_vector(isa, product, columns, finish),
    }
}

/// Calls `finish` with every vector of the product after bias, with its row and its first column.
#[inline(always)]
fn for_each_vector<I: VectorIsa>(
    isa: I,
    product: &Product<'_>,
    columns: usize,
    mut finish: impl FnMut(I::Floats, usize, usize),
) {
    for column in (0..columns).step_by(I::Floats::COUNT) {
        let bias = match product.bias {
            Some(bias) => isa.load(&bias[column..]),
            None => isa.splat(0.0),
        };
        // The offsets are i32; they pass through registers of floats bit by bit.
        let codes = product.codes.map(|codes| {
            let offsets: &[f32] = bytemuck::cast_slice(codes.offsets);
            (
                isa.load(&codes.factors[column..]),
                isa.load(&offsets[column..]),
            )
        });
        let lines = product.block.chunks_exact(columns).take(product.rows);
        for (row, line) in lines.enumerate() {
            let sum = isa.load(&line[column..]);
            let value = match codes {
                None => sum.add(bias),
                Some((factor, offset)) => {
                    let factor = factor.mul(isa.splat(product.factors[row]));
                    sum.integer_difference(offset).mul_add(factor, bias)
                }
            };
            finish(value, row, column);
        }
    }
}

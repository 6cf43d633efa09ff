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
/// If a slice is too short, or rows of `out` overlap.
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
    check_result(out.len(), product.rows, out_stride, columns);
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
/// If a slice is too short, rows of `out` overlap, the epilogue is [`Epilogue::BiasResidual`], the
/// format is int8, or it is bf16 at [`SimdLevel::Avx512`](crate::SimdLevel) on a CPU without
/// AVX-512 BF16.
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
    check_result(out.len(), product.rows, out_stride, format.words(columns));
    let product = &product;
    dispatch!(
        simd,
        finish_bf16(epilogue, product, columns, out, out_stride)
    );
}

/// # Panics
/// Unless `len` words hold `rows` rows of `width` words, `stride` words apart, that do not overlap.
fn check_result(len: usize, rows: usize, stride: usize, width: usize) {
    assert!(covers(len, rows, stride, width), "result too short");
    assert!(rows == 1 || stride >= width, "rows of the result overlap");
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
    let out = OutRows {
        words: out,
        stride: out_stride,
    };
    if epilogue == Epilogue::BiasResidual {
        finish_vectors(isa, product, columns, out, AddTo);
    } else {
        activate_vectors(isa, epilogue, product, columns, out, Store);
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
    let out = OutRows {
        words: out,
        stride: out_stride,
    };
    activate_vectors(isa, epilogue, product, columns, out, Round);
}

/// Where results are written: row `i` starts at `i * stride`, and rows do not overlap.
struct OutRows<'a, T> {
    words: &'a mut [T],
    stride: usize,
}

/// What is done with a vector of the product after bias. A trait and not closures, because these
/// must become part of the functions that are compiled for an instruction set, and the compiler
/// cannot be made to inline a closure.
trait Finish<I: VectorIsa, T>: Copy {
    /// Finishes the vector of a row that starts at `column`.
    fn finish(self, isa: I, value: I::Floats, row: &mut [T], column: usize);
}

/// Stores it.
#[derive(Clone, Copy)]
struct Store;

/// Adds it to the result.
#[derive(Clone, Copy)]
struct AddTo;

/// Stores it as bf16.
#[derive(Clone, Copy)]
struct Round;

/// Applies a GELU before it goes on.
#[derive(Clone, Copy)]
struct Activate<'a, const N: usize, F> {
    polynomial: &'a (f32, [f32; N]),
    then: F,
}

impl<I: VectorIsa> Finish<I, f32> for Store {
    #[inline(always)]
    fn finish(self, _: I, value: I::Floats, row: &mut [f32], column: usize) {
        value.store(&mut row[column..]);
    }
}

impl<I: VectorIsa> Finish<I, f32> for AddTo {
    #[inline(always)]
    fn finish(self, isa: I, value: I::Floats, row: &mut [f32], column: usize) {
        let place = &mut row[column..];
        value.add(isa.load(place)).store(place);
    }
}

impl<I: Bf16Isa> Finish<I, u32> for Round {
    #[inline(always)]
    fn finish(self, isa: I, value: I::Floats, row: &mut [u32], column: usize) {
        isa.store_bf16(value, &mut row[column / 2..]);
    }
}

impl<I: VectorIsa, T, const N: usize, F: Finish<I, T>> Finish<I, T> for Activate<'_, N, F> {
    #[inline(always)]
    fn finish(self, isa: I, value: I::Floats, row: &mut [T], column: usize) {
        let activated = gelu(isa, value, self.polynomial);
        self.then.finish(isa, activated, row, column);
    }
}

/// As [`finish_vectors`], with the activation of the epilogue first.
#[inline(always)]
fn activate_vectors<I: VectorIsa, T>(
    isa: I,
    epilogue: Epilogue,
    product: &Product<'_>,
    columns: usize,
    out: OutRows<'_, T>,
    then: impl Finish<I, T>,
) {
    match epilogue {
        Epilogue::BiasGelu => {
            let polynomial = &GELU;
            let finish = Activate { polynomial, then };
            finish_vectors(isa, product, columns, out, finish);
        }
        Epilogue::BiasShortGelu => {
            let polynomial = &GELU_SHORT;
            let finish = Activate { polynomial, then };
            finish_vectors(isa, product, columns, out, finish);
        }
        Epilogue::Bias | Epilogue::BiasResidual => {
            finish_vectors(isa, product, columns, out, then);
        }
    }
}

/// Finishes every vector of the product after bias.
#[inline(always)]
fn finish_vectors<I: VectorIsa, T>(
    isa: I,
    product: &Product<'_>,
    columns: usize,
    out: OutRows<'_, T>,
    finish: impl Finish<I, T>,
) {
    // All rows of the result but the last one are equally long. In a loop over slices of one length
    // the compiler checks bounds once, not for every vector.
    let last = product.rows - 1;
    let (rows_before, last_row) = out.words.split_at_mut(last * out.stride);
    let (lines_before, last_line) = product.block.split_at(last * columns);

    for column in (0..columns).step_by(I::Floats::COUNT) {
        let terms = ColumnTerms::new(isa, product, column);
        let rows = rows_before.chunks_exact_mut(out.stride.max(1));
        let lines = lines_before.chunks_exact(columns);
        for (number, (line, row)) in lines.zip(rows).enumerate() {
            let value = terms.value(isa, product, number, line, column);
            finish.finish(isa, value, row, column);
        }
        let value = terms.value(isa, product, last, last_line, column);
        finish.finish(isa, value, last_row, column);
    }
}

/// What makes numbers of the sums in a vector of columns.
struct ColumnTerms<F> {
    bias: F,
    /// The columns' factors and offsets, if sums are those of codes.
    codes: Option<(F, F)>,
}

impl<F: FloatVector> ColumnTerms<F> {
    #[inline(always)]
    fn new<I: VectorIsa<Floats = F>>(isa: I, product: &Product<'_>, column: usize) -> Self {
        let bias = match product.bias {
            Some(bias) => isa.load(&bias[column..]),
            None => isa.splat(0.0),
        };
        let codes = match product.codes {
            Some(codes) => {
                // The offsets are i32; they pass through registers of floats bit by bit.
                let offsets: &[f32] = bytemuck::cast_slice(codes.offsets);
                let factors = isa.load(&codes.factors[column..]);
                Some((factors, isa.load(&offsets[column..])))
            }
            None => None,
        };
        Self { bias, codes }
    }

    /// The vector from `column` on of row number `row` of the block, `line`, after bias.
    #[inline(always)]
    fn value<I: VectorIsa<Floats = F>>(
        &self,
        isa: I,
        product: &Product<'_>,
        row: usize,
        line: &[f32],
        column: usize,
    ) -> F {
        let sum = isa.load(&line[column..]);
        match self.codes {
            None => sum.add(self.bias),
            Some((factor, offset)) => {
                let factor = factor.mul(isa.splat(product.factors[row]));
                sum.integer_difference(offset).mul_add(factor, self.bias)
            }
        }
    }
}

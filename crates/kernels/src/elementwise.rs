//! What a transformer does between its matrix products: LayerNorm, softmax, and the epilogues that
//! add bias, GELU and residual to a product while it is still in the first-level cache.

mod polynomials;

use super::Simd;
use super::gemm::{PanelCodes, Tiling, covers};
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::lanes::{Lanes, Portable, at_bf16_level, at_level};
use super::operand::Format;
use polynomials::{EXP2, EXP2_SHORT, GELU, GELU_SHORT, exp2, gelu};

/// What is done with a finished block of a matrix product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Epilogue {
    /// `out = block + bias`.
    Bias,
    /// `out = gelu(block + bias)`, with the exact (erf) GELU.
    BiasGelu,
    /// As `BiasGelu`, with an error of 8e-5 that eight bits do not show.
    BiasShortGelu,
    /// `out += block + bias`.
    BiasResidual,
}

impl Epilogue {
    /// Every epilogue.
    const ALL: [Self; 4] = [
        Self::Bias,
        Self::BiasGelu,
        Self::BiasShortGelu,
        Self::BiasResidual,
    ];
}

/// A finished block of a matrix product, `[rows, columns]` with `columns` as in [`Tiling`].
#[derive(Debug, Clone, Copy)]
pub struct Product<'a> {
    /// Rows.
    pub rows: usize,
    /// The sums: floats, or bits of i32 where `codes` is there.
    pub block: &'a [f32],
    /// What turns integer sums into numbers.
    pub codes: Option<PanelCodes<'a>>,
    /// What a code of each row is worth; read only where `codes` is there.
    pub factors: &'a [f32],
    /// Added to each column, if any.
    pub bias: Option<&'a [f32]>,
}

/// Applies `epilogue` to a product; row `i` of `out` starts at `i * out_stride`.
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
    let columns = product.check(simd);
    assert!(
        covers(out.len(), product.rows, out_stride, columns),
        "result too short"
    );
    let job = FinishJob {
        columns,
        product,
        out: out.as_mut_ptr(),
        out_stride,
    };
    at_level!(
        simd,
        (job: &FinishJob<'_, f32> = &job, epilogue: Epilogue = epilogue),
        job.run::<Portable>(epilogue),
        job.run::<Avx2>(epilogue),
        job.run::<Avx512>(epilogue),
    );
}

/// As [`finish_block`] but for the residual, in `format`: row `i` of `out` starts at `i *
/// out_stride` and has [`Format::words`] of the product's columns.
///
/// # Panics
/// If a slice is too short, the epilogue is [`Epilogue::BiasResidual`], or the format is int8 or
/// not available at this level.
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
        return finish_block(
            simd,
            epilogue,
            product,
            bytemuck::cast_slice_mut(out),
            out_stride,
        );
    }
    if product.rows == 0 {
        return;
    }
    let columns = product.check(simd);
    assert!(
        covers(out.len(), product.rows, out_stride, format.words(columns)),
        "result too short"
    );
    let job = FinishJob {
        columns,
        product,
        out: out.as_mut_ptr(),
        out_stride,
    };
    at_bf16_level!(
        simd,
        (job: &FinishJob<'_, u32> = &job, epilogue: Epilogue = epilogue),
        job.run_bf16::<Portable>(epilogue),
        job.run_bf16::<Avx2>(epilogue),
        job.run_bf16::<Avx512>(epilogue),
    );
}

impl Product<'_> {
    /// Its columns, after looking at how long its slices are.
    fn check(&self, simd: Simd) -> usize {
        let (columns, rows) = (Tiling::of(simd).columns, self.rows);
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

/// The checked arguments of an epilogue, whose results are words of type `T`.
struct FinishJob<'a, T> {
    columns: usize,
    product: Product<'a>,
    out: *mut T,
    out_stride: usize,
}

impl FinishJob<'_, f32> {
    #[inline(always)]
    unsafe fn run<V: Lanes>(&self, epilogue: Epilogue) {
        // SAFETY: `finish_block` has checked the extents.
        unsafe {
            let place = |row: usize, column: usize| self.out.add(row * self.out_stride + column);
            if epilogue == Epilogue::BiasResidual {
                self.each::<V>(|value, row, column| {
                    let place = place(row, column);
                    value.add(V::load(place)).store(place);
                });
            } else {
                self.activated::<V>(epilogue, |value, row, column| {
                    value.store(place(row, column))
                });
            }
        }
    }
}

impl FinishJob<'_, u32> {
    #[inline(always)]
    unsafe fn run_bf16<V: Lanes>(&self, epilogue: Epilogue) {
        // SAFETY: `finish_words` has checked the extents.
        unsafe {
            let place =
                |row: usize, column: usize| self.out.add(row * self.out_stride + column / 2);
            self.activated::<V>(epilogue, |value, row, column| {
                value.store_bf16(place(row, column))
            });
        }
    }
}

impl<T> FinishJob<'_, T> {
    /// Every vector of the product with its bias and through its activation, its row and its
    /// column.
    #[inline(always)]
    unsafe fn activated<V: Lanes>(&self, epilogue: Epilogue, finish: impl Fn(V, usize, usize)) {
        // SAFETY: the caller's.
        unsafe {
            match epilogue {
                Epilogue::BiasGelu => {
                    self.each::<V>(|value, row, column| finish(gelu(value, &GELU), row, column))
                }
                Epilogue::BiasShortGelu => {
                    self.each::<V>(|value, row, column| {
                        finish(gelu(value, &GELU_SHORT), row, column)
                    });
                }
                Epilogue::Bias | Epilogue::BiasResidual => self.each::<V>(finish),
            }
        }
    }

    /// Every vector of the product with its bias, its row and its column.
    #[inline(always)]
    unsafe fn each<V: Lanes>(&self, finish: impl Fn(V, usize, usize)) {
        let Product {
            rows,
            block,
            codes,
            factors,
            bias,
        } = self.product;
        for column in (0..self.columns).step_by(V::COUNT) {
            // SAFETY: the extents are checked, and `columns` is a multiple of every vector's
            // length; offsets are 32 bits wide like floats.
            unsafe {
                let bias = bias.map_or(V::splat(0.0), |bias| V::load(bias.as_ptr().add(column)));
                let codes = codes.map(|codes| {
                    (
                        V::load(codes.factors.as_ptr().add(column)),
                        V::load(codes.offsets.as_ptr().add(column).cast()),
                    )
                });
                for row in 0..rows {
                    let sum = V::load(block.as_ptr().add(row * self.columns + column));
                    let value = match codes {
                        None => sum.add(bias),
                        Some((factor, offset)) => {
                            let factor = factor.mul(V::broadcast(factors.as_ptr().add(row)));
                            sum.integer_difference(offset).mul_add(factor, bias)
                        }
                    };
                    finish(value, row, column);
                }
            }
        }
    }
}

/// Rows of `input` to zero mean and unit variance: LayerNorm without its scale and shift, which
/// belong into the linear layer that follows. Both are `[rows, dim]`.
///
/// # Panics
/// If `out` is not as long as `input`.
pub fn normalize_rows(simd: Simd, dim: usize, epsilon: f32, input: &[f32], out: &mut [f32]) {
    assert_eq!(input.len(), out.len(), "rows must have a place each");
    for (row, out) in input.chunks_exact(dim).zip(out.chunks_exact_mut(dim)) {
        at_level!(
            simd,
            (row: &[f32] = row, epsilon: f32 = epsilon, out: &mut [f32] = out),
            normalize::<Portable>(row, epsilon, out),
            normalize::<Avx2>(row, epsilon, out),
            normalize::<Avx512>(row, epsilon, out),
        );
    }
}

#[inline(always)]
unsafe fn normalize<V: Lanes>(row: &[f32], epsilon: f32, out: &mut [f32]) {
    // SAFETY: every access stays below `row.len()`, which is also `out`'s.
    unsafe {
        let count = row.len() as f32;
        let mean = fold::<V>(row, 0.0, |sum, value| sum.add(value)) / count;
        let centre = V::splat(mean);
        let square = |sum: V, value: V| {
            let difference = value.sub(centre);
            difference.mul_add(difference, sum)
        };
        let variance = fold::<V>(row, mean, square) / count;
        let scale = V::splat(1.0 / (variance + epsilon).sqrt());
        map::<V>(row, out, |value| value.sub(centre).mul(scale));
    }
}

/// Sums over a row in vectors; places beyond its end hold `fill`, which must add nothing.
#[inline(always)]
unsafe fn fold<V: Lanes>(row: &[f32], fill: f32, add: impl Fn(V, V) -> V) -> f32 {
    // SAFETY: whole vectors stay inside `row`, the rest is loaded partially.
    unsafe {
        let whole = row.len() / V::COUNT * V::COUNT;
        let mut sum = V::splat(0.0);
        for at in (0..whole).step_by(V::COUNT) {
            sum = add(sum, V::load(row.as_ptr().add(at)));
        }
        if whole < row.len() {
            sum = add(
                sum,
                V::load_partial(row.as_ptr().add(whole), row.len() - whole, fill),
            );
        }
        sum.sum()
    }
}

#[inline(always)]
unsafe fn map<V: Lanes>(row: &[f32], out: &mut [f32], apply: impl Fn(V) -> V) {
    // SAFETY: as in `fold`; the callers pass an `out` as long as `row`.
    unsafe {
        let whole = row.len() / V::COUNT * V::COUNT;
        for at in (0..whole).step_by(V::COUNT) {
            apply(V::load(row.as_ptr().add(at))).store(out.as_mut_ptr().add(at));
        }
        if whole < row.len() {
            let rest = V::load_partial(row.as_ptr().add(whole), row.len() - whole, 0.0);
            apply(rest).store_partial(out.as_mut_ptr().add(whole), row.len() - whole);
        }
    }
}

/// Replaces a row of scores, already multiplied by log2(e), by `2^(score - maximum)` and gives the
/// reciprocal of their sum: softmax but for one multiplication, which costs less after the next
/// product. In bf16 the results take the first half of the row, two to a word, a lone last one
/// beside a zero.
///
/// # Panics
/// If the format is int8, or not available at this level.
pub fn exponentiate_row(simd: Simd, format: Format, scores: &mut [f32]) -> f32 {
    match format {
        Format::F32 => at_level!(
            simd,
            (scores: &mut [f32] = scores) -> f32,
            exponentiate::<Portable, false>(scores),
            exponentiate::<Avx2, false>(scores),
            exponentiate::<Avx512, false>(scores),
        ),
        Format::Bf16 => at_bf16_level!(
            simd,
            (scores: &mut [f32] = scores) -> f32,
            exponentiate::<Portable, true>(scores),
            exponentiate::<Avx2, true>(scores),
            exponentiate::<Avx512, true>(scores),
        ),
        Format::Int8 => panic!("weights of attention are f32 or bf16"),
    }
}

#[inline(always)]
unsafe fn exponentiate<V: Lanes, const BF16: bool>(scores: &mut [f32]) -> f32 {
    // SAFETY: whole vectors stay inside `scores`, the rest is loaded and stored partially, in bf16
    // in half its room. Results never lie beyond the scores read so far.
    unsafe {
        let (start, len) = (scores.as_mut_ptr(), scores.len());
        let (pairs, whole) = (
            len / (2 * V::COUNT) * (2 * V::COUNT),
            len / V::COUNT * V::COUNT,
        );
        let mut highest = [V::splat(f32::NEG_INFINITY); 2];
        for at in (0..pairs).step_by(2 * V::COUNT) {
            highest[0] = highest[0].max(V::load(start.add(at)));
            highest[1] = highest[1].max(V::load(start.add(at + V::COUNT)));
        }
        for at in (pairs..len).step_by(V::COUNT) {
            let rest = V::load_partial(start.add(at), V::COUNT.min(len - at), f32::NEG_INFINITY);
            highest[0] = highest[0].max(rest);
        }
        let highest = V::splat(highest[0].max(highest[1]).maximum());
        let power = |value: V| exp2(value.sub(highest), if BF16 { &EXP2_SHORT } else { &EXP2 });
        let store = |value: V, at: usize| {
            if BF16 {
                value.store_bf16(start.cast::<u32>().add(at / 2))
            } else {
                value.store(start.add(at))
            }
        };
        let mut sums = [V::splat(0.0); 2];
        for at in (0..pairs).step_by(2 * V::COUNT) {
            for (half, sum) in sums.iter_mut().enumerate() {
                let at = at + half * V::COUNT;
                let value = power(V::load(start.add(at)));
                store(value, at);
                *sum = sum.add(value);
            }
        }
        if pairs < whole {
            let value = power(V::load(start.add(pairs)));
            store(value, pairs);
            sums[0] = sums[0].add(value);
        }
        if whole < len {
            let count = len - whole;
            let value = power(V::load_partial(start.add(whole), count, 0.0)).first(count);
            sums[1] = sums[1].add(value);
            if BF16 {
                value.store_bf16_partial(start.cast::<u32>().add(whole / 2), count);
            } else {
                value.store_partial(start.add(whole), count);
            }
        }
        1.0 / sums[0].add(sums[1]).sum()
    }
}

/// `row *= factor` for the first `factors.len()` rows of `columns` elements, row `i` starting at `i
/// * stride`.
///
/// # Panics
/// If `out` is too short.
pub fn scale_rows(factors: &[f32], columns: usize, out: &mut [f32], stride: usize) {
    for (row, &factor) in factors.iter().enumerate() {
        out[row * stride..row * stride + columns]
            .iter_mut()
            .for_each(|value| *value *= factor);
    }
}

/// LayerNorm, softmax and the epilogues against the definition in f64, on odd sizes.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    use super::testing::{differ, ramp};
    for len in [1, 7, 16, 45] {
        let row: Vec<f32> = ramp(len, 5).iter().map(|value| value * 30.0).collect();
        let mut normed = vec![0.0; len];
        normalize_rows(simd, len, 1e-6, &row, &mut normed);
        let mean = row.iter().map(|&x| f64::from(x)).sum::<f64>() / len as f64;
        let variance = row
            .iter()
            .map(|&x| (f64::from(x) - mean).powi(2))
            .sum::<f64>()
            / len as f64;
        let mut scores = row.clone();
        let reciprocal = exponentiate_row(simd, Format::F32, &mut scores);
        let highest = row.iter().copied().fold(f32::MIN, f32::max);
        let total: f64 = row.iter().map(|&x| f64::from(x - highest).exp2()).sum();
        for (index, &x) in row.iter().enumerate() {
            let expected = (f64::from(x) - mean) / (variance + 1e-6).sqrt();
            if differ(normed[index], expected, 1e-4) {
                return Err(format!(
                    "LayerNorm of {len}: {} is not {expected}",
                    normed[index]
                ));
            }
            let expected = f64::from(x - highest).exp2() / total;
            if differ(scores[index] * reciprocal, expected, 1e-6) {
                return Err(format!(
                    "softmax of {len}: {} is not {expected}",
                    scores[index] * reciprocal
                ));
            }
        }
    }
    check_epilogues(simd)
}

fn check_epilogues(simd: Simd) -> Result<(), String> {
    use super::testing::{differ, ramp};
    let (columns, rows) = (Tiling::of(simd).columns, 5);
    let block: Vec<f32> = ramp(rows * columns, 6)
        .iter()
        .map(|value| value * 6.0)
        .collect();
    let (bias, before) = (ramp(columns, 7), ramp(rows * (columns + 3), 8));
    for epilogue in Epilogue::ALL {
        let mut out = before.clone();
        finish_block(
            simd,
            epilogue,
            plain(rows, &block, &bias),
            &mut out,
            columns + 3,
        );
        for (index, &actual) in out.iter().enumerate() {
            let (row, column) = (index / (columns + 3), index % (columns + 3));
            let expected = if column >= columns {
                f64::from(before[index])
            } else {
                let value = f64::from(block[row * columns + column] + bias[column]);
                match epilogue {
                    Epilogue::Bias => value,
                    Epilogue::BiasGelu | Epilogue::BiasShortGelu => {
                        0.5 * value * (1.0 + reference_erf(value / std::f64::consts::SQRT_2))
                    }
                    Epilogue::BiasResidual => value + f64::from(before[index]),
                }
            };
            let tolerance = if epilogue == Epilogue::BiasShortGelu {
                1e-4
            } else {
                4e-6
            };
            if differ(actual, expected, tolerance) {
                return Err(format!(
                    "{epilogue:?} at row {row}, column {column}: {actual} is not {expected}"
                ));
            }
        }
    }
    if Format::Bf16.is_available(simd) {
        check_rounded_epilogues(simd, &block, rows)
    } else {
        Ok(())
    }
}

/// Epilogues that end in bf16 against those in f32, rounded here; rows lie apart, and what is
/// between them must stay.
fn check_rounded_epilogues(simd: Simd, block: &[f32], rows: usize) -> Result<(), String> {
    let columns = Tiling::of(simd).columns;
    let (exact_stride, stride, untouched) = (columns + 3, columns / 2 + 3, 7);
    for epilogue in Epilogue::ALL
        .into_iter()
        .filter(|&epilogue| epilogue != Epilogue::BiasResidual)
    {
        let (mut exact, mut rounded) = (
            vec![0.0; rows * exact_stride],
            vec![untouched; rows * stride],
        );
        finish_block(
            simd,
            epilogue,
            plain(rows, block, block),
            &mut exact,
            exact_stride,
        );
        finish_words(
            simd,
            Format::Bf16,
            epilogue,
            plain(rows, block, block),
            &mut rounded,
            stride,
        );
        for (at, &word) in rounded.iter().enumerate() {
            let (row, column) = (at / stride, 2 * (at % stride));
            let bits = |column: usize| {
                u32::from(half::bf16::from_f32(exact[row * exact_stride + column]).to_bits())
            };
            let expected = if column < columns {
                bits(column) | bits(column + 1) << 16
            } else {
                untouched
            };
            if word != expected {
                return Err(format!(
                    "{epilogue:?} in bf16 at row {row}, column {column}: {word:x} is not {expected:x}"
                ));
            }
        }
    }
    Ok(())
}

fn plain<'a>(rows: usize, block: &'a [f32], bias: &'a [f32]) -> Product<'a> {
    Product {
        rows,
        block,
        codes: None,
        factors: &[],
        bias: Some(bias),
    }
}

/// erf by its Maclaurin series, whose terms f64 can hold up to about 5.
fn reference_erf(x: f64) -> f64 {
    if x.abs() > 5.0 {
        return x.signum();
    }
    let (mut term, mut sum) = (x, x);
    for n in 1..120 {
        term *= -x * x / f64::from(n);
        sum += term / f64::from(2 * n + 1);
    }
    sum * std::f64::consts::FRAC_2_SQRT_PI
}

#[cfg(test)]
mod tests;

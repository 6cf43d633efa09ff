//! What a transformer does between its matrix products: LayerNorm, softmax, and the epilogues that add bias, GELU and
//! residual to a product while it is still in the first-level cache.
//!
//! `exp2` and `erf` are polynomials: 2^f on [-0.5, 0.5] of degree 5 (relative error 1e-7), and erf(x) = x P(x^2) up to
//! 3.7, of degree 13 in x^2 mapped to [-1, 1], 1 beyond (absolute error 4e-7). Both were fitted for the smallest
//! maximal error.

use super::Simd;
use super::gemm::{PanelCodes, Tiling, covers};
#[cfg(target_arch = "x86_64")]
use super::lanes::{Avx2, Avx512};
use super::lanes::{Lanes, Portable, ROUNDING, at_bf16_level, at_level};
use super::operand::Format;

/// What is done with a finished block of a matrix product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Epilogue {
    /// `out = block + bias`.
    Bias,
    /// `out = gelu(block + bias)`, with the exact (erf) GELU.
    BiasGelu,
    /// `out += block + bias`.
    BiasResidual,
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
pub fn finish_block(simd: Simd, epilogue: Epilogue, product: Product<'_>, out: &mut [f32], out_stride: usize) {
    let (columns, rows) = (Tiling::of(simd).columns, product.rows);
    if rows == 0 {
        return;
    }
    assert!(covers(product.block.len(), rows, columns, columns), "block too short");
    assert!(product.bias.is_none_or(|bias| bias.len() >= columns), "bias too short");
    assert!(covers(out.len(), rows, out_stride, columns), "result too short");
    if let Some(codes) = product.codes {
        assert!(product.factors.len() >= rows, "factors of the rows too short");
        assert!(codes.factors.len() >= columns && codes.offsets.len() >= columns, "factors of the columns too short");
    }
    let job = FinishJob { epilogue, columns, product, out: out.as_mut_ptr(), out_stride };
    at_level!(
        simd,
        (job: &FinishJob<'_> = &job),
        job.run::<Portable>(),
        job.run::<Avx2>(),
        job.run::<Avx512>(),
    );
}

/// The checked arguments of [`finish_block`].
struct FinishJob<'a> {
    epilogue: Epilogue,
    columns: usize,
    product: Product<'a>,
    out: *mut f32,
    out_stride: usize,
}

impl FinishJob<'_> {
    #[inline(always)]
    unsafe fn run<V: Lanes>(&self) {
        // SAFETY: `finish_block` has checked the extents; `columns` is a multiple of every vector's length.
        unsafe {
            match self.epilogue {
                Epilogue::Bias => self.each::<V>(|value, _| value),
                Epilogue::BiasGelu => self.each::<V>(|value, _| gelu(value)),
                Epilogue::BiasResidual => self.each::<V>(|value, out| value.add(V::load(out))),
            }
        }
    }

    #[inline(always)]
    unsafe fn each<V: Lanes>(&self, finish: impl Fn(V, *const f32) -> V) {
        let Product { rows, block, codes, factors, bias } = self.product;
        for column in (0..self.columns).step_by(V::COUNT) {
            // SAFETY: as in `run`; offsets are 32 bits wide like floats.
            unsafe {
                let bias = bias.map_or(V::splat(0.0), |bias| V::load(bias.as_ptr().add(column)));
                let codes = codes.map(|codes| {
                    (V::load(codes.factors.as_ptr().add(column)), V::load(codes.offsets.as_ptr().add(column).cast()))
                });
                for row in 0..rows {
                    let out = self.out.add(row * self.out_stride + column);
                    let sum = V::load(block.as_ptr().add(row * self.columns + column));
                    let value = match codes {
                        None => sum.add(bias),
                        Some((factor, offset)) => {
                            let factor = factor.mul(V::broadcast(factors.as_ptr().add(row)));
                            sum.integer_difference(offset).mul_add(factor, bias)
                        }
                    };
                    finish(value, out).store(out);
                }
            }
        }
    }
}

/// Rows of `input` to zero mean and unit variance: LayerNorm without its scale and shift, which belong into the
/// linear layer that follows. Both are `[rows, dim]`.
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
            sum = add(sum, V::load_partial(row.as_ptr().add(whole), row.len() - whole, fill));
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

/// Replaces a row of scores, already multiplied by log2(e), by `2^(score - maximum)` and gives the reciprocal of their
/// sum: softmax but for one multiplication, which costs less after the next product. In bf16 the results take the first
/// half of the row, two to a word, a lone last one beside a zero.
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
    // SAFETY: whole vectors stay inside `scores`, the rest is loaded partially and stored by element or, in bf16, in
    // half its room. Results never lie beyond the scores read so far.
    unsafe {
        let (start, len) = (scores.as_mut_ptr(), scores.len());
        let (pairs, whole) = (len / (2 * V::COUNT) * (2 * V::COUNT), len / V::COUNT * V::COUNT);
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
        let store = |value: V, at: usize| {
            if BF16 { value.store_bf16(start.cast::<u32>().add(at / 2)) } else { value.store(start.add(at)) }
        };
        let mut sums = [V::splat(0.0); 2];
        for at in (0..pairs).step_by(2 * V::COUNT) {
            for (half, sum) in sums.iter_mut().enumerate() {
                let at = at + half * V::COUNT;
                let value = exp2(V::load(start.add(at)).sub(highest));
                store(value, at);
                *sum = sum.add(value);
            }
        }
        if pairs < whole {
            let value = exp2(V::load(start.add(pairs)).sub(highest));
            store(value, pairs);
            sums[0] = sums[0].add(value);
        }
        let mut total = sums[0].add(sums[1]).sum();
        if whole < len {
            let (mut rest, count) = ([0.0f32; 16], len - whole);
            exp2(V::load_partial(start.add(whole), count, 0.0).sub(highest)).store(rest.as_mut_ptr());
            rest[count..].fill(0.0);
            total += rest[..count].iter().sum::<f32>();
            if BF16 {
                let mut words = [0u32; 8];
                V::load(rest.as_ptr()).store_bf16(words.as_mut_ptr());
                std::ptr::copy_nonoverlapping(words.as_ptr(), start.cast::<u32>().add(whole / 2), count.div_ceil(2));
            } else {
                std::ptr::copy_nonoverlapping(rest.as_ptr(), start.add(whole), count);
            }
        }
        1.0 / total
    }
}

/// `row *= factor` for the first `factors.len()` rows of `columns` elements, row `i` starting at `i * stride`.
///
/// # Panics
/// If `out` is too short.
pub fn scale_rows(factors: &[f32], columns: usize, out: &mut [f32], stride: usize) {
    for (row, &factor) in factors.iter().enumerate() {
        out[row * stride..row * stride + columns].iter_mut().for_each(|value| *value *= factor);
    }
}

/// 2^x for x in [-126, 127]; smaller x give 2^-126, NaN stays NaN.
#[inline(always)]
unsafe fn exp2<V: Lanes>(x: V) -> V {
    // SAFETY: arithmetic only; the caller's level is available.
    unsafe {
        let x = V::splat(-126.0).max(x);
        let shifted = x.add(V::splat(ROUNDING));
        let fraction = x.sub(shifted.sub(V::splat(ROUNDING)));
        let polynomial =
            horner(fraction, &[0.001_327_647, 0.009_675_541, 0.055_507_135, 0.240_221_2, 0.693_146_94, 1.000_000_1]);
        polynomial.mul(shifted.power_of_two())
    }
}

/// x (1 + erf(x / sqrt 2)) / 2.
#[inline(always)]
unsafe fn gelu<V: Lanes>(x: V) -> V {
    // SAFETY: as in `exp2`.
    unsafe {
        let half = x.mul(V::splat(0.5));
        half.mul_add(erf(x.mul(V::splat(std::f32::consts::FRAC_1_SQRT_2))), half)
    }
}

/// The largest argument the polynomial of erf covers.
const ERF_LIMIT: f32 = 3.7;

/// P of erf(x) = x P(2 x^2 / limit^2 - 1), highest power first.
const ERF: [f32; 14] = [
    -0.001_504_677_7,
    0.003_927_413_4,
    -0.003_647_331,
    0.005_223_222,
    -0.014_151_709,
    0.025_146_15,
    -0.036_200_248,
    0.051_475_354,
    -0.070_436_64,
    0.090_624_89,
    -0.112_645_57,
    0.140_789_54,
    -0.190_467_73,
    0.382_137_54,
];

#[inline(always)]
unsafe fn erf<V: Lanes>(x: V) -> V {
    // SAFETY: as in `exp2`.
    unsafe {
        let x = V::splat(-ERF_LIMIT).max(V::splat(ERF_LIMIT).min(x));
        let mapped = x.mul(x).mul_add(V::splat(2.0 / (ERF_LIMIT * ERF_LIMIT)), V::splat(-1.0));
        V::splat(-1.0).max(V::splat(1.0).min(x.mul(horner(mapped, &ERF))))
    }
}

/// A polynomial, highest power first.
#[inline(always)]
unsafe fn horner<V: Lanes>(x: V, coefficients: &[f32]) -> V {
    // SAFETY: as in `exp2`; every caller passes at least one coefficient.
    unsafe {
        let mut value = V::splat(coefficients[0]);
        for &coefficient in &coefficients[1..] {
            value = value.mul_add(x, V::splat(coefficient));
        }
        value
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
        let variance = row.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / len as f64;
        let mut scores = row.clone();
        let reciprocal = exponentiate_row(simd, Format::F32, &mut scores);
        let highest = row.iter().copied().fold(f32::MIN, f32::max);
        let total: f64 = row.iter().map(|&x| f64::from(x - highest).exp2()).sum();
        for (index, &x) in row.iter().enumerate() {
            let expected = (f64::from(x) - mean) / (variance + 1e-6).sqrt();
            if differ(normed[index], expected, 1e-4) {
                return Err(format!("LayerNorm of {len}: {} is not {expected}", normed[index]));
            }
            let expected = f64::from(x - highest).exp2() / total;
            if differ(scores[index] * reciprocal, expected, 1e-6) {
                return Err(format!("softmax of {len}: {} is not {expected}", scores[index] * reciprocal));
            }
        }
    }
    check_epilogues(simd)
}

fn check_epilogues(simd: Simd) -> Result<(), String> {
    use super::testing::{differ, ramp};
    let (columns, rows) = (Tiling::of(simd).columns, 5);
    let block: Vec<f32> = ramp(rows * columns, 6).iter().map(|value| value * 6.0).collect();
    let (bias, before) = (ramp(columns, 7), ramp(rows * (columns + 3), 8));
    for epilogue in [Epilogue::Bias, Epilogue::BiasGelu, Epilogue::BiasResidual] {
        let mut out = before.clone();
        finish_block(simd, epilogue, plain(rows, &block, &bias), &mut out, columns + 3);
        for (index, &actual) in out.iter().enumerate() {
            let (row, column) = (index / (columns + 3), index % (columns + 3));
            let expected = if column >= columns {
                f64::from(before[index])
            } else {
                let value = f64::from(block[row * columns + column] + bias[column]);
                match epilogue {
                    Epilogue::Bias => value,
                    Epilogue::BiasGelu => 0.5 * value * (1.0 + reference_erf(value / std::f64::consts::SQRT_2)),
                    Epilogue::BiasResidual => value + f64::from(before[index]),
                }
            };
            if differ(actual, expected, 4e-6) {
                return Err(format!("{epilogue:?} at row {row}, column {column}: {actual} is not {expected}"));
            }
        }
    }
    Ok(())
}

fn plain<'a>(rows: usize, block: &'a [f32], bias: &'a [f32]) -> Product<'a> {
    Product { rows, block, codes: None, factors: &[], bias: Some(bias) }
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
mod tests {
    use super::*;
    use crate::kernels::testing::ramp;
    use proptest::prelude::*;

    #[test]
    fn erf_is_within_a_millionth_everywhere() {
        // Through GELU at a scale where its own rounding does not hide the error: erf = 2 gelu(x) / x - 1.
        for simd in Simd::all() {
            let columns = Tiling::of(simd).columns;
            let worst = (1..4000).step_by(columns).fold(0.0f64, |worst, start| {
                let block: Vec<f32> = (start..start + columns).map(|i| (i as f32 - 2000.0) / 300.0 + 0.001).collect();
                let mut out = vec![0.0; columns];
                finish_block(simd, Epilogue::BiasGelu, plain(1, &block, &vec![0.0; columns]), &mut out, columns);
                let error = |(&x, &y): (&f32, &f32)| {
                    let x = f64::from(x);
                    (2.0 * f64::from(y) / x - 1.0 - reference_erf(x / std::f64::consts::SQRT_2)).abs()
                };
                block.iter().zip(&out).filter(|(x, _)| x.abs() > 0.3).map(error).fold(worst, f64::max)
            });
            assert!(worst < 1e-6, "{}: {worst:e}", simd.level());
        }
    }

    #[test]
    fn not_a_number_is_passed_on_and_extremes_are_not() {
        for simd in Simd::all() {
            let columns = Tiling::of(simd).columns;
            let mut block = vec![0.0; columns];
            (block[0], block[1], block[2]) = (f32::NAN, 1e30, -1e30);
            let mut out = vec![0.0; columns];
            finish_block(simd, Epilogue::BiasGelu, plain(1, &block, &vec![0.0; columns]), &mut out, columns);
            assert!(out[0].is_nan(), "{}", out[0]);
            assert!((out[1] / 1e30 - 1.0).abs() < 1e-6 && (out[2] / 1e30).abs() < 1e-6, "{:?}", &out[1..3]);
            let mut scores = vec![1.0; 19];
            scores[3] = f32::NAN;
            let reciprocal = exponentiate_row(simd, Format::F32, &mut scores);
            assert!(reciprocal.is_nan());
            let mut scores = vec![-3e38, 0.0, -200.0];
            assert!((exponentiate_row(simd, Format::F32, &mut scores) - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn bf16_weights_are_the_f32_ones_rounded() {
        for simd in Simd::all().filter(|&simd| Format::Bf16.is_available(simd)) {
            for len in [1, 2, 15, 16, 17, 33, 769] {
                let row: Vec<f32> = ramp(len, 9).iter().map(|value| value * 8.0).collect();
                let (mut exact, mut rounded) = (row.clone(), row);
                let sums = [Format::F32, Format::Bf16].map(|format| {
                    let scores = if format == Format::F32 { &mut exact } else { &mut rounded };
                    exponentiate_row(simd, format, scores)
                });
                assert_eq!(sums[0], sums[1]);
                let words: &[u32] = bytemuck::cast_slice(&rounded);
                for (at, value) in exact.iter().enumerate() {
                    let bits = words[at / 2] >> (16 * (at % 2)) & 0xffff;
                    assert_eq!(bits, u32::from(half::bf16::from_f32(*value).to_bits()), "{at} of {len}");
                }
                assert!(len % 2 == 0 || words[len / 2] >> 16 == 0, "the lone last weight of {len} has a neighbour");
            }
        }
    }

    proptest! {
        #[test]
        fn every_level_agrees_with_the_scalar_twin(len in 1usize..200, seed in 0u32..1000, scale in 0.1f32..40.0) {
            let row: Vec<f32> = ramp(len, seed).iter().map(|value| value * scale).collect();
            let run = |simd| {
                let (mut normed, mut scores) = (vec![0.0; len], row.clone());
                normalize_rows(simd, len, 1e-6, &row, &mut normed);
                let reciprocal = exponentiate_row(simd, Format::F32, &mut scores);
                scale_rows(&[reciprocal], len, &mut scores, len);
                (normed, scores)
            };
            let expected = run(Simd::SCALAR);
            for simd in Simd::all() {
                let actual = run(simd);
                for index in 0..len {
                    prop_assert!((actual.0[index] - expected.0[index]).abs() < 1e-4);
                    prop_assert!((actual.1[index] - expected.1[index]).abs() < 1e-6);
                }
            }
            prop_assert!((expected.1.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        }
    }
}

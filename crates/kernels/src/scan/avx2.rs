//! AVX2: 32 codes at a time, the rows by fours.
//!
//! The only product of bytes that AVX2 has (`vpmaddubsw`) takes unsigned with signed bytes and adds
//! neighbouring products into 16 bits, saturating. So the query's signs are moved to the row
//! (`vpsignb`) and its magnitudes are used. Codes lie in -127..=127, hence two products add up to
//! at most 2 * 127 * 127 = 32,258, which never saturates.

use super::{Bounds, Codes, GROUP, LENGTH, ScanQuery, ScanRows, find_near};
use std::arch::x86_64::*;

/// Vectors that a row of codes fills.
const PARTS: usize = LENGTH / 32;

/// Rows that are summed across their registers together.
const ROWS: usize = 4;

/// See [`super::dot_products`].
#[target_feature(enable = "avx2")]
pub(super) fn dot_products(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
    let magnitude = magnitudes(query);
    let (groups, rest) = rows.as_chunks::<ROWS>();
    let (group_dots, rest_dots) = dots.as_chunks_mut::<ROWS>();
    for (group, dots) in groups.iter().zip(group_dots) {
        *dots = four_dots(query, &magnitude, group);
    }
    for (row, dot) in rest.iter().zip(rest_dots) {
        *dot = one_dot(query, &magnitude, row);
    }
}

/// See [`super::next_near`].
#[target_feature(enable = "avx2")]
pub(super) fn next_near(
    query: &ScanQuery,
    rows: &ScanRows<'_>,
    from: usize,
    threshold: f32,
    found: &mut Bounds,
) -> Option<usize> {
    let magnitude = magnitudes(&query.codes);
    find_near(
        query,
        rows,
        from,
        threshold,
        found,
        |group: &[Codes; GROUP]| {
            let mut dots = [0; GROUP];
            let (fours, _) = group.as_chunks::<ROWS>();
            let (dots_of_fours, _) = dots.as_chunks_mut::<ROWS>();
            for (four, dots) in fours.iter().zip(dots_of_fours) {
                *dots = four_dots(&query.codes, &magnitude, four);
            }
            dots
        },
    )
}

#[inline]
#[target_feature(enable = "avx2")]
fn magnitudes(query: &Codes) -> [__m256i; PARTS] {
    let mut magnitude = [_mm256_setzero_si256(); PARTS];
    for (part, magnitude) in magnitude.iter_mut().enumerate() {
        *magnitude = _mm256_abs_epi8(load(query, part));
    }
    magnitude
}

#[inline]
#[target_feature(enable = "avx2")]
fn one_dot(query: &Codes, magnitude: &[__m256i; PARTS], row: &Codes) -> i32 {
    let mut sum = _mm256_setzero_si256();
    for (part, &magnitude) in magnitude.iter().enumerate() {
        let products = products(magnitude, load(query, part), load(row, part));
        sum = _mm256_add_epi32(sum, products);
    }
    let low = _mm256_castsi256_si128(sum);
    let half = _mm_add_epi32(low, _mm256_extracti128_si256::<1>(sum));
    let quarter = _mm_hadd_epi32(half, half);
    _mm_cvtsi128_si32(_mm_hadd_epi32(quarter, quarter))
}

#[inline]
#[target_feature(enable = "avx2")]
fn four_dots(query: &Codes, magnitude: &[__m256i; PARTS], rows: &[Codes; ROWS]) -> [i32; ROWS] {
    let mut sums = [_mm256_setzero_si256(); ROWS];
    for (part, &magnitude) in magnitude.iter().enumerate() {
        let signs = load(query, part);
        for (sum, row) in sums.iter_mut().zip(rows) {
            *sum = _mm256_add_epi32(*sum, products(magnitude, signs, load(row, part)));
        }
    }

    // Adding neighbours twice leaves, in each half of the register, half of every row's sum in the
    // order of rows.
    let first_two = _mm256_hadd_epi32(sums[0], sums[1]);
    let last_two = _mm256_hadd_epi32(sums[2], sums[3]);
    let halves = _mm256_hadd_epi32(first_two, last_two);
    let low = _mm256_castsi256_si128(halves);
    let four = _mm_add_epi32(low, _mm256_extracti128_si256::<1>(halves));
    let mut dots = [0; ROWS];
    // SAFETY: the array has room for the 16 bytes written, at any address.
    unsafe { _mm_storeu_si128(dots.as_mut_ptr().cast(), four) };
    dots
}

/// Sums of four neighbouring products of 32 codes each.
#[inline]
#[target_feature(enable = "avx2")]
fn products(magnitude: __m256i, signs: __m256i, row: __m256i) -> __m256i {
    let pairs = _mm256_maddubs_epi16(magnitude, _mm256_sign_epi8(row, signs));
    _mm256_madd_epi16(pairs, _mm256_set1_epi16(1))
}

#[inline]
#[target_feature(enable = "avx2")]
fn load(codes: &Codes, part: usize) -> __m256i {
    let (parts, _) = codes.0.as_chunks::<32>();
    // SAFETY: the array holds the 32 bytes read, at any address.
    unsafe { _mm256_loadu_si256(parts[part].as_ptr().cast()) }
}

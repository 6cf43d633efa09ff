//! AVX-512 VNNI: 64 codes at a time, the rows by sixteens.
//!
//! `vpdpbusd` adds four products of unsigned with signed bytes into 32 bits without saturating.
//! The row is made unsigned by adding 128, which adds 128 times the sum of the query's codes to
//! every dot product; that is the same for all rows and is subtracted at the end.

use super::{Bounds, Codes, GROUP, LENGTH, ScanQuery, ScanRows, find_near};
use std::arch::x86_64::*;

/// Vectors that a row of codes fills.
const PARTS: usize = LENGTH / 64;

/// Rows that are summed across their registers together in the first step.
const ROWS: usize = 4;

/// See [`super::dot_products`].
#[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
pub(super) fn dot_products(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
    let query = QueryRegisters::new(query);
    for (row, dot) in rows.iter().zip(dots) {
        *dot = _mm512_reduce_add_epi32(lane_sums(&query, row)) - query.excess;
    }
}

/// See [`super::next_near`].
#[target_feature(enable = "avx2,avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
pub(super) fn next_near(
    query: &ScanQuery,
    rows: &ScanRows<'_>,
    from: usize,
    threshold: f32,
    found: &mut Bounds,
) -> Option<usize> {
    let registers = QueryRegisters::new(&query.codes);
    let dots_of = |group: &[Codes; GROUP]| sixteen_dots(&registers, group);
    find_near(query, rows, from, threshold, found, dots_of)
}

/// The query as the instruction reads it.
struct QueryRegisters {
    parts: [__m512i; PARTS],
    /// 128 times the sum of the codes.
    excess: i32,
}

impl QueryRegisters {
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    fn new(query: &Codes) -> Self {
        let mut parts = [_mm512_setzero_si512(); PARTS];
        for (part, codes) in parts.iter_mut().enumerate() {
            *codes = load(query, part);
        }
        let sum: i32 = query.0.iter().map(|&code| i32::from(code)).sum();
        Self {
            parts,
            excess: 128 * sum,
        }
    }
}

/// Sixteen numbers that add up to the dot product of a row plus the query's excess.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
fn lane_sums(query: &QueryRegisters, row: &Codes) -> __m512i {
    // Flipping the top bit adds 128 to a signed byte and makes it unsigned.
    let top_bit = _mm512_set1_epi8(i8::MIN);
    let mut sum = _mm512_setzero_si512();
    for part in 0..PARTS {
        let unsigned = _mm512_xor_si512(load(row, part), top_bit);
        sum = _mm512_dpbusd_epi32(sum, unsigned, query.parts[part]);
    }
    sum
}

/// Each quarter of the result holds one number for each of the four rows, in their order; over the
/// quarters those numbers add up to the row's dot product plus the query's excess.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
fn four_sums(query: &QueryRegisters, rows: &[Codes; ROWS]) -> __m512i {
    let a = lane_sums(query, &rows[0]);
    let b = lane_sums(query, &rows[1]);
    let c = lane_sums(query, &rows[2]);
    let d = lane_sums(query, &rows[3]);
    let ab = _mm512_add_epi32(_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b));
    let cd = _mm512_add_epi32(_mm512_unpacklo_epi32(c, d), _mm512_unpackhi_epi32(c, d));
    _mm512_add_epi32(_mm512_unpacklo_epi64(ab, cd), _mm512_unpackhi_epi64(ab, cd))
}

#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
fn sixteen_dots(query: &QueryRegisters, rows: &[Codes; GROUP]) -> [i32; GROUP] {
    let (fours, _) = rows.as_chunks::<ROWS>();
    let a = four_sums(query, &fours[0]);
    let b = four_sums(query, &fours[1]);
    let c = four_sums(query, &fours[2]);
    let d = four_sums(query, &fours[3]);
    let sums = add_quarters(add_quarters(a, b), add_quarters(c, d));
    let exact = _mm512_sub_epi32(sums, _mm512_set1_epi32(query.excess));
    let mut dots = [0; GROUP];
    // SAFETY: the array has room for the 64 bytes written, at any address.
    unsafe { _mm512_storeu_si512(dots.as_mut_ptr().cast(), exact) };
    dots
}

/// Adds neighbouring quarters of both registers: the two sums of the first, then the two of the
/// second.
#[inline]
#[target_feature(enable = "avx512f")]
fn add_quarters(first: __m512i, second: __m512i) -> __m512i {
    let even = _mm512_shuffle_i32x4::<0b10_00_10_00>(first, second);
    let odd = _mm512_shuffle_i32x4::<0b11_01_11_01>(first, second);
    _mm512_add_epi32(even, odd)
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load(codes: &Codes, part: usize) -> __m512i {
    let (parts, _) = codes.0.as_chunks::<64>();
    // SAFETY: the array holds the 64 bytes read, at any address.
    unsafe { _mm512_loadu_si512(parts[part].as_ptr().cast()) }
}

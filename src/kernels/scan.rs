//! Dot products of one int8 vector with many, as exact integers: the inner loop of the search.
//!
//! AVX2 has only a product of unsigned with signed bytes that adds neighbours into 16 bits. Codes lie in -127..=127,
//! so the query's signs are moved to the row (`vpsignb`) and two products reach at most 2 * 127 * 127 = 32,258: never
//! saturated. VNNI adds four products into 32 bits; there the query is shifted by 128 and 128 times the row's sum
//! taken off again.

use super::Simd;
#[cfg(target_arch = "x86_64")]
use super::SimdLevel;

/// Length of a vector.
pub const LENGTH: usize = 256;

/// One vector's codes, each in -127..=127, aligned to a cache line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C, align(64))]
pub struct Codes([i8; LENGTH]);

impl Codes {
    /// All zero.
    pub const ZERO: Self = Self([0; LENGTH]);

    /// Takes codes over; -128, which the kernels exclude, becomes -127.
    pub fn new(codes: [i8; LENGTH]) -> Self {
        Self(codes.map(|code| code.max(-127)))
    }

    /// The codes.
    pub fn as_array(&self) -> &[i8; LENGTH] {
        &self.0
    }
}

/// Writes the dot product of `query` with each row.
///
/// # Panics
/// If `rows` and `dots` differ in length.
pub fn dot_products(simd: Simd, query: &Codes, rows: &[Codes], dots: &mut [i32]) {
    assert_eq!(rows.len(), dots.len(), "one product per row");
    match simd.level() {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the token proves that the CPU has the level's instructions.
        SimdLevel::Avx2 => unsafe { x86::avx2(query, rows, dots) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        SimdLevel::Avx512 => unsafe { x86::avx512(query, rows, dots) },
        _ => scalar(query, rows, dots),
    }
}

fn scalar(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
    for (row, dot) in rows.iter().zip(dots) {
        *dot = query.0.iter().zip(&row.0).map(|(&a, &b)| i32::from(a) * i32::from(b)).sum();
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Codes, LENGTH};
    use std::arch::x86_64::*;

    const PARTS: usize = LENGTH / 32;

    /// Rows added up side by side.
    const ROWS: usize = 4;

    /// # Safety
    /// The CPU has AVX2.
    #[target_feature(enable = "avx2")]
    pub unsafe fn avx2(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
        let mut magnitude = [_mm256_setzero_si256(); PARTS];
        for (part, magnitude) in magnitude.iter_mut().enumerate() {
            *magnitude = _mm256_abs_epi8(load(query, part));
        }
        let (groups, rest) = rows.as_chunks::<ROWS>();
        let (group_dots, rest_dots) = dots.as_chunks_mut::<ROWS>();
        for (group, dots) in groups.iter().zip(group_dots) {
            let mut sums = [_mm256_setzero_si256(); ROWS];
            for (part, &magnitude) in magnitude.iter().enumerate() {
                let signs = load(query, part);
                for (sum, row) in sums.iter_mut().zip(group) {
                    *sum = _mm256_add_epi32(*sum, products(magnitude, signs, load(row, part)));
                }
            }
            let pairs = _mm256_hadd_epi32(_mm256_hadd_epi32(sums[0], sums[1]), _mm256_hadd_epi32(sums[2], sums[3]));
            let four = _mm_add_epi32(_mm256_castsi256_si128(pairs), _mm256_extracti128_si256::<1>(pairs));
            // SAFETY: `dots` is an array of four i32, 16 bytes.
            unsafe { _mm_storeu_si128(dots.as_mut_ptr().cast(), four) };
        }
        for (row, dot) in rest.iter().zip(rest_dots) {
            let mut sum = _mm256_setzero_si256();
            for (part, &magnitude) in magnitude.iter().enumerate() {
                sum = _mm256_add_epi32(sum, products(magnitude, load(query, part), load(row, part)));
            }
            let mut lanes = [0i32; 8];
            // SAFETY: `lanes` is 32 bytes.
            unsafe { _mm256_storeu_si256(lanes.as_mut_ptr().cast(), sum) };
            *dot = lanes.iter().sum();
        }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn products(magnitude: __m256i, signs: __m256i, row: __m256i) -> __m256i {
        let pairs = _mm256_maddubs_epi16(magnitude, _mm256_sign_epi8(row, signs));
        _mm256_madd_epi16(pairs, _mm256_set1_epi16(1))
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn load(codes: &Codes, part: usize) -> __m256i {
        let bytes: &[i8] = &codes.0[part * 32..part * 32 + 32];
        // SAFETY: the slice is 32 bytes long; the load needs no alignment.
        unsafe { _mm256_loadu_si256(bytes.as_ptr().cast()) }
    }

    const WIDE_PARTS: usize = LENGTH / 64;

    /// # Safety
    /// The CPU has AVX-512 F, BW and VNNI.
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    pub unsafe fn avx512(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
        let shift = _mm512_set1_epi8(i8::MIN);
        let mut shifted = [_mm512_setzero_si512(); WIDE_PARTS];
        for (part, shifted) in shifted.iter_mut().enumerate() {
            // Flipping the top bit adds 128 to a signed byte and leaves it unsigned.
            *shifted = _mm512_xor_si512(load_wide(query, part), shift);
        }
        for (row, dot) in rows.iter().zip(dots) {
            let (mut sum, mut excess) = (_mm512_setzero_si512(), _mm512_setzero_si512());
            for (part, &shifted) in shifted.iter().enumerate() {
                let row = load_wide(row, part);
                sum = _mm512_dpbusd_epi32(sum, shifted, row);
                excess = _mm512_dpbusd_epi32(excess, shift, row);
            }
            *dot = _mm512_reduce_add_epi32(_mm512_sub_epi32(sum, excess));
        }
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn load_wide(codes: &Codes, part: usize) -> __m512i {
        let bytes: &[i8] = &codes.0[part * 64..part * 64 + 64];
        // SAFETY: the slice is 64 bytes long; the load needs no alignment.
        unsafe { _mm512_loadu_si512(bytes.as_ptr().cast()) }
    }
}

/// Compares the level with the scalar twin, extreme codes included.
pub(super) fn check(simd: Simd) -> Result<(), String> {
    let mut state = 0x2545_f491_4f6c_dd1du64;
    let mut code = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 33) % 255) as i8
    };
    let extreme = [Codes::new([127; LENGTH]), Codes::new([-127; LENGTH]), Codes::ZERO];
    let mut rows: Vec<Codes> = (0..14).map(|_| Codes::new(std::array::from_fn(|_| code()))).collect();
    rows.extend(extreme);
    for (number, query) in rows.iter().enumerate() {
        for count in [0, 1, 3, 4, 7, rows.len()] {
            let (mut expected, mut found) = (vec![0; count], vec![0; count]);
            scalar(query, &rows[..count], &mut expected);
            dot_products(simd, query, &rows[..count], &mut found);
            if expected != found {
                return Err(format!("query {number} with {count} rows: {found:?} is not {expected:?}"));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn codes() -> impl Strategy<Value = Codes> {
        prop::collection::vec(any::<i8>(), LENGTH).prop_map(|codes| Codes::new(codes.try_into().unwrap()))
    }

    proptest! {
        #[test]
        fn every_level_gives_the_integers_of_the_scalar_twin(
            query in codes(), rows in prop::collection::vec(codes(), 0..11),
        ) {
            let mut expected = vec![0; rows.len()];
            scalar(&query, &rows, &mut expected);
            for simd in Simd::all() {
                let mut found = vec![0; rows.len()];
                dot_products(simd, &query, &rows, &mut found);
                prop_assert_eq!(&found, &expected);
            }
        }
    }

    #[test]
    fn extreme_codes_do_not_saturate() {
        let (high, low) = (Codes::new([127; LENGTH]), Codes::new([i8::MIN; LENGTH]));
        for simd in Simd::all() {
            let mut dots = [0; 2];
            dot_products(simd, &high, &[high, low], &mut dots);
            assert_eq!(dots, [127 * 127 * 256, -127 * 127 * 256]);
        }
    }
}

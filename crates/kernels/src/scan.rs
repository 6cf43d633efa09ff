//! One int8 vector against many: exact dot products, the bounds on the distance that follow from
//! them, and which rows come near enough to be looked at. The inner loop of the search.
//!
//! A scan of a large map waits for memory, so a row must cost little else: sixteen rows are
//! multiplied, added up across their registers together, bounded and compared at once. Rows are not
//! prefetched by instruction: the columns are read straight through, which the CPU foresees by
//! itself, and a prefetch per line made the scan a third slower.
//!
//! AVX2 has only a product of unsigned with signed bytes that adds neighbours into 16 bits. Codes
//! lie in -127..=127, so the query's signs are moved to the row (`vpsignb`) and two products reach
//! at most 2 * 127 * 127 = 32,258: never saturated. VNNI adds four products into 32 bits; there the
//! row is shifted by 128, and 128 times the query's sum, which is the same for every row, taken off
//! again.

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

/// Rows whose bounds are found at once.
pub const GROUP: usize = 16;

/// The query's side of the bounds.
#[derive(Debug, Clone, Copy)]
pub struct Probe {
    /// Quantised query.
    pub codes: Codes,
    /// Factor of the codes.
    pub scale: f32,
    /// Squared length of the vector.
    pub square: f32,
    /// At least the length of the vector.
    pub length: f32,
    /// At least the length of what the codes miss.
    pub error: f32,
    /// Share of the squared lengths by which bounds are widened against rounding.
    pub slack: f32,
}

/// The rows' side of the bounds, column by column.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a> {
    /// Quantised vectors.
    pub codes: &'a [Codes],
    /// Factors of the codes.
    pub scales: &'a [f32],
    /// At least the lengths of what the codes miss.
    pub errors: &'a [f32],
    /// Squared lengths of the vectors.
    pub squares: &'a [f32],
    /// At least the length of the longest quantised vector.
    pub longest: f32,
}

/// Bytes of a row that a scan reads.
pub const ROW_BYTES: usize = size_of::<Codes>() + 3 * size_of::<f32>();

/// Bounds on the squared distances of sixteen rows from the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Not more than the distance.
    pub lower: [f32; GROUP],
    /// Not less.
    pub upper: [f32; GROUP],
}

impl Bounds {
    /// To be overwritten.
    pub const NONE: Self = Self {
        lower: [f32::NAN; GROUP],
        upper: [f32::NAN; GROUP],
    };
}

/// The bounds of one row, from the dot product of its codes with the query's:
/// |q|^2 + |x|^2 - 2 <q', x'> -+ (2 (|q| ex + eq |x'|) + slack (|q|^2 + |x|^2)).
#[inline(always)]
pub fn bounds(probe: &Probe, rows: &Rows<'_>, row: usize, dot: i32) -> (f32, f32) {
    let squares = probe.square + rows.squares[row];
    let similarity = dot as f32 * (probe.scale * rows.scales[row]);
    let error = probe.length * rows.errors[row] + probe.error * rows.longest;
    let (middle, half) = (
        squares - 2.0 * similarity,
        2.0 * error + probe.slack * squares,
    );
    (middle - half, middle + half)
}

/// Looks through whole groups of [`GROUP`] rows from row `from` (a multiple of that) on for one
/// with a lower bound that does not exceed `threshold` (or is not a number), and tells where it
/// starts and its bounds. Rows beyond the last whole group are the caller's.
///
/// # Panics
/// If the columns differ in length.
pub fn next_near(
    simd: Simd,
    probe: &Probe,
    rows: &Rows<'_>,
    from: usize,
    threshold: f32,
    found: &mut Bounds,
) -> Option<usize> {
    let len = rows.codes.len();
    assert!(
        rows.scales.len() == len && rows.errors.len() == len && rows.squares.len() == len,
        "columns of one length"
    );
    match simd.level() {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the token proves that the CPU has the level's instructions.
        SimdLevel::Avx2 => unsafe { x86::next_near_avx2(probe, rows, from, threshold, found) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        SimdLevel::Avx512 | SimdLevel::Amx => unsafe {
            x86::next_near_avx512(probe, rows, from, threshold, found)
        },
        _ => next_near_scalar(probe, rows, from, threshold, found),
    }
}

/// The definition.
fn next_near_scalar(
    probe: &Probe,
    rows: &Rows<'_>,
    from: usize,
    threshold: f32,
    found: &mut Bounds,
) -> Option<usize> {
    (from..rows.codes.len())
        .step_by(GROUP)
        .take_while(|start| rows.codes.len() - start >= GROUP)
        .find(|&start| {
            let mut dots = [0; GROUP];
            scalar(&probe.codes, &rows.codes[start..start + GROUP], &mut dots);
            is_near(probe, rows, start, &dots, threshold, found)
        })
}

/// Fills `found` with the bounds of the group at `start`; whether one of them may be near.
#[inline(always)]
#[expect(
    clippy::neg_cmp_op_on_partial_ord,
    reason = "a bound that is not a number keeps its row"
)]
fn is_near(
    probe: &Probe,
    rows: &Rows<'_>,
    start: usize,
    dots: &[i32; GROUP],
    threshold: f32,
    found: &mut Bounds,
) -> bool {
    let column = |values: &[f32]| -> [f32; GROUP] {
        std::array::from_fn(|lane| values[start..start + GROUP][lane])
    };
    let (scales, errors, squares) = (
        column(rows.scales),
        column(rows.errors),
        column(rows.squares),
    );
    let group = Rows {
        codes: &[],
        scales: &scales,
        errors: &errors,
        squares: &squares,
        longest: rows.longest,
    };
    let mut near = false;
    // Without a branch, so that it becomes vector code.
    for (lane, &dot) in dots.iter().enumerate() {
        (found.lower[lane], found.upper[lane]) = bounds(probe, &group, lane, dot);
        near |= !(found.lower[lane] > threshold);
    }
    near
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
        SimdLevel::Avx512 | SimdLevel::Amx => unsafe { x86::avx512(query, rows, dots) },
        _ => scalar(query, rows, dots),
    }
}

fn scalar(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
    for (row, dot) in rows.iter().zip(dots) {
        *dot = query
            .0
            .iter()
            .zip(&row.0)
            .map(|(&a, &b)| i32::from(a) * i32::from(b))
            .sum();
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Bounds, Codes, GROUP, LENGTH, Probe, Rows, is_near};
    use std::arch::x86_64::*;

    const PARTS: usize = LENGTH / 32;

    /// Rows added up side by side.
    const ROWS: usize = 4;

    #[target_feature(enable = "avx2")]
    pub fn avx2(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
        let magnitude = magnitudes(query);
        let (groups, rest) = rows.as_chunks::<ROWS>();
        let (group_dots, rest_dots) = dots.as_chunks_mut::<ROWS>();
        for (group, dots) in groups.iter().zip(group_dots) {
            *dots = four_avx2(query, &magnitude, group);
        }
        for (row, dot) in rest.iter().zip(rest_dots) {
            let mut sum = _mm256_setzero_si256();
            for (part, &magnitude) in magnitude.iter().enumerate() {
                sum =
                    _mm256_add_epi32(sum, products(magnitude, load(query, part), load(row, part)));
            }
            let mut lanes = [0i32; 8];
            // SAFETY: `lanes` is 32 bytes.
            unsafe { _mm256_storeu_si256(lanes.as_mut_ptr().cast(), sum) };
            *dot = lanes.iter().sum();
        }
    }

    #[target_feature(enable = "avx2")]
    pub fn next_near_avx2(
        probe: &Probe,
        rows: &Rows<'_>,
        from: usize,
        threshold: f32,
        found: &mut Bounds,
    ) -> Option<usize> {
        let magnitude = magnitudes(&probe.codes);
        let mut start = from;
        while let Some(group) = rows
            .codes
            .get(start..)
            .and_then(|rest| rest.first_chunk::<GROUP>())
        {
            let mut dots = [0; GROUP];
            for (four, dots) in group
                .as_chunks::<ROWS>()
                .0
                .iter()
                .zip(dots.as_chunks_mut::<ROWS>().0)
            {
                *dots = four_avx2(&probe.codes, &magnitude, four);
            }
            if is_near(probe, rows, start, &dots, threshold, found) {
                return Some(start);
            }
            start += GROUP;
        }
        None
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
    fn four_avx2(query: &Codes, magnitude: &[__m256i; PARTS], rows: &[Codes; ROWS]) -> [i32; ROWS] {
        let mut sums = [_mm256_setzero_si256(); ROWS];
        for (part, &magnitude) in magnitude.iter().enumerate() {
            let signs = load(query, part);
            for (sum, row) in sums.iter_mut().zip(rows) {
                *sum = _mm256_add_epi32(*sum, products(magnitude, signs, load(row, part)));
            }
        }
        let pairs = _mm256_hadd_epi32(
            _mm256_hadd_epi32(sums[0], sums[1]),
            _mm256_hadd_epi32(sums[2], sums[3]),
        );
        let four = _mm_add_epi32(
            _mm256_castsi256_si128(pairs),
            _mm256_extracti128_si256::<1>(pairs),
        );
        let mut dots = [0; ROWS];
        // SAFETY: `dots` is an array of four i32, 16 bytes.
        unsafe { _mm_storeu_si128(dots.as_mut_ptr().cast(), four) };
        dots
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

    /// The query for VNNI: its registers, and 128 times its sum.
    struct Wide {
        parts: [__m512i; WIDE_PARTS],
        excess: i32,
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    fn widened(query: &Codes) -> Wide {
        let mut parts = [_mm512_setzero_si512(); WIDE_PARTS];
        for (part, codes) in parts.iter_mut().enumerate() {
            *codes = load_wide(query, part);
        }
        Wide {
            parts,
            excess: 128 * query.0.iter().map(|&code| i32::from(code)).sum::<i32>(),
        }
    }

    /// Lanes that add up to the dot product and the query's excess.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    fn lanes_wide(query: &Wide, row: &Codes) -> __m512i {
        // Flipping the top bit adds 128 to a signed byte and leaves it unsigned.
        let shift = _mm512_set1_epi8(i8::MIN);
        let mut sum = _mm512_setzero_si512();
        for part in 0..WIDE_PARTS {
            sum = _mm512_dpbusd_epi32(
                sum,
                _mm512_xor_si512(load_wide(row, part), shift),
                query.parts[part],
            );
        }
        sum
    }

    /// Lanes 4r + i of the result, r the row among four, add up to row i's sum over r.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    fn four_wide(query: &Wide, rows: &[Codes; ROWS]) -> __m512i {
        let (a, b) = (lanes_wide(query, &rows[0]), lanes_wide(query, &rows[1]));
        let (c, d) = (lanes_wide(query, &rows[2]), lanes_wide(query, &rows[3]));
        let ab = _mm512_add_epi32(_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b));
        let cd = _mm512_add_epi32(_mm512_unpacklo_epi32(c, d), _mm512_unpackhi_epi32(c, d));
        _mm512_add_epi32(_mm512_unpacklo_epi64(ab, cd), _mm512_unpackhi_epi64(ab, cd))
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    fn sixteen_wide(query: &Wide, rows: &[Codes; GROUP]) -> [i32; GROUP] {
        let (fours, _) = rows.as_chunks::<ROWS>();
        let (a, b) = (four_wide(query, &fours[0]), four_wide(query, &fours[1]));
        let (c, d) = (four_wide(query, &fours[2]), four_wide(query, &fours[3]));
        // Each register has four rows in each of its quarters; quarters are added up, and come out
        // in order of rows.
        let ab = _mm512_add_epi32(
            _mm512_shuffle_i32x4::<0b10_00_10_00>(a, b),
            _mm512_shuffle_i32x4::<0b11_01_11_01>(a, b),
        );
        let cd = _mm512_add_epi32(
            _mm512_shuffle_i32x4::<0b10_00_10_00>(c, d),
            _mm512_shuffle_i32x4::<0b11_01_11_01>(c, d),
        );
        let sums = _mm512_add_epi32(
            _mm512_shuffle_i32x4::<0b10_00_10_00>(ab, cd),
            _mm512_shuffle_i32x4::<0b11_01_11_01>(ab, cd),
        );
        let mut dots = [0; GROUP];
        // SAFETY: `dots` is an array of sixteen i32, 64 bytes.
        unsafe {
            _mm512_storeu_si512(
                dots.as_mut_ptr().cast(),
                _mm512_sub_epi32(sums, _mm512_set1_epi32(query.excess)),
            )
        };
        dots
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    pub fn avx512(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
        let wide = widened(query);
        for (row, dot) in rows.iter().zip(dots) {
            *dot = _mm512_reduce_add_epi32(lanes_wide(&wide, row)) - wide.excess;
        }
    }

    #[target_feature(enable = "avx2,avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
    pub fn next_near_avx512(
        probe: &Probe,
        rows: &Rows<'_>,
        from: usize,
        threshold: f32,
        found: &mut Bounds,
    ) -> Option<usize> {
        let wide = widened(&probe.codes);
        let mut start = from;
        while let Some(group) = rows
            .codes
            .get(start..)
            .and_then(|rest| rest.first_chunk::<GROUP>())
        {
            let dots = sixteen_wide(&wide, group);
            if is_near(probe, rows, start, &dots, threshold, found) {
                return Some(start);
            }
            start += GROUP;
        }
        None
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
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        ((state >> 33) % 255) as i8
    };
    let extreme = [
        Codes::new([127; LENGTH]),
        Codes::new([-127; LENGTH]),
        Codes::ZERO,
    ];
    let mut rows: Vec<Codes> = (0..14)
        .map(|_| Codes::new(std::array::from_fn(|_| code())))
        .collect();
    rows.extend(extreme);
    for (number, query) in rows.iter().enumerate() {
        for count in [0, 1, 3, 4, 7, rows.len()] {
            let (mut expected, mut found) = (vec![0; count], vec![0; count]);
            scalar(query, &rows[..count], &mut expected);
            dot_products(simd, query, &rows[..count], &mut found);
            if expected != found {
                return Err(format!(
                    "query {number} with {count} rows: {found:?} is not {expected:?}"
                ));
            }
        }
    }
    check_near(simd, &rows)
}

/// Compares which groups are near, and their bounds.
fn check_near(simd: Simd, codes: &[Codes]) -> Result<(), String> {
    let codes: Vec<Codes> = codes.iter().cycle().take(5 * GROUP + 3).copied().collect();
    let column = |scale: f32| -> Vec<f32> {
        (0..codes.len())
            .map(|row| (row % 7 + 1) as f32 * scale)
            .collect()
    };
    let (scales, errors, squares) = (column(1e-3), column(1e-2), column(0.5));
    let rows = Rows {
        codes: &codes,
        scales: &scales,
        errors: &errors,
        squares: &squares,
        longest: 3.0,
    };
    for &codes in &codes[..GROUP] {
        let probe = Probe {
            codes,
            scale: 2e-3,
            square: 1.5,
            length: 1.25,
            error: 0.02,
            slack: 1e-4,
        };
        for threshold in [f32::NEG_INFINITY, -20.0, -2.0, 0.5, f32::INFINITY, f32::NAN] {
            let mut from = Some(0);
            while let Some(start) = from {
                let (mut expected, mut found) = (Bounds::NONE, Bounds::NONE);
                let twin = next_near_scalar(&probe, &rows, start, threshold, &mut expected);
                let ours = next_near(simd, &probe, &rows, start, threshold, &mut found);
                if ours != twin || twin.is_some() && expected != found {
                    return Err(format!(
                        "the group near from row {start} on: {ours:?} {found:?} is not {twin:?} {expected:?}"
                    ));
                }
                from = twin.map(|group| group + GROUP);
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
        prop::collection::vec(any::<i8>(), LENGTH)
            .prop_map(|codes| Codes::new(codes.try_into().unwrap()))
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

        #[test]
        fn every_level_finds_the_groups_and_bounds_of_the_scalar_twin(
            query in codes(), rows in prop::collection::vec((codes(), 0f32..2.0, 0f32..0.1, 0f32..3.0), 0..60),
            (scale, threshold) in (0f32..1e-3, -1f32..4.0),
        ) {
            let (codes, rest): (Vec<_>, Vec<_>) = rows.into_iter().map(|row| (row.0, [row.1 / 1e3, row.2, row.3])).unzip();
            let [scales, errors, squares] = [0, 1, 2].map(|i| rest.iter().map(|row| row[i]).collect::<Vec<_>>());
            let rows = Rows { codes: &codes, scales: &scales, errors: &errors, squares: &squares, longest: 1.5 };
            let probe = Probe { codes: query, scale, square: 1.0, length: 1.0, error: 0.01, slack: 1e-4 };
            for simd in Simd::all() {
                let (mut expected, mut found) = (Bounds::NONE, Bounds::NONE);
                let twin = next_near_scalar(&probe, &rows, 0, threshold, &mut expected);
                prop_assert_eq!(next_near(simd, &probe, &rows, 0, threshold, &mut found), twin);
                if let Some(start) = twin {
                    prop_assert_eq!(found, expected);
                    for row in start..start + GROUP {
                        let mut dot = [0];
                        scalar(&query, &codes[row..=row], &mut dot);
                        let (lower, upper) = bounds(&probe, &rows, row, dot[0]);
                        prop_assert_eq!((found.lower[row - start], found.upper[row - start]), (lower, upper));
                    }
                }
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

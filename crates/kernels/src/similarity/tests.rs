//! The scalar reference against the definition, and every level against the scalar reference.

#![expect(
    clippy::needless_range_loop,
    reason = "rows and columns index several arrays"
)]

use super::check::{RandomDescriptors, maxima_at};
use super::*;
use proptest::prelude::*;

/// The maxima by the plainest loops, in f64: products of codes and small power-of-two factors
/// are exact there.
fn plain(
    columns: Int8Descriptors<'_>,
    rows: Int8Descriptors<'_>,
    wanted: &Blocks,
) -> (Vec<[u32; 3]>, Vec<[u32; 3]>) {
    let section_of =
        |q: &Int8Descriptors<'_>, i: usize| (0..3).find(|&s| i < q.start(s) + q.counts[s]).unwrap();
    let similarity = |r: usize, c: usize| {
        let values = |q: &Int8Descriptors<'_>, i: usize| -> Vec<f64> {
            q.codes[i * q.dim..][..q.dim]
                .iter()
                .map(|&v| f64::from(v) * f64::from(q.factors[i]))
                .collect()
        };
        values(&rows, r)
            .iter()
            .zip(values(&columns, c))
            .map(|(a, b)| a * b)
            .sum::<f64>()
    };
    let mut best_column = vec![[u32::MAX; 3]; rows.len()];
    let mut best_row = vec![[u32::MAX; 3]; columns.len()];
    for r in 0..rows.len() {
        for c in 0..columns.len() {
            let rs = section_of(&rows, r);
            let cs = section_of(&columns, c);
            if !wanted[rs][cs] {
                continue;
            }
            let best = &mut best_column[r][cs];
            if *best == u32::MAX || similarity(r, c) > similarity(r, *best as usize) {
                *best = c as u32;
            }
            let best = &mut best_row[c][rs];
            if *best == u32::MAX || similarity(r, c) > similarity(*best as usize, c) {
                *best = r as u32;
            }
        }
    }
    (best_column, best_row)
}

#[test]
fn scalar_reference_follows_the_definition() {
    let wanted = [[true, true, false], [true, true, true], [false, true, true]];
    let r = RandomDescriptors::new(24, [5, 4, 3], 1);
    let c = RandomDescriptors::new(24, [6, 2, 4], 2);
    // Factors that differ only by powers of two keep the reference's f64 sums exact.
    let pow = |s: &RandomDescriptors| RandomDescriptors {
        factors: s
            .factors
            .iter()
            .enumerate()
            .map(|(i, _)| 0.5f32.powi(i as i32 % 3))
            .collect(),
        codes: s.codes.clone(),
        ..*s
    };
    let r = pow(&r);
    let c = pow(&c);
    let got = maxima_at(Simd::SCALAR, c.quantised(24), r.quantised(24), &wanted);
    let (best_column, best_row) = plain(c.quantised(24), r.quantised(24), &wanted);
    for section in 0..3 {
        assert!(
            got.rows[section]
                .iter()
                .zip(&best_column)
                .all(|(g, w)| g.index == w[section])
        );
        assert!(
            got.columns[section]
                .iter()
                .zip(&best_row)
                .all(|(g, w)| g.index == w[section])
        );
    }
}

#[test]
fn extreme_codes_do_not_saturate() {
    for simd in Simd::all() {
        let dim = 1024;
        let codes = vec![-127i8; dim];
        let factors = [1.0f32];
        let one = Int8Descriptors {
            dim,
            counts: [1, 0, 0],
            codes: &codes,
            factors: &factors,
        };
        let got = maxima_at(simd, one, one, &[[true; 3]; 3]);
        assert_eq!(
            got.rows[0][0],
            Best {
                value: 127.0 * 127.0 * 1024.0,
                index: 0
            },
            "{:?}",
            simd.level()
        );
    }
}

#[test]
fn packing_again_forgets_the_columns_before() {
    for simd in Simd::all() {
        let large = RandomDescriptors::new(40, [30, 20, 10], 5);
        let small = RandomDescriptors::new(7, [2, 1, 3], 6);
        let rows = RandomDescriptors::new(7, [4, 4, 4], 7);
        let wanted = [[true; 3]; 3];
        let mut packed = PackedColumns::new(simd);
        let mut out = BlockMaxima::default();
        let mut scratch = Scratch::default();
        packed.pack(large.quantised(40));
        block_maxima(
            &packed,
            large.quantised(40),
            &wanted,
            &mut scratch,
            &mut out,
        );
        packed.pack(small.quantised(7));
        block_maxima(&packed, rows.quantised(7), &wanted, &mut scratch, &mut out);
        assert_eq!(
            out,
            maxima_at(Simd::SCALAR, small.quantised(7), rows.quantised(7), &wanted)
        );
    }
}

#[test]
#[should_panic(expected = "do not fill")]
fn counts_that_wrap_around_are_refused() {
    let half = usize::MAX / 2 + 1;
    let wrapping = Int8Descriptors {
        dim: 2,
        counts: [half, half, 0],
        codes: &[],
        factors: &[],
    };
    PackedColumns::new(Simd::best()).pack(wrapping);
}

#[test]
#[should_panic(expected = "different lengths")]
fn descriptors_of_different_lengths_are_refused() {
    let a = RandomDescriptors::new(8, [1, 1, 1], 1);
    let b = RandomDescriptors::new(9, [1, 1, 1], 1);
    maxima_at(
        Simd::SCALAR,
        a.quantised(8),
        b.quantised(9),
        &[[true; 3]; 3],
    );
}

fn counts() -> impl Strategy<Value = [usize; 3]> {
    [0usize..40, 0usize..20, 0usize..10]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn every_level_gives_the_bits_of_the_scalar_reference(
        dim in 1usize..140,
        rows in counts(),
        columns in counts(),
        seed: u64,
        wanted in proptest::array::uniform3(proptest::array::uniform3(any::<bool>())),
    ) {
        let r = RandomDescriptors::new(dim, rows, seed);
        let c = RandomDescriptors::new(dim, columns, !seed);
        let expected = maxima_at(Simd::SCALAR, c.quantised(dim), r.quantised(dim), &wanted);
        for simd in Simd::all() {
            let got = maxima_at(simd, c.quantised(dim), r.quantised(dim), &wanted);
            prop_assert_eq!(&got, &expected, "{:?}", simd.level());
        }
    }
}

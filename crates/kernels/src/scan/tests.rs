//! Every instruction set against the scalar reference, on random and extreme codes.

use super::*;
use proptest::prelude::*;

fn codes() -> impl Strategy<Value = Codes> {
    prop::collection::vec(any::<i8>(), LENGTH)
        .prop_map(|codes| Codes::new(codes.try_into().unwrap()))
}

proptest! {
    #[test]
    fn every_level_gives_the_integers_of_the_scalar_reference(
        query in codes(),
        rows in prop::collection::vec(codes(), 0..11),
    ) {
        let mut expected = vec![0; rows.len()];
        scalar::dot_products(&query, &rows, &mut expected);
        for simd in Simd::all() {
            let mut found = vec![0; rows.len()];
            dot_products(simd, &query, &rows, &mut found);
            prop_assert_eq!(&found, &expected);
        }
    }

    #[test]
    fn every_level_finds_the_groups_and_bounds_of_the_scalar_reference(
        query in codes(),
        rows in prop::collection::vec((codes(), 0f32..2.0, 0f32..0.1, 0f32..3.0), 0..60),
        (scale, threshold) in (0f32..1e-3, -1f32..4.0),
    ) {
        let (codes, rest): (Vec<_>, Vec<_>) = rows
            .into_iter()
            .map(|row| (row.0, [row.1 / 1e3, row.2, row.3]))
            .unzip();
        let [scales, errors, squares] =
            [0, 1, 2].map(|i| rest.iter().map(|row| row[i]).collect::<Vec<_>>());
        let rows = ScanRows {
            codes: &codes,
            scales: &scales,
            errors: &errors,
            squares: &squares,
            longest: 1.5,
        };
        let query = ScanQuery {
            codes: query,
            scale,
            square: 1.0,
            length: 1.0,
            error: 0.01,
            slack: 1e-4,
        };
        for simd in Simd::all() {
            let mut expected = Bounds::NONE;
            let mut found = Bounds::NONE;
            let reference = scalar::next_near(&query, &rows, 0, threshold, &mut expected);
            prop_assert_eq!(
                next_near(simd, &query, &rows, 0, threshold, &mut found),
                reference
            );
            if let Some(start) = reference {
                prop_assert_eq!(found, expected);
                for row in start..start + GROUP {
                    let mut dot = [0];
                    scalar::dot_products(&query.codes, &codes[row..=row], &mut dot);
                    let (lower, upper) = bounds(&query, &rows, row, dot[0]);
                    prop_assert_eq!(
                        (found.lower[row - start], found.upper[row - start]),
                        (lower, upper)
                    );
                }
            }
        }
    }
}

#[test]
fn extreme_codes_do_not_saturate() {
    let high = Codes::new([127; LENGTH]);
    let low = Codes::new([i8::MIN; LENGTH]);
    for simd in Simd::all() {
        let mut dots = [0; 2];
        dot_products(simd, &high, &[high, low], &mut dots);
        assert_eq!(dots, [127 * 127 * 256, -127 * 127 * 256]);
    }
}

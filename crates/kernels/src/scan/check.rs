//! The self-check: products and bounds of a level against those of the scalar reference.

use super::scalar;
use super::{Bounds, Codes, GROUP, LENGTH, ScanQuery, ScanRows, dot_products, next_near};
use crate::Simd;

/// Compares a level with the scalar reference; extreme codes are among the inputs.
pub(crate) fn check(simd: Simd) -> Result<(), String> {
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
            let mut expected = vec![0; count];
            let mut found = vec![0; count];
            scalar::dot_products(query, &rows[..count], &mut expected);
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
    let scales = column(1e-3);
    let errors = column(1e-2);
    let squares = column(0.5);
    let rows = ScanRows {
        codes: &codes,
        scales: &scales,
        errors: &errors,
        squares: &squares,
        longest: 3.0,
    };
    for &codes in &codes[..GROUP] {
        let query = ScanQuery {
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
                let mut expected = Bounds::NONE;
                let mut found = Bounds::NONE;
                let reference = scalar::next_near(&query, &rows, start, threshold, &mut expected);
                let ours = next_near(simd, &query, &rows, start, threshold, &mut found);
                if ours != reference || reference.is_some() && expected != found {
                    return Err(format!(
                        "the group near from row {start} on: {ours:?} {found:?} \
                         is not {reference:?} {expected:?}"
                    ));
                }
                from = reference.map(|group| group + GROUP);
            }
        }
    }
    Ok(())
}

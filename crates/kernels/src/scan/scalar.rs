//! Portable code, and the reference for the other instruction sets.

use super::{Bounds, Codes, GROUP, ScanQuery, ScanRows, find_near};

/// See [`super::dot_products`].
pub(super) fn dot_products(query: &Codes, rows: &[Codes], dots: &mut [i32]) {
    for (row, dot) in rows.iter().zip(dots) {
        *dot = dot_product(query, row);
    }
}

/// See [`super::next_near`].
pub(super) fn next_near(
    query: &ScanQuery,
    rows: &ScanRows<'_>,
    from: usize,
    threshold: f32,
    found: &mut Bounds,
) -> Option<usize> {
    find_near(
        query,
        rows,
        from,
        threshold,
        found,
        |group: &[Codes; GROUP]| {
            let mut dots = [0; GROUP];
            dot_products(&query.codes, group, &mut dots);
            dots
        },
    )
}

fn dot_product(query: &Codes, row: &Codes) -> i32 {
    let products = query
        .0
        .iter()
        .zip(&row.0)
        .map(|(&a, &b)| i32::from(a) * i32::from(b));
    products.sum()
}

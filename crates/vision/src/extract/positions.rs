//! Learned positions at another grid than they were learned on.
//!
//! Separable bicubic interpolation with a = -0.75, half-pixel centres and replicated borders, to
//! the exact grid, rows first: what current libraries do for DINOv2. Weights are built in f64 once
//! per size.

/// Interpolates the position table `[1 + from_rows * from_columns, dim]` (CLS first) to `[1 + rows
/// * columns, dim]`.
pub fn interpolate(
    table: &[f32],
    dim: usize,
    from: (usize, usize),
    to: (usize, usize),
) -> Vec<f32> {
    if from == to {
        return table.to_vec();
    }
    let (cls, patches) = table.split_at(dim);
    let ((from_rows, from_columns), (rows, columns)) = (from, to);
    let row_taps: Vec<_> = (0..rows).map(|row| taps(row, from_rows, rows)).collect();
    let column_taps: Vec<_> = (0..columns)
        .map(|column| taps(column, from_columns, columns))
        .collect();

    let row_length = from_columns * dim;
    let mut stretched = vec![0f64; row_length];
    let mut out = Vec::with_capacity((1 + rows * columns) * dim);
    out.extend_from_slice(cls);
    for row_tap in &row_taps {
        stretched.fill(0.0);
        for &(source, weight) in row_tap {
            let source = &patches[source * row_length..][..row_length];
            stretched
                .iter_mut()
                .zip(source)
                .for_each(|(sum, &value)| *sum += weight * value as f64);
        }
        for column_tap in &column_taps {
            out.extend((0..dim).map(|channel| {
                column_tap
                    .iter()
                    .map(|&(source, weight)| weight * stretched[source * dim + channel])
                    .sum::<f64>() as f32
            }));
        }
    }
    out
}

/// The four sources and weights of output `index` of `to`, along an axis of `from` entries.
fn taps(index: usize, from: usize, to: usize) -> [(usize, f64); 4] {
    let position = (index as f64 + 0.5) * from as f64 / to as f64 - 0.5;
    let base = position.floor();
    [-1.0, 0.0, 1.0, 2.0].map(|offset| {
        let source = (base + offset).clamp(0.0, from as f64 - 1.0) as usize;
        (source, cubic((position - base - offset).abs()))
    })
}

/// Keys' cubic kernel with a = -0.75 at distance `d` in 0..=2.
fn cubic(d: f64) -> f64 {
    const A: f64 = -0.75;
    if d <= 1.0 {
        ((A + 2.0) * d - (A + 3.0)) * d * d + 1.0
    } else {
        ((A * d - 5.0 * A) * d + 8.0 * A) * d - 4.0 * A
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn weights_sum_to_one(from in 1usize..60, to in 1usize..60, at in 0.0f64..1.0) {
            let index = ((to as f64 * at) as usize).min(to - 1);
            let sum: f64 = taps(index, from, to).iter().map(|tap| tap.1).sum();
            prop_assert!((sum - 1.0).abs() < 1e-12);
        }

        #[test]
        fn a_constant_table_stays_constant(rows in 1usize..20, columns in 1usize..20) {
            let out = interpolate(&[vec![9.0], vec![2.5; 12]].concat(), 1, (4, 3), (rows, columns));
            prop_assert_eq!(out.len(), 1 + rows * columns);
            prop_assert_eq!(out[0], 9.0);
            prop_assert!(out[1..].iter().all(|v| (v - 2.5).abs() < 1e-6));
        }
    }

    #[test]
    fn rows_and_columns_are_not_swapped() {
        let table: Vec<f32> = std::iter::once(0.0)
            .chain((0..9).map(|i| (i / 3) as f32))
            .collect();
        let out = interpolate(&table, 1, (3, 3), (6, 2));
        for row in out[1..].chunks(2) {
            assert!(
                (row[0] - row[1]).abs() < 1e-6,
                "a table that varies by row only must stay so"
            );
        }
        assert!(out[1] < out[11]);
    }

    #[test]
    fn the_same_grid_is_untouched() {
        let table: Vec<f32> = (0..10).map(|i| i as f32).collect();
        assert_eq!(interpolate(&table, 1, (3, 3), (3, 3)), table);
    }
}

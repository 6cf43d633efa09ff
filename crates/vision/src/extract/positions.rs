//! Learned positions at another grid than the one they were learned on.
//!
//! A transformer has one learned vector for each patch of its training grid, CLS first. For another
//! image size the table is interpolated, exactly as current libraries do it for DINOv2: separable
//! bicubic with a = -0.75, half-pixel centres, replicated borders, to the exact grid, rows first.
//! The weights are computed in f64. This happens once, when the model is loaded.

/// Number of sources of an interpolated value along one axis.
const TAPS: usize = 4;

/// One source along an axis: its index and its weight.
type Tap = (usize, f64);

/// Interpolates the position table `[1 + from_rows * from_columns, dim]`, CLS first, to `[1 + rows
/// * columns, dim]`. `from` and `to` are rows and columns; the CLS position stays as it is.
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
    let (from_rows, from_columns) = from;
    let (rows, columns) = to;
    let column_taps: Vec<[Tap; TAPS]> = (0..columns)
        .map(|column| taps(column, from_columns, columns))
        .collect();

    let row_length = from_columns * dim;
    let mut blended_row = vec![0f64; row_length];
    let mut out = Vec::with_capacity((1 + rows * columns) * dim);
    out.extend_from_slice(cls);
    for row in 0..rows {
        blend_rows(patches, taps(row, from_rows, rows), &mut blended_row);
        for column_taps in &column_taps {
            for channel in 0..dim {
                let terms = column_taps.iter();
                let value: f64 = terms
                    .map(|&(column, weight)| weight * blended_row[column * dim + channel])
                    .sum();
                out.push(value as f32);
            }
        }
    }
    out
}

/// The weighted sum of four rows of `patches`, into `out`.
fn blend_rows(patches: &[f32], taps: [Tap; TAPS], out: &mut [f64]) {
    let row_length = out.len();
    out.fill(0.0);
    for (row, weight) in taps {
        let source = &patches[row * row_length..][..row_length];
        for (sum, &value) in out.iter_mut().zip(source) {
            *sum += weight * f64::from(value);
        }
    }
}

/// The sources of entry `index` of `to` entries, along an axis of `from` entries.
fn taps(index: usize, from: usize, to: usize) -> [Tap; TAPS] {
    let position = (index as f64 + 0.5) * from as f64 / to as f64 - 0.5;
    let base = position.floor();
    [-1.0, 0.0, 1.0, 2.0].map(|offset| {
        let distance = (position - base - offset).abs();
        let source = (base + offset).clamp(0.0, from as f64 - 1.0);
        (source as usize, cubic(distance))
    })
}

/// Keys' cubic kernel with a = -0.75, for a distance `d` in 0..=2.
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

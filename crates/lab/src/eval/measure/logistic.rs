//! Logistic regression on any number of features, by Newton's method (iteratively reweighted least
//! squares).
//!
//! The features should be standardised, so that the ridge penalty weighs them alike. The fit goes
//! through the rows in their order and uses no random numbers, so the same rows always give the
//! same weights.

use nalgebra::{DMatrix, DVector};

/// Rows of features with their labels.
#[derive(Debug, Clone, Default)]
pub struct LabelledRows {
    /// Features of a row.
    pub width: usize,
    /// `[n, width]`.
    pub features: Vec<f64>,
    /// `[n]`: whether the row is a right one.
    pub right: Vec<bool>,
}

impl LabelledRows {
    /// Rows with their labels.
    pub fn iter(&self) -> impl Iterator<Item = (&[f64], bool)> {
        let rows = self.features.chunks_exact(self.width.max(1));
        rows.zip(self.right.iter().copied())
    }

    /// Mean and standard deviation of every feature; a feature that never varies has deviation 1,
    /// so that it can be standardised, to 0.
    pub fn moments(&self) -> Vec<(f64, f64)> {
        let count = self.right.len().max(1) as f64;
        let mut sums = vec![[0.0; 2]; self.width];
        for (row, _) in self.iter() {
            for (sum, value) in sums.iter_mut().zip(row) {
                sum[0] += value;
                sum[1] += value * value;
            }
        }
        let moments = sums.into_iter().map(|[sum, squares]| {
            let mean = sum / count;
            let deviation = (squares / count - mean * mean).max(0.0).sqrt();
            let is_constant = deviation < 1e-5 * (1.0 + mean.abs());
            (mean, if is_constant { 1.0 } else { deviation })
        });
        moments.collect()
    }
}

/// Most steps. Newton's method on a convex loss needs about ten.
const MOST_STEPS: usize = 50;

/// The bias and the weights that minimise the negative log-likelihood plus half of `ridge` times
/// the squared weights (not the bias).
pub fn logistic_regression(rows: &LabelledRows, ridge: f64) -> (f64, Vec<f64>) {
    let size = rows.width + 1;
    let mut weights = DVector::<f64>::zeros(size);
    let mut loss = loss_of(rows, &weights, ridge);
    for _ in 0..MOST_STEPS {
        let (gradient, hessian) = derivatives(rows, &weights, ridge);
        let Some(step) = hessian.cholesky().map(|factor| factor.solve(&gradient)) else {
            break;
        };
        // A full step can overshoot where the curve is flat; halve it until the loss falls.
        let mut share = 1.0;
        let mut next = &weights - &step;
        let mut next_loss = loss_of(rows, &next, ridge);
        while next_loss > loss && share > 1e-6 {
            share /= 2.0;
            next = &weights - &step * share;
            next_loss = loss_of(rows, &next, ridge);
        }
        let has_converged = step.norm() * share < 1e-9 || next_loss >= loss;
        if next_loss <= loss {
            weights = next;
            loss = next_loss;
        }
        if has_converged {
            break;
        }
    }
    let bias = weights[0];
    (bias, weights.iter().skip(1).copied().collect())
}

fn logit(row: &[f64], weights: &DVector<f64>) -> f64 {
    let terms = row.iter().zip(weights.iter().skip(1));
    weights[0] + terms.map(|(value, weight)| value * weight).sum::<f64>()
}

/// The penalty of every weight; a tiny one of the bias keeps one-sided labels finite.
fn penalties(size: usize, ridge: f64) -> impl Iterator<Item = f64> {
    std::iter::once(1e-9).chain(std::iter::repeat_n(ridge, size - 1))
}

fn loss_of(rows: &LabelledRows, weights: &DVector<f64>, ridge: f64) -> f64 {
    let of_row = |(row, right): (&[f64], bool)| {
        let margin = logit(row, weights) * if right { 1.0 } else { -1.0 };
        // ln(1 + e^-m) without overflow.
        (-margin).max(0.0) + (-margin.abs()).exp().ln_1p()
    };
    let data: f64 = rows.iter().map(of_row).sum();
    let penalties = penalties(weights.len(), ridge).zip(weights.iter());
    let penalty: f64 = penalties
        .map(|(ridge, weight)| ridge * weight * weight)
        .sum();
    data + 0.5 * penalty
}

fn derivatives(
    rows: &LabelledRows,
    weights: &DVector<f64>,
    ridge: f64,
) -> (DVector<f64>, DMatrix<f64>) {
    let size = weights.len();
    let mut gradient = DVector::zeros(size);
    let mut hessian = DMatrix::zeros(size, size);
    let mut with_constant = vec![1.0; size];
    for (row, right) in rows.iter() {
        with_constant[1..].copy_from_slice(row);
        let p = 1.0 / (1.0 + (-logit(row, weights)).exp());
        let error = p - f64::from(u8::from(right));
        let curvature = p * (1.0 - p);
        for i in 0..size {
            gradient[i] += error * with_constant[i];
            let scaled = curvature * with_constant[i];
            // The matrix is symmetric; a column of it lies in one piece.
            let column = &mut hessian.as_mut_slice()[i * size..][..=i];
            for (entry, value) in column.iter_mut().zip(&with_constant) {
                *entry += scaled * value;
            }
        }
    }
    hessian.fill_lower_triangle_with_upper_triangle();
    for (i, penalty) in penalties(size, ridge).enumerate() {
        gradient[i] += penalty * weights[i];
        hessian[(i, i)] += penalty;
    }
    (gradient, hessian)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Rows whose labels are drawn from a bias and weights.
    fn drawn(bias: f64, weights: &[f64], count: usize) -> LabelledRows {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let mut rows = LabelledRows {
            width: weights.len(),
            ..Default::default()
        };
        for _ in 0..count {
            let row: Vec<f64> = weights
                .iter()
                .map(|_| random.random_range(-1.5..1.5))
                .collect();
            let terms = row.iter().zip(weights);
            let logit = bias + terms.map(|(value, weight)| value * weight).sum::<f64>();
            let right = random.random::<f64>() < 1.0 / (1.0 + (-logit).exp());
            rows.features.extend(row);
            rows.right.push(right);
        }
        rows
    }

    #[test]
    fn planted_weights_are_recovered_and_always_the_same() {
        let truth = [1.5, -0.75, 0.0, 2.5];
        let rows = drawn(-1.0, &truth, 20_000);
        let (bias, weights) = logistic_regression(&rows, 1e-2);
        assert!((bias + 1.0).abs() < 0.1, "{bias}");
        for (fitted, planted) in weights.iter().zip(truth) {
            assert!((fitted - planted).abs() < 0.12, "{weights:?}");
        }
        assert_eq!(logistic_regression(&rows, 1e-2), (bias, weights));
    }

    #[test]
    fn the_gradient_vanishes_at_the_solution() {
        let rows = drawn(0.3, &[0.5, -2.0], 500);
        let (bias, weights) = logistic_regression(&rows, 0.7);
        let mut all = vec![bias];
        all.extend(weights);
        let (gradient, _) = derivatives(&rows, &DVector::from_vec(all), 0.7);
        assert!(gradient.norm() < 1e-6, "{gradient}");
    }

    #[test]
    fn separable_rows_stay_finite_and_a_penalty_shrinks() {
        let rows = LabelledRows {
            width: 1,
            features: vec![-1.0, -0.5, 0.5, 1.0],
            right: vec![false, false, true, true],
        };
        let (_, loose) = logistic_regression(&rows, 1e-2);
        let (_, tight) = logistic_regression(&rows, 1.0);
        assert!(loose[0].is_finite() && loose[0] > tight[0] && tight[0] > 0.0);
    }

    #[test]
    fn a_feature_that_never_varies_has_deviation_one() {
        let rows = LabelledRows {
            width: 2,
            features: vec![3.0, 1.0, 3.0, 5.0],
            right: vec![true, false],
        };
        assert_eq!(rows.moments(), [(3.0, 1.0), (3.0, 2.0)]);
    }
}

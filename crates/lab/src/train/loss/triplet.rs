//! Triplet margin loss on squared distances (paper III-F).

use candle_core::{Result, Tensor};

/// Mean over a batch of max(|q - p|^2 - |q - n|^2 + margin, 0); all three are `[batch, dim]`.
pub(crate) fn triplet_margin_loss(
    query: &Tensor,
    positive: &Tensor,
    negative: &Tensor,
    margin: f64,
) -> Result<Tensor> {
    let to_positive = (query - positive)?.sqr()?.sum(1)?;
    let to_negative = (query - negative)?.sqr()?.sum(1)?;
    ((to_positive - to_negative)? + margin)?.relu()?.mean_all()
}

/// Divides each row of `[n, dim]` by its Euclidean length, differentiably.
pub(crate) fn normalise_rows(rows: &Tensor) -> Result<Tensor> {
    // The floor keeps the gradient finite for a row of zeros.
    let length = (rows.sqr()?.sum_keepdim(1)? + 1e-24)?.sqrt()?;
    rows.broadcast_div(&length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn rows(values: &[[f32; 3]]) -> Tensor {
        Tensor::from_slice(values.as_flattened(), (values.len(), 3), &Device::Cpu).unwrap()
    }

    #[test]
    fn loss_is_zero_once_the_negative_is_a_margin_farther() {
        let query = rows(&[[1.0, 0.0, 0.0]]);
        let loss = |negative: [f32; 3]| {
            let loss =
                triplet_margin_loss(&query, &rows(&[[1.0, 0.1, 0.0]]), &rows(&[negative]), 0.01)
                    .unwrap();
            loss.to_scalar::<f32>().unwrap()
        };
        assert_eq!(loss([0.0, 1.0, 0.0]), 0.0);
        // |q-p|^2 = 0.01, |q-n|^2 = 0.01: exactly the margin is left.
        assert!((loss([1.0, 0.0, 0.1]) - 0.01).abs() < 1e-7);
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let start = [[0.5f32, -0.3, 0.2], [0.1, 0.9, -0.4]];
        let positive = rows(&[[0.2, 0.3, -0.5], [0.4, -0.6, 0.1]]);
        let negative = rows(&[[0.6, -0.1, 0.3], [0.2, 0.8, -0.2]]);
        let value = |query: &Tensor| {
            triplet_margin_loss(
                &normalise_rows(query)?,
                &normalise_rows(&positive)?,
                &normalise_rows(&negative)?,
                0.01,
            )
        };
        let query = Var::from_tensor(&rows(&start)).unwrap();
        let gradients = value(query.as_tensor()).unwrap().backward().unwrap();
        let analytic = gradients
            .get(query.as_tensor())
            .unwrap()
            .to_vec2::<f32>()
            .unwrap();
        let step = 1e-3f32;
        for row in 0..2 {
            for column in 0..3 {
                let shifted = |by: f32| {
                    let mut moved = start;
                    moved[row][column] += by;
                    f64::from(value(&rows(&moved)).unwrap().to_scalar::<f32>().unwrap())
                };
                let numeric = (shifted(step) - shifted(-step)) / f64::from(2.0 * step);
                let difference = (numeric - f64::from(analytic[row][column])).abs();
                assert!(
                    difference < 2e-3,
                    "[{row}, {column}]: {numeric} against {}",
                    analytic[row][column]
                );
            }
        }
    }
}

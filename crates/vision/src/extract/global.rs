//! Arithmetic of global descriptors: the mean over patch tokens, lengths and distances (paper
//! III-A).

/// Mean of the tokens `[n, dim]`, `[dim]`. Summed in f64, so that the order of the tokens does not
/// matter to the f32 result.
pub fn mean_token(tokens: &[f32], dim: usize) -> Vec<f32> {
    let mut sums = vec![0f64; dim];
    for token in tokens.chunks_exact(dim) {
        for (sum, &value) in sums.iter_mut().zip(token) {
            *sum += f64::from(value);
        }
    }
    let count = (tokens.len() / dim).max(1) as f64;
    sums.iter().map(|sum| (sum / count) as f32).collect()
}

/// Squared Euclidean distance of two vectors of one length.
pub fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Scales to unit length; a zero vector stays zero.
pub fn l2_normalise(vector: &mut [f32]) {
    let squares: f64 = vector.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
    let norm = squares.sqrt();
    if norm > 0.0 {
        for value in vector {
            *value = (f64::from(*value) / norm) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_mean_does_not_depend_on_the_order_of_tokens(
            tokens in proptest::collection::vec(-10f32..10.0, 12),
        ) {
            let reversed: Vec<f32> = tokens.chunks(3).rev().flatten().copied().collect();
            for (a, b) in mean_token(&tokens, 3).iter().zip(mean_token(&reversed, 3)) {
                prop_assert!((a - b).abs() < 1e-6);
            }
        }

        #[test]
        fn normalised_vectors_have_unit_length(
            mut v in proptest::collection::vec(-1e3f32..1e3, 1..64),
        ) {
            prop_assume!(v.iter().any(|x| x.abs() > 1e-3));
            l2_normalise(&mut v);
            prop_assert!((v.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn hand_computed() {
        assert_eq!(mean_token(&[1.0, 2.0, 3.0, 6.0], 2), [2.0, 4.0]);
        let mut zero = [0.0, 0.0];
        l2_normalise(&mut zero);
        assert_eq!(zero, [0.0, 0.0]);
    }
}

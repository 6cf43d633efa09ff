use super::*;
use crate::extract::netvlad::NetVladShape;
use proptest::prelude::*;

const DIM: usize = 12;

fn tokens(count: std::ops::Range<usize>) -> impl Strategy<Value = Vec<f32>> {
    count.prop_flat_map(|count| {
        prop::collection::vec(prop_oneof![-4f32..-0.1, 0.1f32..4.0], count * DIM)
    })
}

fn parameters() -> impl Strategy<Value = NetVladParameters> {
    (1usize..9, 1usize..40).prop_flat_map(|(width, words)| {
        let values = |count| prop::collection::vec(-1f32..1.0, count);
        (
            prop::collection::vec(-0.1f32..0.1, DIM),
            values(width * DIM),
            values(words * width),
            prop::collection::vec(-8f32..8.0, words * width),
        )
            .prop_map(|(mean, projection, words, assignment)| NetVladParameters {
                mean,
                projection,
                words,
                assignment,
            })
    })
}

/// The definition, in f64 and one number at a time.
fn by_definition(parts: &NetVladParameters, tokens: &[f32]) -> Vec<f64> {
    let width = parts.projection.len() / DIM;
    let unit = |values: Vec<f64>| {
        let norm = values.iter().map(|v| v * v).sum::<f64>().sqrt();
        let divisor = if norm > 0.0 { norm } else { 1.0 };
        values.into_iter().map(move |v| v / divisor)
    };
    let product =
        |a: &[f32], b: &[f64]| -> f64 { a.iter().zip(b).map(|(&a, &b)| f64::from(a) * b).sum() };
    let mut sums = vec![vec![0f64; width]; parts.words.len() / width];
    for token in tokens.chunks_exact(DIM) {
        let token = unit(token.iter().map(|&v| f64::from(v)).collect());
        let centred: Vec<f64> = token
            .zip(&parts.mean)
            .map(|(value, &mean)| value - f64::from(mean))
            .collect();
        let rows = parts.projection.chunks_exact(DIM);
        let projected: Vec<f64> = unit(rows.map(|row| product(row, &centred)).collect()).collect();
        let rows = parts.assignment.chunks_exact(width);
        let scores: Vec<f64> = rows.map(|row| product(row, &projected)).collect();
        let largest = scores.iter().copied().fold(f64::MIN, f64::max);
        let total: f64 = scores.iter().map(|score| (score - largest).exp()).sum();
        for ((sum, word), score) in sums
            .iter_mut()
            .zip(parts.words.chunks_exact(width))
            .zip(scores)
        {
            let weight = (score - largest).exp() / total;
            for (i, sum) in sum.iter_mut().enumerate() {
                *sum += weight * (projected[i] - f64::from(word[i]));
            }
        }
    }
    sums.into_iter().flat_map(unit).collect()
}

proptest! {
    #[test]
    fn it_computes_what_the_definition_says(
        parts in parameters(),
        tokens in tokens(1..50),
    ) {
        let expected = by_definition(&parts, &tokens);
        let netvlad = NetVlad::new(parts).unwrap();
        let residuals = netvlad.residuals(&tokens);
        prop_assert_eq!(residuals.len(), expected.len());
        for (i, (&found, expected)) in residuals.iter().zip(expected).enumerate() {
            // Sums that nearly vanish are scaled up, and their rounding with them.
            prop_assert!((f64::from(found) - expected).abs() < 2e-3, "{i}: {found} {expected}");
        }
    }
}

#[test]
fn a_sharp_assignment_gives_the_residual_to_one_word_alone() {
    let netvlad = NetVlad::new(NetVladParameters {
        mean: vec![0.0; 2],
        projection: vec![1.0, 0.0, 0.0, 1.0],
        words: vec![1.0, 0.0, 0.0, 1.0],
        assignment: vec![1e3, 0.0, 0.0, 1e3],
    })
    .unwrap();
    let residuals = netvlad.residuals(&[10.0, 1.0]);
    assert!(residuals[1] > 0.9, "{residuals:?}");
    assert_eq!(residuals[2..], [0.0, 0.0]);
}

#[test]
fn words_are_fitted_to_the_clusters_of_the_tokens() {
    let axis = |i: usize| {
        let mut token = [0.05f32; DIM];
        token[i % 3] = 3.0 + (i / 3 % 5) as f32 * 0.1;
        token
    };
    let tokens: Vec<f32> = (0..300).flat_map(axis).collect();
    let shape = NetVladShape {
        words: 3,
        width: 2,
        sharpness: 20.0,
    };
    let fitted = NetVlad::fit(&tokens, DIM, shape, 7).unwrap();
    assert_eq!((fitted.count(), fitted.width(), fitted.dim()), (3, 2, DIM));
    assert_eq!(fitted, NetVlad::fit(&tokens, DIM, shape, 7).unwrap());
    // Three clusters lie on three rays of the plane that their two components span, so the words
    // are 120 degrees apart.
    let words: Vec<&[f32]> = fitted.parameters().words.chunks_exact(2).collect();
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        assert!((dot(words[a], words[b]) + 0.5).abs() < 0.05, "{words:?}");
    }
    assert!(NetVlad::fit(&tokens[..2 * DIM], DIM, shape, 7).is_err());
}

#[test]
fn parts_that_do_not_fit_are_refused() {
    let good = NetVladParameters {
        mean: vec![0.0; 2],
        projection: vec![1.0; 6],
        words: vec![0.5; 6],
        assignment: vec![0.5; 6],
    };
    assert!(NetVlad::new(good.clone()).is_ok());
    let changes: [fn(&mut NetVladParameters); 9] = [
        |parts| parts.mean.clear(),
        |parts| parts.projection.truncate(5),
        |parts| parts.words.truncate(5),
        |parts| parts.words.clear(),
        |parts| parts.assignment.truncate(3),
        |parts| parts.projection[2] = f32::NAN,
        |parts| parts.assignment[0] = 3e38,
        |parts| parts.projection[2..4].fill(0.0),
        |parts| parts.words[1] = 50.0,
    ];
    for (index, change) in changes.into_iter().enumerate() {
        let mut parts = good.clone();
        change(&mut parts);
        assert!(NetVlad::new(parts).is_err(), "change {index}");
    }
}

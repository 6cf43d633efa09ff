//! Losses in which every image of a batch is compared with every other one.

use crate::train::error::TrainError;
use crate::train::spots::{Relation, Spots};
use crate::train::triplets::Side;
use candle_core::{D, Device, Result, Tensor};

/// Slope for positives of multi-similarity (as published).
const ALPHA: f64 = 2.0;
/// Slope for negatives.
const BETA: f64 = 50.0;
/// Similarity from which a pair counts as similar.
const BASE: f64 = 0.5;
/// A positive is hard if a negative is at most this much less similar, and a negative is hard if a
/// positive is at most this much more similar.
const HARDNESS: f32 = 0.1;
/// A similarity that no pair has, in the place of those that do not count.
const NONE: f64 = -1e4;

/// What the images of a batch are to each other. Pairs that are in neither matrix do not count.
pub(crate) struct Pairs {
    count: usize,
    /// `[n, n]` row-major: one where the pair shows one place. An image is not its own positive.
    positive: Vec<bool>,
    /// `[n, n]` row-major: one where it shows two.
    negative: Vec<bool>,
}

impl Pairs {
    /// Relates all `images` of a batch.
    ///
    /// # Errors
    /// No two of them show one place, so that there is nothing to learn.
    pub(crate) fn of(
        spots: &Spots,
        images: &[(Side, u32)],
    ) -> std::result::Result<Self, TrainError> {
        let count = images.len();
        let mut positive = vec![false; count * count];
        let mut negative = vec![false; count * count];
        for (row, &a) in images.iter().enumerate() {
            for (column, &b) in images.iter().enumerate() {
                let at = row * count + column;
                match spots.relation(a, b) {
                    Relation::Positive => positive[at] = row != column,
                    Relation::Ignored => {}
                    Relation::Negative => negative[at] = true,
                }
            }
        }
        if !positive.contains(&true) {
            return Err(TrainError::NoTriplets(format!(
                "no two of the {count} images of a batch show one place"
            )));
        }
        Ok(Self {
            count,
            positive,
            negative,
        })
    }

    fn matrix(&self, values: Vec<f32>) -> Result<Tensor> {
        Tensor::from_vec(values, (self.count, self.count), &Device::Cpu)
    }

    /// Ones where `mask` is set.
    fn ones(&self, mask: &[bool]) -> Result<Tensor> {
        self.matrix(mask.iter().map(|&is| f32::from(u8::from(is))).collect())
    }

    /// Zero where `mask` is set, and [`NONE`] elsewhere.
    fn none_outside(&self, mask: &[bool]) -> Result<Tensor> {
        let value = |&is: &bool| if is { 0.0 } else { NONE as f32 };
        self.matrix(mask.iter().map(value).collect())
    }
}

/// Mean over the images that have a positive, of the mean over its positives, of
/// `-log(exp(s) / (exp(s) + sum of exp of all negatives' s))`, where s are the similarities of
/// `descriptors` `[n, dim]` (rows of unit length) by `temperature`.
pub(crate) fn info_nce(descriptors: &Tensor, pairs: &Pairs, temperature: f64) -> Result<Tensor> {
    let scores = (similarities(descriptors)? / temperature)?;
    let negatives = (&scores * pairs.ones(&pairs.negative)?)?;
    let negatives = (negatives + pairs.none_outside(&pairs.negative)?)?;
    let against = negatives.log_sum_exp(D::Minus1)?.unsqueeze(1)?;
    let losses = softplus(&against.broadcast_sub(&scores)?)?;
    let weights = pairs.matrix(mean_over_positives(pairs))?;
    (losses * weights)?.sum_all()
}

/// Multi-similarity of `descriptors` `[n, dim]` (rows of unit length): of each image the pairs that
/// are hard for it now, mean over the images that have hard positives and hard negatives.
pub(crate) fn multi_similarity(descriptors: &Tensor, pairs: &Pairs) -> Result<Tensor> {
    let similar = similarities(descriptors)?;
    let (positive, negative, rows) = hard_pairs(&similar.to_vec2::<f32>()?, pairs);
    let terms = |slope: f64, mask: &[bool]| -> Result<Tensor> {
        let exponents = ((&similar - BASE)? * slope)?;
        // The mask comes before the exponential too, because a pair that does not count must not
        // overflow.
        let ones = pairs.ones(mask)?;
        let sums = ((exponents * &ones)?.exp()? * ones)?.sum(1)?;
        (sums + 1.0)?.log()? / slope.abs()
    };
    let losses = (terms(-ALPHA, &positive)? + terms(BETA, &negative)?)?;
    let share = 1.0 / rows.iter().filter(|&&is| is).count().max(1) as f32;
    let weights: Vec<f32> = rows
        .iter()
        .map(|&is| if is { share } else { 0.0 })
        .collect();
    let weights = Tensor::from_vec(weights, rows.len(), &Device::Cpu)?;
    (losses * weights)?.sum_all()
}

/// `[n, n]`.
fn similarities(descriptors: &Tensor) -> Result<Tensor> {
    descriptors.matmul(&descriptors.t()?)
}

/// log(1 + exp(x)) without overflow.
fn softplus(x: &Tensor) -> Result<Tensor> {
    x.relu()? + (x.abs()?.neg()?.exp()? + 1.0)?.log()?
}

/// The weight of each positive in a mean of means.
fn mean_over_positives(pairs: &Pairs) -> Vec<f32> {
    let counts: Vec<usize> = pairs
        .positive
        .chunks_exact(pairs.count)
        .map(|row| row.iter().filter(|&&is| is).count())
        .collect();
    let rows = counts.iter().filter(|&&count| count > 0).count().max(1);
    let weight = |(at, &is): (usize, &bool)| {
        if is {
            1.0 / (counts[at / pairs.count] * rows) as f32
        } else {
            0.0
        }
    };
    pairs.positive.iter().enumerate().map(weight).collect()
}

/// Which positives and negatives are hard, and which rows have both.
fn hard_pairs(similar: &[Vec<f32>], pairs: &Pairs) -> (Vec<bool>, Vec<bool>, Vec<bool>) {
    let count = pairs.count;
    let mut positive = vec![false; count * count];
    let mut negative = vec![false; count * count];
    let mut rows = vec![false; count];
    for (row, similar) in similar.iter().enumerate() {
        let range = row * count..(row + 1) * count;
        let is_positive = &pairs.positive[range.clone()];
        let is_negative = &pairs.negative[range.clone()];
        let of = |mask: &[bool]| -> Vec<f32> {
            let chosen = similar.iter().zip(mask).filter(|(_, is)| **is);
            chosen.map(|(&value, _)| value).collect()
        };
        let least_positive = of(is_positive).into_iter().fold(f32::INFINITY, f32::min);
        let most_negative = of(is_negative)
            .into_iter()
            .fold(f32::NEG_INFINITY, f32::max);
        for (column, &value) in similar.iter().enumerate() {
            let at = row * count + column;
            positive[at] = is_positive[column] && value - HARDNESS < most_negative;
            negative[at] = is_negative[column] && value + HARDNESS > least_positive;
        }
        rows[row] = positive[range.clone()].contains(&true) && negative[range].contains(&true);
    }
    (positive, negative, rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::loss::normalise_rows;
    use crate::train::spots::in_groups;
    use candle_core::Var;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const DIM: usize = 5;

    /// Two images of each of three places.
    fn pairs() -> Pairs {
        let images: Vec<(Side, u32)> = (0..6).map(|image| (Side::Query, image)).collect();
        Pairs::of(&in_groups(6, 2), &images).unwrap()
    }

    fn start() -> Vec<f32> {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        (0..6 * DIM)
            .map(|_| rng.random_range(-1.0f32..1.0))
            .collect()
    }

    fn rows(values: Vec<f32>) -> Tensor {
        Tensor::from_vec(values, (6, DIM), &Device::Cpu).unwrap()
    }

    /// Both losses of rows that are normalised first.
    fn losses(values: &Tensor) -> [Tensor; 2] {
        let unit = normalise_rows(values).unwrap();
        [
            info_nce(&unit, &pairs(), 0.2).unwrap(),
            multi_similarity(&unit, &pairs()).unwrap(),
        ]
    }

    fn scalar(tensor: &Tensor) -> f64 {
        f64::from(tensor.to_scalar::<f32>().unwrap())
    }

    #[test]
    fn info_nce_is_the_published_formula() {
        let unit = normalise_rows(&rows(start())).unwrap();
        let unit: Vec<Vec<f32>> = unit.to_vec2().unwrap();
        let score = |a: usize, b: usize| -> f64 {
            let dot: f32 = unit[a].iter().zip(&unit[b]).map(|(x, y)| x * y).sum();
            f64::from(dot) / 0.2
        };
        let expected: f64 = (0..6)
            .map(|row| {
                let positive = score(row, row ^ 1);
                let negatives: f64 = (0..6)
                    .filter(|column| column / 2 != row / 2)
                    .map(|column| score(row, column).exp())
                    .sum();
                -(positive.exp() / (positive.exp() + negatives)).ln()
            })
            .sum::<f64>()
            / 6.0;
        let loss = scalar(&losses(&rows(start()))[0]);
        assert!((loss - expected).abs() < 1e-4, "{loss} {expected}");
    }

    #[test]
    fn places_that_are_apart_cost_less_than_places_that_are_mixed_up() {
        let at = |place: usize| -> Vec<f32> {
            (0..DIM).map(|i| f32::from(u8::from(i == place))).collect()
        };
        let apart: Vec<f32> = (0..6).flat_map(|image| at(image / 2)).collect();
        let mixed: Vec<f32> = (0..6).flat_map(|image| at(image % 3)).collect();
        let apart = losses(&rows(apart)).map(|loss| scalar(&loss));
        let mixed = losses(&rows(mixed)).map(|loss| scalar(&loss));
        assert!(apart[0] < 0.05 && mixed[0] > 4.0, "{apart:?} {mixed:?}");
        // Nothing is hard where places are apart.
        assert!(apart[1] == 0.0 && mixed[1] > 0.4, "{apart:?} {mixed:?}");
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        for which in 0..2 {
            let variable = Var::from_tensor(&rows(start())).unwrap();
            let gradients = losses(variable.as_tensor())[which].backward().unwrap();
            let analytic = gradients.get(variable.as_tensor()).unwrap();
            let analytic: Vec<f32> = analytic.flatten_all().unwrap().to_vec1().unwrap();
            let step = 1e-3f32;
            for (at, &analytic) in analytic.iter().enumerate() {
                let shifted = |by: f32| {
                    let mut moved = start();
                    moved[at] += by;
                    scalar(&losses(&rows(moved))[which])
                };
                let numeric = (shifted(step) - shifted(-step)) / f64::from(2.0 * step);
                let difference = (numeric - f64::from(analytic)).abs();
                assert!(difference < 4e-3, "{which} [{at}]: {numeric} {}", analytic);
            }
        }
    }

    #[test]
    fn an_image_in_the_ignored_band_moves_nothing() {
        let mut spots = in_groups(6, 2);
        // The last place comes within the band of the first.
        spots.queries[4].east = 50.0;
        spots.queries[5].east = 50.0;
        let images: Vec<(Side, u32)> = (0..6).map(|image| (Side::Query, image)).collect();
        let pairs = Pairs::of(&spots, &images).unwrap();
        assert!(!pairs.negative[4] && !pairs.positive[4] && pairs.negative[2]);
        let error = Pairs::of(&spots, &[(Side::Query, 0), (Side::Query, 4)]);
        assert!(matches!(error, Err(TrainError::NoTriplets(_))));
    }
}

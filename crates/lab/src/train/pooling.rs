//! Patch tokens to descriptors, differentiably: the aggregates that can be trained, and the head's
//! projection after them. The same computation as
//! [`Aggregate::pool`] and [`Head::project`]; a test compares the two.

use super::error::TrainError;
use super::loss::normalise_rows;
use super::ops::{linear, softmax};
use super::transformer::Pass;
use super::weights::Weights;
use candle_core::Tensor;
use placeformer_core::types::GLOBAL_DIM;
use placeformer_vision::extract::{Aggregate, Head, NetVlad, NetVladParameters};
use std::collections::BTreeMap;

type Result<T> = std::result::Result<T, TrainError>;

/// Names of the head's own tensors.
pub(super) const WEIGHT: &str = "head.weight";
pub(super) const BIAS: &str = "head.bias";
/// Beginning of the names of an aggregate's tensors.
pub(super) const AGGREGATE: &str = "aggregate.";
const MEAN: &str = "aggregate.mean";
const PROJECTION: &str = "aggregate.projection";
const WORDS: &str = "aggregate.words";
const ASSIGNMENT: &str = "aggregate.assignment";

/// How tokens become one vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pooling {
    /// Their mean.
    Mean,
    /// NetVLAD, whose projection, words and assignment are trained.
    NetVlad,
}

impl Pooling {
    /// Adds the tensors of `head` and its aggregate to `weights`, to be trained.
    ///
    /// # Errors
    /// The head pools in another way.
    pub(super) fn of(head: &Head, weights: &mut Weights) -> Result<Self> {
        let (weight, bias) = head.weights();
        weights.train(WEIGHT, &[GLOBAL_DIM, head.dim()], weight)?;
        weights.train(BIAS, &[GLOBAL_DIM], bias)?;
        match head.aggregate() {
            Aggregate::Mean => Ok(Self::Mean),
            Aggregate::NetVlad(netvlad) => {
                let parts = netvlad.parameters();
                let words = [netvlad.count(), netvlad.width()];
                // The mean only centres the tokens; the words can take over any change of it.
                weights.fix(MEAN, &[netvlad.dim()], &parts.mean)?;
                let projection = [netvlad.width(), netvlad.dim()];
                weights.train(PROJECTION, &projection, &parts.projection)?;
                weights.train(WORDS, &words, &parts.words)?;
                weights.train(ASSIGNMENT, &words, &parts.assignment)?;
                Ok(Self::NetVlad)
            }
            other => Err(TrainError::Setting(format!(
                "blocks are trained under the mean of the tokens or a NetVLAD, and this head takes \
                 {other}"
            ))),
        }
    }

    /// The aggregate as it is now.
    ///
    /// # Errors
    /// Its values can no longer be computed with.
    pub(super) fn aggregate(self, weights: &Weights) -> Result<Aggregate> {
        match self {
            Self::Mean => Ok(Aggregate::Mean),
            Self::NetVlad => {
                let parameters = NetVladParameters {
                    mean: weights.values(MEAN)?,
                    projection: weights.values(PROJECTION)?,
                    words: weights.values(WORDS)?,
                    assignment: weights.values(ASSIGNMENT)?,
                };
                let netvlad = NetVlad::new(parameters).map_err(TrainError::Setting)?;
                Ok(Aggregate::NetVlad(Box::new(netvlad)))
            }
        }
    }

    /// The head as it is now.
    ///
    /// # Errors
    /// Its values can no longer be computed with.
    pub(super) fn head(
        self,
        weights: &Weights,
        backbone: String,
        notes: BTreeMap<String, String>,
    ) -> Result<Head> {
        let weight = weights.values(WEIGHT)?;
        let bias = weights.values(BIAS)?;
        Ok(Head::new(
            self.aggregate(weights)?,
            weight,
            bias,
            backbone,
            notes,
        )?)
    }

    /// Pooled tokens of unit length, `[batch, pooled]`, of patch tokens `[batch, n, dim]`.
    pub(super) fn pool(self, pass: Pass<'_>, tokens: &Tensor) -> Result<Tensor> {
        match self {
            Self::Mean => Ok(normalise_rows(&tokens.mean(1)?)?),
            Self::NetVlad => {
                let mean = pass.get(MEAN)?;
                let projection = pass.get(PROJECTION)?;
                let words = pass.get(WORDS)?;
                let assignment = pass.get(ASSIGNMENT)?;
                Ok(netvlad(tokens, &mean, &projection, &words, &assignment)?)
            }
        }
    }
}

/// Descriptors of unit length, `[batch, 256]`, of pooled tokens `[batch, pooled]`.
pub(super) fn project(pass: Pass<'_>, pooled: &Tensor) -> Result<Tensor> {
    let weight = pass.get(WEIGHT)?;
    let bias = pass.get(BIAS)?;
    Ok(normalise_rows(&linear(pooled, &weight, &bias)?)?)
}

/// Sums of residuals of `tokens` `[batch, n, dim]`, `[batch, words * width]`, of unit length.
fn netvlad(
    tokens: &Tensor,
    mean: &Tensor,
    projection: &Tensor,
    words: &Tensor,
    assignment: &Tensor,
) -> candle_core::Result<Tensor> {
    let (batch, count, dim) = tokens.dims3()?;
    let (words_count, width) = words.dims2()?;
    let unit = normalise_rows(&tokens.reshape((batch * count, dim))?)?;
    let projected = unit.broadcast_sub(mean)?.matmul(&projection.t()?)?;
    let projected = normalise_rows(&projected)?;
    let weights = softmax(&projected.matmul(&assignment.t()?)?)?;
    let weights = weights.reshape((batch, count, words_count))?;
    let projected = projected.reshape((batch, count, width))?;
    let by_word = weights.transpose(1, 2)?.contiguous()?;
    let sums = by_word.matmul(&projected)?;
    let taken = by_word
        .sum_keepdim(2)?
        .broadcast_mul(&words.unsqueeze(0)?)?;
    let residuals = (sums - taken)?.reshape((batch * words_count, width))?;
    normalise_rows(&normalise_rows(&residuals)?.reshape((batch, words_count * width))?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::ops::{check_gradient, some};
    use crate::train::weights::Graph;

    const DIM: usize = 6;
    const WIDTH: usize = 3;

    fn head() -> Head {
        let values =
            |shape: &[usize]| -> Vec<f32> { some(shape).flatten_all().unwrap().to_vec1().unwrap() };
        let parameters = NetVladParameters {
            mean: some(&[DIM]).affine(0.1, 0.0).unwrap().to_vec1().unwrap(),
            projection: values(&[WIDTH, DIM]),
            words: values(&[4, WIDTH]),
            assignment: values(&[4, WIDTH]).iter().rev().map(|v| v * 5.0).collect(),
        };
        let aggregate = Aggregate::NetVlad(Box::new(NetVlad::new(parameters).unwrap()));
        let weight = values(&[GLOBAL_DIM, 4 * WIDTH]);
        Head::new(
            aggregate,
            weight,
            vec![0.1; GLOBAL_DIM],
            "b",
            BTreeMap::new(),
        )
        .unwrap()
    }

    #[test]
    fn descriptors_are_those_of_the_head_that_serves() {
        let head = head();
        let mut weights = Weights::default();
        let pooling = Pooling::of(&head, &mut weights).unwrap();
        let tokens = (some(&[2, 7, DIM]) * 3.0).unwrap();
        let pass = Pass {
            weights: &weights,
            graph: Graph::Skipped,
        };
        let pooled = pooling.pool(pass, &tokens).unwrap();
        let descriptors = project(pass, &pooled).unwrap();
        for image in 0..2 {
            let values: Vec<f32> = tokens
                .get(image)
                .unwrap()
                .flatten_all()
                .unwrap()
                .to_vec1()
                .unwrap();
            let served = head.project(&head.aggregate().pool(&values, DIM));
            let trained: Vec<f32> = descriptors.get(image).unwrap().to_vec1().unwrap();
            let worst = trained.iter().zip(&served).map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, f32::max) < 1e-5);
        }
        let back = pooling.head(&weights, "b".into(), BTreeMap::new()).unwrap();
        assert_eq!(back, head);
    }

    #[test]
    fn gradients_of_every_part_agree_with_finite_differences() {
        let tokens = some(&[2, 5, DIM]);
        let mean = (some(&[DIM]) * 0.1).unwrap();
        let projection = some(&[WIDTH, DIM]);
        let words = some(&[4, WIDTH]);
        let assignment = (some(&[4, WIDTH]) * 2.0).unwrap();
        check_gradient(&tokens, |tokens| {
            netvlad(tokens, &mean, &projection, &words, &assignment)
        });
        check_gradient(&projection, |projection| {
            netvlad(&tokens, &mean, projection, &words, &assignment)
        });
        check_gradient(&words, |words| {
            netvlad(&tokens, &mean, &projection, words, &assignment)
        });
        check_gradient(&assignment, |assignment| {
            netvlad(&tokens, &mean, &projection, &words, assignment)
        });
    }
}

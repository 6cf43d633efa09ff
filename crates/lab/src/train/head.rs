//! Training the head alone: images are encoded once, so that a step costs a matrix product.

use super::config::TrainConfig;
use super::error::TrainError;
use super::loss::normalise_rows;
use super::model::{Graph, Group, Sample, TripletModel, Variable};
use super::trainer::{Outcome, Session, run};
use super::triplets::{Side, TripletSet};
use candle_core::{Device, Tensor, Var};

/// A linear head over cached pooled tokens.
pub struct HeadModel {
    weight: Var,
    bias: Var,
    training: PooledTokens,
    validation: PooledTokens,
}

/// Pooled tokens of both sides of a set.
pub struct PooledTokens {
    queries: Tensor,
    database: Tensor,
}

impl PooledTokens {
    /// Takes rows of `dim` values for every query and every database image, in the set's order.
    ///
    /// # Errors
    /// The values do not fill the rows.
    pub fn new(dim: usize, queries: Vec<f32>, database: Vec<f32>) -> Result<Self, TrainError> {
        let matrix = |values: Vec<f32>| {
            Tensor::from_vec(values.clone(), (values.len() / dim, dim), &Device::Cpu)
        };
        Ok(Self {
            queries: matrix(queries)?,
            database: matrix(database)?,
        })
    }

    fn side(&self, side: Side) -> &Tensor {
        match side {
            Side::Query => &self.queries,
            Side::Database => &self.database,
        }
    }
}

impl HeadModel {
    /// Starts from a head: `weight` is `[outputs, dim]` row-major, `bias` `[outputs]`.
    ///
    /// # Errors
    /// The values do not fill the rows.
    pub fn new(
        weight: &[f32],
        bias: &[f32],
        training: PooledTokens,
        validation: PooledTokens,
    ) -> Result<Self, TrainError> {
        let outputs = bias.len();
        let weight = Tensor::from_slice(weight, (outputs, weight.len() / outputs), &Device::Cpu)?;
        let bias = Tensor::from_slice(bias, outputs, &Device::Cpu)?;
        Ok(Self {
            weight: Var::from_tensor(&weight)?,
            bias: Var::from_tensor(&bias)?,
            training,
            validation,
        })
    }

    /// Trains in place; afterwards the weights are the best seen.
    ///
    /// # Errors
    /// A setting is out of range, the checkpoint is one of another run, or the loss is no longer
    /// finite.
    pub fn train(
        &self,
        training: &TripletSet,
        validation: &TripletSet,
        config: &TrainConfig,
        session: Session<'_>,
    ) -> Result<Outcome, TrainError> {
        if config.augmentation.enabled() {
            return Err(TrainError::Setting(
                "cached tokens cannot be augmented; switch augmentation off".into(),
            ));
        }
        if config.finish.changes() {
            return Err(TrainError::Setting(
                "a head alone is neither averaged with its start nor fitted again".into(),
            ));
        }
        run(&self.bound(training), training, validation, config, session)
    }

    /// The head with the caches of `training` and of any other set.
    pub(super) fn bound<'a>(&'a self, training: &'a TripletSet) -> Bound<'a> {
        Bound {
            head: self,
            training,
        }
    }

    /// The weights, `[outputs, dim]` row-major, and the bias, `[outputs]`.
    ///
    /// # Errors
    /// The tensor library fails.
    pub fn weights(&self) -> Result<(Vec<f32>, Vec<f32>), TrainError> {
        Ok((self.weight.flatten_all()?.to_vec1()?, self.bias.to_vec1()?))
    }
}

/// A head that knows which of its two caches belongs to which set.
pub(super) struct Bound<'a> {
    head: &'a HeadModel,
    training: &'a TripletSet,
}

impl TripletModel for Bound<'_> {
    fn variables(&self) -> Vec<Variable> {
        let variable = |name: &str, variable: &Var| Variable {
            name: name.into(),
            variable: variable.clone(),
            group: Group::Projection,
        };
        vec![
            variable("head.weight", &self.head.weight),
            variable("head.bias", &self.head.bias),
        ]
    }

    fn embed(
        &self,
        set: &TripletSet,
        samples: &[Sample],
        graph: Graph,
    ) -> Result<Tensor, TrainError> {
        let tokens = if std::ptr::eq(set, self.training) {
            &self.head.training
        } else {
            &self.head.validation
        };
        // A batch mixes sides; rows are gathered one by one, which is nothing beside the product.
        let rows: Result<Vec<Tensor>, _> = samples
            .iter()
            .map(|sample| tokens.side(sample.side).narrow(0, sample.index, 1))
            .collect();
        let rows = Tensor::cat(&rows?, 0)?;
        let [weight, bias] = [&self.head.weight, &self.head.bias].map(|variable| match graph {
            Graph::Recorded => variable.as_tensor().clone(),
            Graph::Skipped => variable.as_detached_tensor(),
        });
        let projected = rows.matmul(&weight.t()?)?.broadcast_add(&bias)?;
        Ok(normalise_rows(&projected)?)
    }

    fn embed_batch(&self) -> usize {
        4096
    }
}

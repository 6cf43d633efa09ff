//! The weights of a model in training: those that stay, those that move, and low-rank adapters.
//!
//! An adapter (LoRA, Hu et al. 2022) leaves a matrix W as it is and trains two thin ones whose
//! product is added to it: W + up * down. Few values move, so a run overfits less and its result
//! is small. `up` starts at zero, so that training starts from W.

use super::error::TrainError;
use candle_core::{Device, Tensor, Var};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, HashMap};

type Result<T> = std::result::Result<T, TrainError>;

/// Endings of the names of an adapter's two factors.
pub(super) const UP: &str = ".up";
pub(super) const DOWN: &str = ".down";

/// Whether operations are recorded, so that gradients can be taken of their result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Graph {
    /// Recorded: everything between the weights and the result stays in memory.
    Recorded,
    /// Not recorded: what is no longer needed is freed.
    Skipped,
}

/// Weights by name.
#[derive(Clone, Default)]
pub(super) struct Weights {
    fixed: HashMap<String, Tensor>,
    variables: BTreeMap<String, Var>,
}

impl Weights {
    /// Adds a tensor that stays as it is.
    pub(super) fn fix(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Result<()> {
        let tensor = Tensor::from_slice(values, shape, &Device::Cpu)?;
        self.fixed.insert(name.to_owned(), tensor);
        Ok(())
    }

    /// Adds a tensor that is trained.
    pub(super) fn train(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Result<()> {
        let tensor = Tensor::from_slice(values, shape, &Device::Cpu)?;
        self.variables
            .insert(name.to_owned(), Var::from_tensor(&tensor)?);
        Ok(())
    }

    /// Adds a matrix that stays as it is, and an adapter of `rank` to it. `seed` decides how the
    /// adapter starts.
    pub(super) fn adapt(
        &mut self,
        name: &str,
        shape: &[usize],
        values: &[f32],
        rank: usize,
        seed: u64,
    ) -> Result<()> {
        self.fix(name, shape, values)?;
        let &[rows, columns] = shape else {
            return Err(TrainError::Tensor(format!(
                "{name} {shape:?} is no matrix to adapt"
            )));
        };
        // The usual spread of a layer's weights, by the width of its input.
        let spread = (columns as f32).sqrt().recip();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let down: Vec<f32> = (0..rank * columns)
            .map(|_| rng.random_range(-spread..spread))
            .collect();
        self.train(
            &format!("{name}{UP}"),
            &[rows, rank],
            &vec![0.0; rows * rank],
        )?;
        self.train(&format!("{name}{DOWN}"), &[rank, columns], &down)
    }

    /// Whether there is a tensor of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.fixed.contains_key(name) || self.variables.contains_key(name)
    }

    /// Whether the tensor of this name is trained, itself or by an adapter.
    pub(super) fn moves(&self, name: &str) -> bool {
        let adapter = format!("{name}{UP}");
        self.variables.contains_key(name) || self.variables.contains_key(&adapter)
    }

    /// The tensor of this name as it is now, with its adapter's product if it has one.
    ///
    /// # Errors
    /// There is none.
    pub(super) fn get(&self, name: &str, graph: Graph) -> Result<Tensor> {
        if let Some(variable) = self.variables.get(name) {
            return Ok(in_graph(variable, graph));
        }
        let fixed = self
            .fixed
            .get(name)
            .ok_or_else(|| TrainError::Tensor(format!("the model has no tensor {name}")))?;
        let factor = |ending: &str| self.variables.get(&format!("{name}{ending}"));
        match (factor(UP), factor(DOWN)) {
            (Some(up), Some(down)) => {
                let product = in_graph(up, graph).matmul(&in_graph(down, graph))?;
                Ok((fixed + product)?)
            }
            _ => Ok(fixed.clone()),
        }
    }

    /// The values of the tensor of this name, as [`Weights::get`].
    ///
    /// # Errors
    /// There is none.
    pub(super) fn values(&self, name: &str) -> Result<Vec<f32>> {
        Ok(self
            .get(name, Graph::Skipped)?
            .flatten_all()?
            .to_vec1::<f32>()?)
    }

    /// What is trained, by name.
    pub(super) fn variables(&self) -> &BTreeMap<String, Var> {
        &self.variables
    }

    /// Sets a trained tensor.
    ///
    /// # Errors
    /// No trained tensor has this name and number of values.
    pub(super) fn set(&self, name: &str, values: Vec<f32>) -> Result<()> {
        let variable = self
            .variables
            .get(name)
            .ok_or_else(|| TrainError::Tensor(format!("{name} is not trained")))?;
        let tensor = Tensor::from_vec(values, variable.shape(), &Device::Cpu)?;
        Ok(variable.set(&tensor)?)
    }

    /// A copy of the trained tensors as they are now.
    pub(super) fn snapshot(&self) -> Result<BTreeMap<String, Tensor>> {
        self.variables
            .iter()
            .map(|(name, variable)| Ok((name.clone(), variable.as_tensor().copy()?)))
            .collect()
    }

    /// Weights of their own that lie between `start` and these: `share` of the way.
    ///
    /// Of an adapter the product is what counts, and it starts at zero. So one factor is shortened
    /// and the other stays.
    pub(super) fn averaged(&self, start: &BTreeMap<String, Tensor>, share: f64) -> Result<Self> {
        let mut variables = BTreeMap::new();
        for (name, variable) in &self.variables {
            let now = variable.as_detached_tensor();
            let between = match start.get(name) {
                Some(start) if !name.ends_with(DOWN) => {
                    ((start * (1.0 - share))? + (now * share)?)?
                }
                _ => now.copy()?,
            };
            variables.insert(name.clone(), Var::from_tensor(&between)?);
        }
        Ok(Self {
            fixed: self.fixed.clone(),
            variables,
        })
    }
}

fn in_graph(variable: &Var, graph: Graph) -> Tensor {
    match graph {
        Graph::Recorded => variable.as_tensor().clone(),
        Graph::Skipped => variable.as_detached_tensor(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn weights() -> Weights {
        let mut weights = Weights::default();
        weights.train("bias", &[2], &[1.0, 2.0]).unwrap();
        let matrix = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        weights.adapt("matrix", &[2, 3], &matrix, 1, 7).unwrap();
        weights
    }

    #[test]
    fn an_adapter_starts_where_its_matrix_is_and_adds_a_product() {
        let weights = weights();
        assert_eq!(
            weights.values("matrix").unwrap(),
            [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
        );
        weights.set("matrix.up", vec![1.0, 2.0]).unwrap();
        weights.set("matrix.down", vec![0.5, 0.0, -1.0]).unwrap();
        assert_eq!(
            weights.values("matrix").unwrap(),
            [1.5, 2.0, 2.0, 5.0, 5.0, 4.0]
        );
        assert!(weights.set("matrix", vec![0.0; 6]).is_err());
        assert!(weights.get("other", Graph::Skipped).is_err());
    }

    #[test]
    fn averages_lie_on_the_way_from_the_start_and_leave_the_weights_alone() {
        let weights = weights();
        let start = weights.snapshot().unwrap();
        weights.set("bias", vec![5.0, 2.0]).unwrap();
        weights.set("matrix.up", vec![1.0, 2.0]).unwrap();
        weights.set("matrix.down", vec![0.5, 0.0, -1.0]).unwrap();
        let averaged = weights.averaged(&start, 0.75).unwrap();
        assert_eq!(averaged.values("bias").unwrap(), [4.0, 2.0]);
        // The matrix too is three quarters of the way.
        assert_eq!(
            averaged.values("matrix").unwrap(),
            [1.375, 2.0, 2.25, 4.75, 5.0, 4.5]
        );
        assert_eq!(weights.values("bias").unwrap(), [5.0, 2.0]);
        averaged.set("bias", vec![0.0, 0.0]).unwrap();
        assert_eq!(weights.values("bias").unwrap(), [5.0, 2.0]);
    }
}

//! What the training loop needs of a model.

use super::error::TrainError;
use super::triplets::{Side, TripletSet};
pub(super) use super::weights::Graph;
use candle_core::{Tensor, Var};
use placeformer_core::progress::Progress;

/// An image to embed: which one, and under which variation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sample {
    pub(super) side: Side,
    pub(super) index: usize,
    /// Seed of its variation; `None` leaves the image as it is.
    pub(super) variation: Option<u64>,
}

/// A trainable tensor.
pub(super) struct Variable {
    pub(super) name: String,
    pub(super) variable: Var,
    pub(super) group: Group,
}

/// Tensors that share a learning rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Group {
    /// Those of the transformer.
    Blocks,
    /// Those of the aggregate.
    Aggregate,
    /// The head's projection.
    Projection,
}

/// Something that can be trained: weights, and a differentiable way from images to descriptors.
pub(super) trait TripletModel: Sync {
    /// The trainable weights.
    fn variables(&self) -> Vec<Variable>;

    /// Unit-length descriptors `[samples, dim]`.
    fn embed(
        &self,
        set: &TripletSet,
        samples: &[Sample],
        graph: Graph,
    ) -> Result<Tensor, TrainError>;

    /// How many images to embed at once outside the graph.
    fn embed_batch(&self) -> usize;

    /// The model whose recall is watched, if it is not this one but what would be made of it if the
    /// run ended here.
    fn outcome(
        &self,
        _training: &TripletSet,
        _progress: &dyn Progress,
    ) -> Result<Option<Box<dyn TripletModel + '_>>, TrainError> {
        Ok(None)
    }
}

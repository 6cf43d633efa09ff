//! What the training loop needs of a model.

use super::error::TrainError;
use super::triplets::{Side, TripletSet};
use candle_core::{Tensor, Var};

/// An image to embed: which one, and under which variation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sample {
    pub(super) side: Side,
    pub(super) index: usize,
    /// Seed of its variation; `None` leaves the image as it is.
    pub(super) variation: Option<u64>,
}

/// Something that can be trained: weights, and a differentiable way from images to descriptors.
pub(super) trait TripletModel {
    /// The trainable weights by name.
    fn variables(&self) -> Vec<(String, Var)>;

    /// Unit-length descriptors `[samples, dim]`, in the graph.
    fn embed(&self, set: &TripletSet, samples: &[Sample]) -> Result<Tensor, TrainError>;

    /// How many images to embed at once outside the graph.
    fn embed_batch(&self) -> usize;
}

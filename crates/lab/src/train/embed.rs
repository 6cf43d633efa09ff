//! Descriptors of many images under the present weights, outside the graph.

use super::error::TrainError;
use super::gradients::each_in_parallel;
use super::model::{Graph, Sample, TripletModel};
use super::triplets::{Side, TripletSet};
use placeformer_core::progress::{Progress, Task};
use std::collections::{BTreeSet, HashMap};

/// Descriptors of the images that were embedded, by image.
pub(super) struct Embeddings {
    dim: usize,
    /// `[rows, dim]`.
    rows: Vec<f32>,
    row_of: HashMap<(Side, u32), usize>,
}

impl Embeddings {
    /// Takes the rows, `[rows, dim]`, and which of them is an image's.
    pub(super) fn new(dim: usize, rows: Vec<f32>, row_of: HashMap<(Side, u32), usize>) -> Self {
        Self { dim, rows, row_of }
    }

    /// The descriptor of an image.
    ///
    /// # Errors
    /// It is not among those embedded.
    pub(super) fn of(&self, side: Side, index: u32) -> Result<&[f32], TrainError> {
        let row = self.row_of.get(&(side, index)).ok_or_else(|| {
            TrainError::Tensor(format!(
                "{side:?} image {index} was not embedded in this cycle"
            ))
        })?;
        Ok(&self.rows[row * self.dim..(row + 1) * self.dim])
    }

    /// Descriptors of several database images, each with its index.
    pub(super) fn of_database(&self, indices: &[u32]) -> Result<Vec<(u32, &[f32])>, TrainError> {
        indices
            .iter()
            .map(|&index| Ok((index, self.of(Side::Database, index)?)))
            .collect()
    }
}

/// Embeds `images`. A file that is both a query and a database image is embedded once.
pub(super) fn embed(
    model: &dyn TripletModel,
    set: &TripletSet,
    images: impl IntoIterator<Item = (Side, u32)>,
    purpose: &'static str,
    progress: &dyn Progress,
) -> Result<Embeddings, TrainError> {
    let images: BTreeSet<(Side, u32)> = images.into_iter().collect();
    let mut samples = Vec::new();
    let mut row_of = HashMap::new();
    let mut row_of_file = HashMap::new();
    for (side, index) in images {
        let file = &set.images(side)[index as usize];
        let row = *row_of_file.entry(file).or_insert(samples.len());
        if row == samples.len() {
            samples.push(Sample {
                side,
                index: index as usize,
                variation: None,
            });
        }
        row_of.insert((side, index), row);
    }

    let task = Task::begin(progress, purpose, samples.len() as u64);
    let mut dim = 0;
    let mut rows = Vec::new();
    let groups: Vec<&[Sample]> = samples.chunks(model.embed_batch()).collect();
    each_in_parallel(
        &groups,
        |group| model.embed(set, group, Graph::Skipped),
        |descriptors| {
            dim = descriptors.dim(1)?;
            rows.extend(descriptors.flatten_all()?.to_vec1::<f32>()?);
            task.add(descriptors.dim(0)? as u64);
            Ok(())
        },
    )?;
    Ok(Embeddings::new(dim, rows, row_of))
}

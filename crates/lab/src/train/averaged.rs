//! What would come out if a run ended now: weights between the trained ones and those it started
//! from, under a projection that is fitted to them.
//!
//! The trained weights themselves may find fewer held-out places than the start, because they
//! overfit what they were trained on, while their average with the start finds more than both. So a
//! run that watched the trained weights would keep the start.

use super::backbone::{BackboneModel, EMBED_BATCH};
use super::error::TrainError;
use super::gradients::each_in_parallel;
use super::model::{Graph, Sample, TripletModel, Variable};
use super::pooling;
use super::transformer::Pass;
use super::triplets::{Side, TripletSet};
use super::weights::Weights;
use candle_core::Tensor;
use placeformer_core::progress::{Progress, Task};
use placeformer_vision::extract::{Whitening, whitened_head_of_few};
use std::collections::{BTreeMap, HashSet};

type Result<T> = std::result::Result<T, TrainError>;

/// A model with weights of its own.
pub(super) struct Averaged<'a> {
    model: &'a BackboneModel,
    weights: Weights,
}

impl<'a> Averaged<'a> {
    /// Averages the weights of `model` with those it started from.
    pub(super) fn of(model: &'a BackboneModel) -> Result<Self> {
        let weights = model.weights.averaged(&model.start, model.finish.average)?;
        Ok(Self { model, weights })
    }

    /// Fits the projection to training images, evenly spread over all.
    pub(super) fn fit(
        &self,
        training: &TripletSet,
        power: f64,
        progress: &dyn Progress,
    ) -> Result<()> {
        let samples = spread_samples(training, self.model.finish.fit_images);
        let task = Task::begin(progress, "fitting", samples.len() as u64);
        let groups: Vec<&[Sample]> = samples.chunks(EMBED_BATCH).collect();
        let mut vectors = Vec::with_capacity(samples.len());
        each_in_parallel(
            &groups,
            |group| self.model.pooled(self.pass(), training, group),
            |pooled| {
                vectors.extend(pooled.to_vec2::<f32>()?);
                task.add(pooled.dim(0)? as u64);
                Ok(())
            },
        )?;
        let whitening = Whitening::new(power).map_err(TrainError::Setting)?;
        let aggregate = self.model.pooling.aggregate(&self.weights)?;
        let head = whitened_head_of_few(&vectors, whitening, aggregate, "", BTreeMap::new())?;
        let (weight, bias) = head.weights();
        self.weights.set(pooling::WEIGHT, weight.to_vec())?;
        self.weights.set(pooling::BIAS, bias.to_vec())
    }

    fn pass(&self) -> Pass<'_> {
        Pass {
            weights: &self.weights,
            graph: Graph::Skipped,
        }
    }
}

impl TripletModel for Averaged<'_> {
    fn variables(&self) -> Vec<Variable> {
        // It is only looked at.
        Vec::new()
    }

    fn embed(&self, set: &TripletSet, samples: &[Sample], _: Graph) -> Result<Tensor> {
        self.model.described(self.pass(), set, samples)
    }

    fn embed_batch(&self) -> usize {
        EMBED_BATCH
    }
}

/// At most `count` different images of a set, as they are, evenly spread over both sides.
fn spread_samples(set: &TripletSet, count: usize) -> Vec<Sample> {
    let mut seen = HashSet::new();
    let both_sides = [Side::Database, Side::Query].into_iter().flat_map(|side| {
        let images = set.images(side).iter().enumerate();
        images.map(move |(index, path)| (side, index, path))
    });
    let all: Vec<Sample> = both_sides
        .filter(|(_, _, path)| seen.insert(*path))
        .map(|(side, index, _)| Sample {
            side,
            index,
            variation: None,
        })
        .collect();
    let step = (all.len() as f64 / count.max(1) as f64).max(1.0);
    (0..all.len().min(count))
        .map(|i| all[(i as f64 * step) as usize])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::spots::Spots;
    use std::path::PathBuf;

    #[test]
    fn images_for_a_fit_are_different_and_spread_over_both_sides() {
        let paths = |names: std::ops::Range<usize>| -> Vec<PathBuf> {
            names.map(|i| PathBuf::from(i.to_string())).collect()
        };
        let set = TripletSet {
            queries: paths(8..16),
            database: paths(0..10),
            positives: vec![],
            near: vec![],
            spots: Spots::default(),
        };
        let names = |count: usize| -> Vec<String> {
            let name = |sample: Sample| set.images(sample.side)[sample.index].display().to_string();
            spread_samples(&set, count).into_iter().map(name).collect()
        };
        assert_eq!(names(4), ["0", "4", "8", "12"]);
        let all: Vec<String> = (0..16).map(|i| i.to_string()).collect();
        assert_eq!(names(100), all);
    }
}

//! The loop: mine, step, validate, keep the best, checkpoint; stop when validation no longer improves.

use super::TrainError;
use super::adam::Adam;
use super::checkpoint::Checkpoint;
use super::config::{TrainConfig, ValidationRecall};
use super::log::{CycleRecord, TrainLog};
use super::loss::triplet_margin_loss;
use super::mining::{Embeddings, hardest_negatives, row, squared_distance};
use super::triplets::{Side, TripletSet};
use candle_core::{Tensor, Var};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

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

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Outcome {
    /// Steps taken over all interruptions.
    pub steps: u64,
    /// Whether validation stopped improving before the schedule ended.
    pub stopped_early: bool,
    /// Recall before the first step.
    pub initial: ValidationRecall,
    /// Recall of the weights that were kept.
    pub best: ValidationRecall,
    /// Mean loss of the last cycle.
    pub last_loss: f32,
}

/// Where a run keeps its memory and whom it tells.
pub struct Session<'a> {
    /// Folder of the checkpoint and the log; an existing checkpoint is continued.
    pub folder: PathBuf,
    /// What the run depends on besides its settings: data, starting weights. A checkpoint of another is refused.
    pub identity: String,
    /// Called after every cycle.
    pub progress: &'a mut dyn FnMut(&CycleRecord),
}

/// Trains `model` on `training`, watching `validation`, and leaves it with the best weights seen.
pub(super) fn run(
    model: &dyn TripletModel,
    training: &TripletSet,
    validation: &TripletSet,
    config: &TrainConfig,
    session: Session<'_>,
) -> Result<Outcome, TrainError> {
    config.check()?;
    let mut adam = Adam::new(model.variables())?;
    let mut checkpoint = match Checkpoint::resume(&session.folder, config, &session.identity, &mut adam)? {
        Some(checkpoint) => checkpoint,
        None => Checkpoint::start(&adam, validate(model, validation)?)?,
    };
    let mut log = TrainLog::open(&session.folder, checkpoint.steps)?;
    let usable: Vec<usize> = training.usable().collect();
    while checkpoint.steps < config.schedule.total && checkpoint.cycles_without_gain < config.patience {
        let started = Instant::now();
        let until = (checkpoint.steps + config.steps_per_cycle).min(config.schedule.total);
        let loss = cycle(model, training, &usable, config, &mut adam, checkpoint.steps..until)?;
        let recall = validate(model, validation)?;
        checkpoint.record(&adam, until, loss, recall)?;
        checkpoint.save(&session.folder, config, &session.identity, &adam)?;
        let record = CycleRecord {
            step: until,
            learning_rate: config.schedule.rate(until - 1),
            loss,
            recall,
            seconds: started.elapsed().as_secs_f64(),
        };
        log.append(&record)?;
        (session.progress)(&record);
    }
    checkpoint.restore_best(&adam)?;
    Ok(Outcome {
        steps: checkpoint.steps,
        stopped_early: checkpoint.steps < config.schedule.total,
        initial: checkpoint.initial,
        best: checkpoint.best,
        last_loss: checkpoint.last_loss,
    })
}

/// Mines once, then takes the steps of `range`; returns their mean loss.
fn cycle(
    model: &dyn TripletModel,
    set: &TripletSet,
    usable: &[usize],
    config: &TrainConfig,
    adam: &mut Adam,
    range: std::ops::Range<u64>,
) -> Result<f32, TrainError> {
    let embeddings = embed_everything(model, set)?;
    let mined = hardest_negatives(
        set,
        usable,
        &embeddings,
        config.negatives,
        config.mining_pool,
        config.seed ^ range.start.rotate_left(32),
    );
    let steps = range.end - range.start;
    let mut total = 0.0;
    for step in range {
        let [queries, positives, negatives] = draw_batch(set, usable, &mined, &embeddings, config, step)?;
        let count = queries.len();
        let samples: Vec<Sample> = [queries, positives, negatives].concat();
        // One pass for all three roles: the backbone is run on the largest batch it can have.
        let descriptors = model.embed(set, &samples)?;
        let part = |role: usize| descriptors.narrow(0, role * count, count);
        let loss = triplet_margin_loss(&part(0)?, &part(1)?, &part(2)?, config.margin)?;
        let value = loss.to_scalar::<f32>()?;
        if !value.is_finite() {
            return Err(TrainError::Diverged { step, loss: value });
        }
        total += value;
        adam.step(&loss.backward()?, config.schedule.rate(step))?;
    }
    Ok(total / steps as f32)
}

/// Queries drawn at random; of each, the positive that looks most alike now (a positive may look the other way) and
/// one of its hard negatives.
fn draw_batch(
    set: &TripletSet,
    usable: &[usize],
    mined: &[Vec<u32>],
    embeddings: &Embeddings,
    config: &TrainConfig,
    step: u64,
) -> Result<[Vec<Sample>; 3], TrainError> {
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    rng.set_stream(step + 1);
    let mut roles: [Vec<Sample>; 3] = Default::default();
    let with_negatives: Vec<usize> = (0..usable.len()).filter(|&i| !mined[i].is_empty()).collect();
    if with_negatives.is_empty() {
        return Err(TrainError::NoTriplets("the mining pool holds no negative of any query".into()));
    }
    for _ in 0..config.batch {
        let chosen = with_negatives[rng.random_range(0..with_negatives.len())];
        let query = usable[chosen];
        let descriptor = row(&embeddings.queries, query, embeddings.dim);
        let distance =
            |index: u32| squared_distance(descriptor, row(&embeddings.database, index as usize, embeddings.dim));
        let Some(&positive) = set.positives[query].iter().min_by(|a, b| distance(**a).total_cmp(&distance(**b))) else {
            continue;
        };
        let negative = mined[chosen][rng.random_range(0..mined[chosen].len())];
        let parts = [(Side::Query, query), (Side::Database, positive as usize), (Side::Database, negative as usize)];
        for (role, (side, index)) in parts.into_iter().enumerate() {
            let variation = config.augmentation.enabled().then(|| rng.next_u64());
            roles[role].push(Sample { side, index, variation });
        }
    }
    Ok(roles)
}

/// Descriptors of every image, outside the graph.
fn embed_everything(model: &dyn TripletModel, set: &TripletSet) -> Result<Embeddings, TrainError> {
    let mut dim = 0;
    let mut embed_side = |side: Side| -> Result<Vec<f32>, TrainError> {
        let mut rows = Vec::new();
        let all: Vec<Sample> =
            (0..set.images(side).len()).map(|index| Sample { side, index, variation: None }).collect();
        for chunk in all.chunks(model.embed_batch()) {
            let descriptors = model.embed(set, chunk)?.detach();
            dim = descriptors.dim(1)?;
            rows.extend(descriptors.flatten_all()?.to_vec1::<f32>()?);
        }
        Ok(rows)
    };
    let queries = embed_side(Side::Query)?;
    // A drive whose frames both ask and answer is embedded once.
    let database = if set.queries == set.database { queries.clone() } else { embed_side(Side::Database)? };
    Ok(Embeddings { dim, queries, database })
}

/// Recall over the usable queries; images that are near without being positives are passed over, as a frame of a
/// drive would otherwise find itself.
fn validate(model: &dyn TripletModel, set: &TripletSet) -> Result<ValidationRecall, TrainError> {
    let embeddings = embed_everything(model, set)?;
    let usable: Vec<usize> = set.usable().collect();
    let better: Vec<usize> = usable
        .par_iter()
        .map(|&query| {
            let descriptor = row(&embeddings.queries, query, embeddings.dim);
            let distance =
                |index: u32| squared_distance(descriptor, row(&embeddings.database, index as usize, embeddings.dim));
            let nearest = set.positives[query].iter().map(|&index| distance(index)).fold(f32::INFINITY, f32::min);
            (0..set.database.len() as u32)
                .filter(|index| set.near[query].binary_search(index).is_err() && distance(*index) < nearest)
                .count()
        })
        .collect();
    let recall = |k: usize| 100.0 * better.iter().filter(|&&rank| rank < k).count() as f64 / usable.len() as f64;
    Ok(ValidationRecall { at_1: recall(1), at_5: recall(5), at_10: recall(10) })
}

#[cfg(test)]
mod tests;

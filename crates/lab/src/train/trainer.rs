//! The loop: mine, step, validate, keep the best, checkpoint; stop when validation no longer
//! improves.

use super::TrainError;
use super::adam::Adam;
use super::checkpoint::Checkpoint;
use super::config::{TrainConfig, ValidationRecall};
use super::log::{CycleRecord, TrainLog};
use super::loss::triplet_margin_loss;
use super::mining::{Embeddings, draw_pool, hardest_negatives};
use super::triplets::{Side, TripletSet};
use candle_core::{Tensor, Var};
use placeformer_vision::extract::squared_distance;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::{BTreeSet, HashMap};
use std::ops::Range;
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

/// How far a run has come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Progress<'a> {
    /// Images described so far, of those a mining or a validation needs.
    Described {
        /// What they are described for.
        purpose: &'static str,
        /// So many are done.
        done: usize,
        /// Of so many.
        of: usize,
    },
    /// A step was taken.
    Step {
        /// Steps so far, over all interruptions.
        steps: u64,
        /// Its loss.
        loss: f32,
    },
    /// A cycle ended: it was validated, checkpointed and logged.
    Cycle(&'a CycleRecord),
}

/// Where a run keeps its memory and whom it tells.
pub struct Session<'a> {
    /// Folder of the checkpoint and the log; an existing checkpoint is continued.
    pub folder: PathBuf,
    /// What the run depends on besides its settings: data, starting weights. A checkpoint of
    /// another is refused.
    pub identity: String,
    /// Called after every batch described, every step and every cycle.
    pub progress: &'a mut dyn FnMut(Progress<'_>),
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
    let mut checkpoint =
        match Checkpoint::resume(&session.folder, config, &session.identity, &mut adam)? {
            Some(checkpoint) => checkpoint,
            None => Checkpoint::start(&adam, validate(model, validation, session.progress)?)?,
        };
    let mut log = TrainLog::open(&session.folder, checkpoint.steps)?;
    let usable: Vec<usize> = training.usable().collect();
    while checkpoint.steps < config.schedule.total
        && checkpoint.cycles_without_gain < config.patience
    {
        let started = Instant::now();
        let until = (checkpoint.steps + config.steps_per_cycle).min(config.schedule.total);
        let range = checkpoint.steps..until;
        let loss = Cycle {
            model,
            set: training,
            config,
        }
        .run(&usable, &mut adam, range, session.progress)?;
        let recall = validate(model, validation, session.progress)?;
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
        (session.progress)(Progress::Cycle(&record));
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

/// What a cycle works on.
struct Cycle<'a> {
    model: &'a dyn TripletModel,
    set: &'a TripletSet,
    config: &'a TrainConfig,
}

/// A triplet before its positive and its negative are known.
struct Draw {
    query: u32,
    /// Which of the hard negatives.
    choice: u64,
    /// Seeds of the variations of query, positive and negative.
    variations: [u64; 3],
}

impl Cycle<'_> {
    /// Mines once, then takes the steps of `range`; returns their mean loss.
    fn run(
        &self,
        usable: &[usize],
        adam: &mut Adam,
        range: Range<u64>,
        progress: &mut dyn FnMut(Progress<'_>),
    ) -> Result<f32, TrainError> {
        let Self { model, set, config } = *self;
        let pool = draw_pool(
            set.database.len(),
            config.mining_pool,
            config.seed ^ range.start.rotate_left(32),
        );
        let draws = self.draw(usable, &pool, range.clone())?;
        let asked: Vec<u32> = draws
            .iter()
            .flatten()
            .map(|draw| draw.query)
            .collect::<BTreeSet<_>>()
            .into_iter()
            .collect();
        let positives = asked
            .iter()
            .flat_map(|&query| &set.positives[query as usize]);
        let needed = asked.iter().map(|&query| (Side::Query, query));
        let needed = needed.chain(positives.chain(&pool).map(|&index| (Side::Database, index)));
        let embeddings = embed(model, set, needed, "mining", progress)?;
        let mined = hardest_negatives(set, &asked, &embeddings, config.negatives, &pool)?;
        let steps = range.end - range.start;
        let mut total = 0.0;
        for (step, draws) in range.zip(&draws) {
            let [queries, positives, negatives] = self.batch(draws, &mined, &embeddings)?;
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
            progress(Progress::Step {
                steps: step + 1,
                loss: value,
            });
        }
        Ok(total / steps as f32)
    }

    /// The triplets of every step of `range`, drawn at random from the queries that have a negative
    /// in `pool`. What a step draws follows from the seed and its number.
    fn draw(
        &self,
        usable: &[usize],
        pool: &[u32],
        range: Range<u64>,
    ) -> Result<Vec<Vec<Draw>>, TrainError> {
        let near = &self.set.near;
        let has_negative = |query: &&usize| {
            pool.iter()
                .any(|index| near[**query].binary_search(index).is_err())
        };
        let askable: Vec<u32> = usable
            .iter()
            .filter(has_negative)
            .map(|&query| query as u32)
            .collect();
        if askable.is_empty() {
            return Err(TrainError::NoTriplets(
                "the mining pool holds no negative of any query".into(),
            ));
        }
        let of_step = |step: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
            rng.set_stream(step + 1);
            let mut draw = || Draw {
                query: askable[rng.random_range(0..askable.len())],
                choice: rng.next_u64(),
                variations: std::array::from_fn(|_| rng.next_u64()),
            };
            (0..self.config.batch).map(|_| draw()).collect()
        };
        Ok(range.map(of_step).collect())
    }

    /// Queries, positives and negatives: of each query, the positive that looks most alike now (a
    /// positive may look the other way) and one of its hard negatives.
    fn batch(
        &self,
        draws: &[Draw],
        mined: &HashMap<u32, Vec<u32>>,
        embeddings: &Embeddings,
    ) -> Result<[Vec<Sample>; 3], TrainError> {
        let mut roles: [Vec<Sample>; 3] = Default::default();
        for draw in draws {
            let descriptor = embeddings.of(Side::Query, draw.query)?;
            let positives = embeddings.of_database(&self.set.positives[draw.query as usize])?;
            let distance = |row: &[f32]| squared_distance(descriptor, row);
            let nearest = positives
                .iter()
                .min_by(|a, b| distance(a.1).total_cmp(&distance(b.1)));
            let hard = mined.get(&draw.query).filter(|hard| !hard.is_empty());
            let (Some(&(positive, _)), Some(hard)) = (nearest, hard) else {
                return Err(TrainError::NoTriplets(format!(
                    "query {} lost its positives or negatives",
                    draw.query
                )));
            };
            let negative = hard[(draw.choice % hard.len() as u64) as usize];
            let parts = [
                (Side::Query, draw.query),
                (Side::Database, positive),
                (Side::Database, negative),
            ];
            for ((role, (side, index)), seed) in roles.iter_mut().zip(parts).zip(draw.variations) {
                let variation = self.config.augmentation.enabled().then_some(seed);
                role.push(Sample {
                    side,
                    index: index as usize,
                    variation,
                });
            }
        }
        Ok(roles)
    }
}

/// Descriptors of `images`, outside the graph; a file is described once, also where it both asks
/// and answers.
fn embed(
    model: &dyn TripletModel,
    set: &TripletSet,
    images: impl IntoIterator<Item = (Side, u32)>,
    purpose: &'static str,
    progress: &mut dyn FnMut(Progress<'_>),
) -> Result<Embeddings, TrainError> {
    let (mut samples, mut places, mut rows_of) = (Vec::new(), HashMap::new(), HashMap::new());
    for (side, index) in images.into_iter().collect::<BTreeSet<(Side, u32)>>() {
        let row = *rows_of
            .entry(&set.images(side)[index as usize])
            .or_insert_with(|| {
                samples.push(Sample {
                    side,
                    index: index as usize,
                    variation: None,
                });
                samples.len() - 1
            });
        places.insert((side, index), row);
    }
    let (mut dim, mut rows, mut done) = (0, Vec::new(), 0);
    for chunk in samples.chunks(model.embed_batch()) {
        let descriptors = model.embed(set, chunk)?.detach();
        dim = descriptors.dim(1)?;
        rows.extend(descriptors.flatten_all()?.to_vec1::<f32>()?);
        done += chunk.len();
        progress(Progress::Described {
            purpose,
            done,
            of: samples.len(),
        });
    }
    Ok(Embeddings::new(dim, rows, places))
}

/// Recall over the usable queries; images that are near without being positives are passed over, as
/// a frame of a drive would otherwise find itself.
///
/// The rank is the worst that the distances allow: whatever is not farther than the nearest
/// positive comes before it. Otherwise a model that describes all images alike, or by no number at
/// all, would look perfect and be kept.
fn validate(
    model: &dyn TripletModel,
    set: &TripletSet,
    progress: &mut dyn FnMut(Progress<'_>),
) -> Result<ValidationRecall, TrainError> {
    let usable: Vec<usize> = set.usable().collect();
    let everything: Vec<u32> = (0..set.database.len() as u32).collect();
    let needed = usable.iter().map(|&query| (Side::Query, query as u32));
    let needed = needed.chain(everything.iter().map(|&index| (Side::Database, index)));
    let embeddings = embed(model, set, needed, "validation", progress)?;
    let database = embeddings.of_database(&everything)?;
    let rank_of = |&query: &usize| -> Result<usize, TrainError> {
        let descriptor = embeddings.of(Side::Query, query as u32)?;
        let distance = |index: u32| squared_distance(descriptor, database[index as usize].1);
        // f32::min passes over NaN: a positive without a distance is not found.
        let nearest = set.positives[query]
            .iter()
            .map(|&index| distance(index))
            .fold(f32::INFINITY, f32::min);
        let is_farther = |index: u32| distance(index) > nearest;
        Ok((0..database.len() as u32)
            .filter(|index| set.near[query].binary_search(index).is_err() && !is_farther(*index))
            .count())
    };
    let ranks: Vec<usize> = usable.par_iter().map(rank_of).collect::<Result<_, _>>()?;
    let recall = |k: usize| {
        100.0 * ranks.iter().filter(|&&rank| rank < k).count() as f64 / usable.len() as f64
    };
    Ok(ValidationRecall {
        at_1: recall(1),
        at_5: recall(5),
        at_10: recall(10),
    })
}

#[cfg(test)]
mod tests;

//! One cycle of training: hard negatives are mined once, then steps are taken on them.

use super::adam::Adam;
use super::config::TrainConfig;
use super::embed::{Embeddings, embed};
use super::error::TrainError;
use super::gradients::{LossOf, gradients};
use super::loss::{Loss, Pairs, info_nce, multi_similarity, triplet_margin_loss};
use super::mining::{draw_pool, hardest_negatives};
use super::model::{Sample, TripletModel};
use super::pairs::PairMiner;
use super::triplets::{Side, TripletSet};
use placeformer_core::progress::{Progress, Task};
use placeformer_vision::extract::squared_distance;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeSet, HashMap};
use std::ops::Range;
use std::time::Instant;

/// What a cycle works on, and whom it tells.
pub(super) struct Cycle<'a> {
    pub(super) model: &'a dyn TripletModel,
    pub(super) set: &'a TripletSet,
    pub(super) config: &'a TrainConfig,
    /// Told of the images embedded for the mining.
    pub(super) progress: &'a dyn Progress,
    /// Counts the steps of the whole run.
    pub(super) steps: &'a Task<'a>,
}

/// A triplet before its positive and its negative are known.
pub(super) struct Draw {
    pub(super) query: u32,
    /// Which of the hard negatives.
    choice: u64,
    /// Seeds of the variations of query, positive and negative.
    variations: [u64; 3],
}

/// What a mining found.
struct Mined {
    embeddings: Embeddings,
    /// The hardest negatives of each query, hardest first.
    negatives: HashMap<u32, Vec<u32>>,
}

/// How the steps of a cycle went.
pub(super) struct Steps {
    /// Mean loss.
    pub(super) loss: f32,
    /// Mean seconds of a step.
    pub(super) seconds: f64,
}

impl Cycle<'_> {
    /// Mines once, then takes the steps of `range`; returns how they went.
    pub(super) fn run(
        &self,
        usable: &[usize],
        adam: &mut Adam,
        range: Range<u64>,
    ) -> Result<Steps, TrainError> {
        let batches = match self.config.loss {
            Loss::Triplet { .. } => self.triplets(usable, range.clone())?,
            Loss::InfoNce { .. } | Loss::MultiSimilarity => {
                let miner = PairMiner {
                    model: self.model,
                    set: self.set,
                    config: self.config,
                    progress: self.progress,
                };
                miner.batches(usable, range.clone())?
            }
        };
        let count = range.end - range.start;
        let mut total = 0.0;
        let started = Instant::now();
        for (step, samples) in range.zip(&batches) {
            let loss = self.step(samples, adam, step)?;
            total += loss;
            self.steps.set_note(format!("loss {loss:.4}"));
            self.steps.set_done(step + 1);
        }
        Ok(Steps {
            loss: total / count as f32,
            seconds: started.elapsed().as_secs_f64() / count as f64,
        })
    }

    /// The images of the triplets of every step: all queries, then their positives, then their
    /// negatives.
    fn triplets(
        &self,
        usable: &[usize],
        range: Range<u64>,
    ) -> Result<Vec<Vec<Sample>>, TrainError> {
        let pool = draw_pool(
            self.set.database.len(),
            self.config.mining_pool,
            self.config.seed ^ range.start.rotate_left(32),
        );
        let draws = self.draw(usable, &pool, range)?;
        let mined = self.mine(&draws, &pool)?;
        draws
            .iter()
            .map(|draws| self.batch(draws, &mined))
            .collect()
    }

    /// The triplets of every step of `range`, drawn at random from the queries that have a negative
    /// in `pool`. What a step draws follows from the seed and its number.
    pub(super) fn draw(
        &self,
        usable: &[usize],
        pool: &[u32],
        range: Range<u64>,
    ) -> Result<Vec<Vec<Draw>>, TrainError> {
        let has_negative = |query: usize| {
            let near = &self.set.near[query];
            pool.iter().any(|index| near.binary_search(index).is_err())
        };
        let askable: Vec<u32> = usable
            .iter()
            .filter(|&&query| has_negative(query))
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

    /// Embeds all that the triplets of `draws` may need, and finds the hardest negatives.
    fn mine(&self, draws: &[Vec<Draw>], pool: &[u32]) -> Result<Mined, TrainError> {
        let asked: BTreeSet<u32> = draws.iter().flatten().map(|draw| draw.query).collect();
        let asked: Vec<u32> = asked.into_iter().collect();
        let positives = asked
            .iter()
            .flat_map(|&query| &self.set.positives[query as usize]);
        let queries = asked.iter().map(|&query| (Side::Query, query));
        let database = positives.chain(pool).map(|&index| (Side::Database, index));
        let embeddings = embed(
            self.model,
            self.set,
            queries.chain(database),
            "mining",
            self.progress,
        )?;
        let count = self.config.negatives;
        let negatives = hardest_negatives(self.set, &asked, &embeddings, count, pool)?;
        Ok(Mined {
            embeddings,
            negatives,
        })
    }

    /// Chooses the other two images of each triplet: of the query's positives the one that looks
    /// most like it now, because a positive may have been taken in another direction; and one of
    /// its hard negatives at random.
    fn batch(&self, draws: &[Draw], mined: &Mined) -> Result<Vec<Sample>, TrainError> {
        let mut queries = Vec::new();
        let mut positives = Vec::new();
        let mut negatives = Vec::new();
        for draw in draws {
            let (Some(positive), Some(negative)) = (
                self.nearest_positive(draw.query, &mined.embeddings)?,
                chosen_negative(draw, mined),
            ) else {
                return Err(TrainError::NoTriplets(format!(
                    "query {} lost its positives or negatives",
                    draw.query
                )));
            };
            let [of_query, of_positive, of_negative] = draw.variations;
            queries.push(self.sample(Side::Query, draw.query, of_query));
            positives.push(self.sample(Side::Database, positive, of_positive));
            negatives.push(self.sample(Side::Database, negative, of_negative));
        }
        Ok([queries, positives, negatives].concat())
    }

    fn nearest_positive(
        &self,
        query: u32,
        embeddings: &Embeddings,
    ) -> Result<Option<u32>, TrainError> {
        let descriptor = embeddings.of(Side::Query, query)?;
        let positives = embeddings.of_database(&self.set.positives[query as usize])?;
        let nearest = positives.iter().min_by(|a, b| {
            let of_a = squared_distance(descriptor, a.1);
            let of_b = squared_distance(descriptor, b.1);
            of_a.total_cmp(&of_b)
        });
        Ok(nearest.map(|&(index, _)| index))
    }

    fn sample(&self, side: Side, index: u32, seed: u64) -> Sample {
        let is_varied = self.config.augmentation.enabled();
        Sample {
            side,
            index: index as usize,
            variation: is_varied.then_some(seed),
        }
    }

    /// Takes one step of the optimiser; returns the loss before it.
    fn step(&self, samples: &[Sample], adam: &mut Adam, step: u64) -> Result<f32, TrainError> {
        let config = self.config;
        let loss = self.loss_of(samples)?;
        let at_once = config.images_at_once.unwrap_or(samples.len());
        let (value, mut gradients) =
            gradients(self.model, self.set, samples, at_once, loss.as_ref())?;
        if !value.is_finite() {
            return Err(TrainError::Diverged { step, loss: value });
        }
        if let Some(longest) = config.longest_gradient {
            gradients.clip(longest)?;
        }
        adam.step(&gradients, |group| config.rate(group, step))?;
        Ok(value)
    }

    /// The loss as a function of the descriptors of `samples`.
    fn loss_of(&self, samples: &[Sample]) -> Result<Box<LossOf<'static>>, TrainError> {
        let pairs = || {
            let images: Vec<(Side, u32)> = samples
                .iter()
                .map(|sample| (sample.side, sample.index as u32))
                .collect();
            Pairs::of(&self.set.spots, &images)
        };
        Ok(match self.config.loss {
            Loss::Triplet { margin } => {
                let count = samples.len() / 3;
                Box::new(move |descriptors| {
                    let role = |index: usize| descriptors.narrow(0, index * count, count);
                    triplet_margin_loss(&role(0)?, &role(1)?, &role(2)?, margin)
                })
            }
            Loss::InfoNce { temperature } => {
                let pairs = pairs()?;
                Box::new(move |descriptors| info_nce(descriptors, &pairs, temperature))
            }
            Loss::MultiSimilarity => {
                let pairs = pairs()?;
                Box::new(move |descriptors| multi_similarity(descriptors, &pairs))
            }
        })
    }
}

fn chosen_negative(draw: &Draw, mined: &Mined) -> Option<u32> {
    let hard = mined.negatives.get(&draw.query)?;
    if hard.is_empty() {
        return None;
    }
    let choice = draw.choice % hard.len() as u64;
    Some(hard[choice as usize])
}

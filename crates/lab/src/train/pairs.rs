//! Batches for losses that compare all images of a batch: pairs of a query and a positive.
//!
//! Half of the pairs are drawn at random. To each of them come others that look like it although
//! they show another place, found among the queries by their present descriptors: random places
//! are soon told apart, and teach nothing from then on.

use super::config::TrainConfig;
use super::embed::{Embeddings, embed};
use super::error::TrainError;
use super::mining::draw_pool;
use super::model::{Sample, TripletModel};
use super::spots::Relation;
use super::triplets::{Side, TripletSet};
use placeformer_core::progress::Progress;
use placeformer_vision::extract::squared_distance;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::ops::Range;

/// Draws the pairs of the steps of a cycle.
pub(super) struct PairMiner<'a> {
    pub(super) model: &'a dyn TripletModel,
    pub(super) set: &'a TripletSet,
    pub(super) config: &'a TrainConfig,
    pub(super) progress: &'a dyn Progress,
}

/// The queries that look like a query and show another place, most alike first.
type Alike = HashMap<u32, Vec<u32>>;

impl PairMiner<'_> {
    /// The images of every step of `range`. What a step draws follows from the seed, its number and
    /// the weights that the cycle begins with.
    pub(super) fn batches(
        &self,
        usable: &[usize],
        range: Range<u64>,
    ) -> Result<Vec<Vec<Sample>>, TrainError> {
        let usable: Vec<u32> = usable.iter().map(|&query| query as u32).collect();
        if usable.is_empty() {
            let reason = "no query has both a positive and a negative";
            return Err(TrainError::NoTriplets(reason.into()));
        }
        let drawn: Vec<Vec<u32>> = range
            .clone()
            .map(|step| self.anchors(&usable, step))
            .collect();
        let alike = self.mine(&usable, &drawn, range.start)?;
        let steps = range.zip(&drawn);
        Ok(steps
            .map(|(step, anchors)| self.batch(anchors, &alike, step))
            .collect())
    }

    /// Queries drawn at random for a step, each of which brings `hard_pairs` more.
    fn anchors(&self, usable: &[u32], step: u64) -> Vec<u32> {
        let count = self.config.batch.div_ceil(1 + self.config.hard_pairs);
        let mut rng = self.random(step, 0);
        (0..count)
            .map(|_| usable[rng.random_range(0..usable.len())])
            .collect()
    }

    fn random(&self, step: u64, part: u64) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        rng.set_stream(2 * (step + 1) + part);
        rng
    }

    /// For every drawn query the most similar queries of other places among those usable.
    fn mine(
        &self,
        usable: &[u32],
        drawn: &[Vec<u32>],
        first_step: u64,
    ) -> Result<Alike, TrainError> {
        if self.config.hard_pairs == 0 {
            return Ok(Alike::new());
        }
        let seed = self.config.seed ^ first_step.rotate_left(32);
        let pool: Vec<u32> = draw_pool(usable.len(), self.config.mining_pool, seed)
            .into_iter()
            .map(|index| usable[index as usize])
            .collect();
        let asked: BTreeSet<u32> = drawn.iter().flatten().copied().collect();
        let images = asked.iter().chain(&pool).map(|&query| (Side::Query, query));
        let embeddings = embed(self.model, self.set, images, "mining", self.progress)?;
        let asked: Vec<u32> = asked.into_iter().collect();
        asked
            .par_iter()
            .map(|&query| Ok((query, self.most_alike(query, &pool, &embeddings)?)))
            .collect()
    }

    fn most_alike(
        &self,
        query: u32,
        pool: &[u32],
        embeddings: &Embeddings,
    ) -> Result<Vec<u32>, TrainError> {
        let descriptor = embeddings.of(Side::Query, query)?;
        let mut scored = Vec::new();
        for &other in pool {
            let relation = self
                .set
                .spots
                .relation((Side::Query, query), (Side::Query, other));
            if relation == Relation::Negative {
                let distance = squared_distance(descriptor, embeddings.of(Side::Query, other)?);
                scored.push((distance, other));
            }
        }
        scored.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        scored.truncate(self.config.negatives);
        Ok(scored.into_iter().map(|(_, other)| other).collect())
    }

    /// Every anchor and its hard pairs, each with a positive drawn at random; every file once.
    fn batch(&self, anchors: &[u32], alike: &Alike, step: u64) -> Vec<Sample> {
        let mut rng = self.random(step, 1);
        let mut images = Vec::new();
        for &anchor in anchors {
            self.add_pair(anchor, &mut rng, &mut images);
            let Some(alike) = alike.get(&anchor).filter(|alike| !alike.is_empty()) else {
                continue;
            };
            for _ in 0..self.config.hard_pairs {
                let hard = alike[rng.random_range(0..alike.len())];
                self.add_pair(hard, &mut rng, &mut images);
            }
        }
        let mut seen = HashSet::new();
        images.retain(|&(side, index)| seen.insert(&self.set.images(side)[index as usize]));
        let is_varied = self.config.augmentation.enabled();
        images
            .into_iter()
            .map(|(side, index)| Sample {
                side,
                index: index as usize,
                variation: is_varied.then(|| rng.next_u64()),
            })
            .collect()
    }

    /// Adds a query and one of its positives, which every usable query has.
    fn add_pair(&self, query: u32, rng: &mut ChaCha8Rng, images: &mut Vec<(Side, u32)>) {
        let positives = &self.set.positives[query as usize];
        if let Some(last) = positives.len().checked_sub(1) {
            images.push((Side::Query, query));
            images.push((Side::Database, positives[rng.random_range(0..=last)]));
        }
    }
}

#[cfg(test)]
mod tests;

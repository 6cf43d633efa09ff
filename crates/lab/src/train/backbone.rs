//! Training the transformer itself, wholly or its last blocks, together with the head and its
//! aggregate.
//!
//! Layers that are not trained are plain tensors, so that no graph is recorded through them. The
//! blocks before the first trained one need not be computed at all where their tokens are cached
//! (`token_cache`).

use super::augment::{Augmentation, augment};
use super::averaged::Averaged;
use super::config::{Finish, TrainConfig};
use super::error::TrainError;
use super::model::{Graph, Group, Sample, TripletModel, Variable};
use super::pooling::{self, Pooling};
use super::token_cache::TokenCache;
use super::trainer::{Outcome, Session, run};
use super::transformer::{MATRICES, Pass, Transformer};
use super::triplets::TripletSet;
use super::weights::{DOWN, UP, Weights};
use candle_core::Tensor;
use placeformer_core::progress::Progress;
use placeformer_core::types::ImageTensor;
use placeformer_vision::extract::{Difference, EncoderSpec, Factors, Head, VitWeights};
use placeformer_vision::image::{ImageConfig, load_tensor};
use rayon::prelude::*;
use std::collections::BTreeMap;

type Result<T> = std::result::Result<T, TrainError>;

/// Images that are embedded together outside of a graph, on each thread.
pub(super) const EMBED_BATCH: usize = 8;

/// Which weights move besides the head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainableBlocks {
    /// The last `n` of the computed blocks, and the final norm where it is used.
    Last(usize),
    /// Everything: patch embedding, positions and CLS token too.
    All,
}

impl TrainableBlocks {
    /// The first trained block of `computed` ones; 0 also where what comes before it is trained.
    ///
    /// # Errors
    /// More blocks than are computed, or none.
    pub fn first_of(self, computed: usize) -> Result<usize> {
        match self {
            Self::Last(count) if (1..=computed).contains(&count) => Ok(computed - count),
            Self::Last(count) => Err(TrainError::Setting(format!(
                "{count} of {computed} computed blocks cannot be trained"
            ))),
            Self::All => Ok(0),
        }
    }
}

/// What moves, and how.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trainable {
    /// Which blocks.
    pub blocks: TrainableBlocks,
    /// Rank of the adapters that are trained in the place of the blocks' matrices; all else of the
    /// blocks stays then. `None` trains the blocks themselves.
    pub rank: Option<usize>,
    /// Decides how adapters start.
    pub seed: u64,
}

/// Where the tokens before the first trained block come from.
pub enum TokenSource {
    /// Every image passes the whole transformer at every step, varied anew each time.
    Images {
        /// Limits on images.
        limits: ImageConfig,
        /// How they vary.
        augmentation: Augmentation,
    },
    /// From a cache that holds every image of the sets.
    Cached(Box<TokenCache>),
}

/// A differentiable transformer with its head.
pub struct BackboneModel {
    base: VitWeights,
    spec: EncoderSpec,
    transformer: Transformer,
    pub(super) pooling: Pooling,
    pub(super) weights: Weights,
    /// The trained weights before the first step.
    pub(super) start: BTreeMap<String, Tensor>,
    /// First trained block; 0 where what comes before the blocks is trained too.
    first: usize,
    source: TokenSource,
    pub(super) finish: Finish,
}

impl BackboneModel {
    /// Starts from pre-trained weights and a head. `finish` says what is made of the trained
    /// weights.
    ///
    /// # Errors
    /// More blocks are to be trained than are computed, the head pools in a way that cannot be
    /// trained, or a tensor has another shape than the model.
    pub fn new(
        base: VitWeights,
        spec: EncoderSpec,
        head: &Head,
        trainable: Trainable,
        source: TokenSource,
        finish: Finish,
    ) -> Result<Self> {
        let blocks = spec.exit_block + 1;
        let first = trainable.blocks.first_of(blocks)?;
        let mut weights = Weights::default();
        for (number, (name, shape, values)) in base.tensors().into_iter().enumerate() {
            if block_of(&name).is_some_and(|block| block >= blocks) {
                continue;
            }
            let moves = is_trained(&name, trainable.blocks, first, spec.token_norm);
            match trainable.rank {
                None if moves => weights.train(&name, &shape, values)?,
                Some(rank) if moves && is_matrix(&name) => {
                    let seed = trainable.seed.wrapping_add(number as u64);
                    weights.adapt(&name, &shape, values, rank, seed)?;
                }
                _ => weights.fix(&name, &shape, values)?,
            }
        }
        let pooling = Pooling::of(head, &mut weights)?;
        Ok(Self {
            transformer: Transformer::new(&base, spec)?,
            start: weights.snapshot()?,
            base,
            spec,
            pooling,
            weights,
            first,
            source,
            finish,
        })
    }

    /// Trains in place; afterwards the weights are the best seen, before anything is made of them.
    ///
    /// # Errors
    /// A setting is out of range, the checkpoint is one of another run, an image cannot be read, or
    /// the loss is no longer finite.
    pub fn train(
        &self,
        training: &TripletSet,
        validation: &TripletSet,
        config: &TrainConfig,
        session: Session<'_>,
    ) -> Result<Outcome> {
        run(self, training, validation, config, session)
    }

    /// Number of values that training moves.
    pub fn trained_values(&self) -> usize {
        let variables = self.weights.variables().values();
        variables.map(|variable| variable.elem_count()).sum()
    }

    /// The backbone that comes out: what was trained, averaged with the start.
    ///
    /// # Errors
    /// The tensor library fails.
    pub fn backbone(&self) -> Result<VitWeights> {
        let averaged = self.weights.averaged(&self.start, self.finish.average)?;
        let mut trained = self.base.clone();
        for (name, _, _) in self.base.tensors() {
            if averaged.moves(&name) && !trained.replace(&name, &averaged.values(&name)?) {
                return Err(TrainError::Tensor(format!(
                    "the backbone has no tensor {name} of this shape"
                )));
            }
        }
        Ok(trained)
    }

    /// The backbone that comes out as a difference to `stock`, which is what training started from
    /// or what that was made of.
    ///
    /// # Errors
    /// Nothing was learnt, or `stock` has other tensors.
    pub fn difference(
        &self,
        stock: &VitWeights,
        notes: BTreeMap<String, String>,
    ) -> Result<Difference> {
        let averaged = self.weights.averaged(&self.start, self.finish.average)?;
        let mut factors = BTreeMap::new();
        for (name, up) in averaged.variables() {
            let Some(target) = name.strip_suffix(UP) else {
                continue;
            };
            let rank = up.dim(1)?;
            let up = averaged.values(name)?;
            let down = averaged.values(&format!("{target}{DOWN}"))?;
            factors.insert(target.to_owned(), Factors { rank, up, down });
        }
        if factors.is_empty() || stock.content_hash() != self.base.content_hash() {
            return Ok(Difference::between(stock, &self.backbone()?, notes)?);
        }
        Ok(Difference::of_factors(stock, factors, notes)?)
    }

    /// The head that comes out for `backbone`: averaged with the start like it, and not fitted
    /// again.
    ///
    /// # Errors
    /// Its values can no longer be computed with.
    pub fn head(&self, backbone: String, notes: BTreeMap<String, String>) -> Result<Head> {
        let averaged = self.weights.averaged(&self.start, self.finish.average)?;
        self.pooling.head(&averaged, backbone, notes)
    }

    /// Patch tokens of the exit block, `[batch, n, dim]`.
    fn tokens(&self, pass: Pass<'_>, images: &[ImageTensor]) -> Result<Tensor> {
        let embedded = self.transformer.embed_patches(pass, images)?;
        self.transformer.run(pass, embedded, 0)
    }

    /// Pooled tokens of unit length, `[samples, pooled]`, under the weights of `pass`.
    pub(super) fn pooled(
        &self,
        pass: Pass<'_>,
        set: &TripletSet,
        samples: &[Sample],
    ) -> Result<Tensor> {
        let tokens = match &self.source {
            TokenSource::Cached(cache) => {
                let before = cache.tokens(set, samples)?;
                self.transformer.run(pass, before, self.first)?
            }
            TokenSource::Images {
                limits,
                augmentation,
            } => {
                let images: Vec<ImageTensor> = samples
                    .par_iter()
                    .map(|sample| self.load(set, sample, limits, augmentation))
                    .collect::<Result<_>>()?;
                self.tokens(pass, &images)?
            }
        };
        self.pooling.pool(pass, &tokens)
    }

    /// Descriptors of unit length, `[samples, 256]`, under the weights of `pass`.
    pub(super) fn described(
        &self,
        pass: Pass<'_>,
        set: &TripletSet,
        samples: &[Sample],
    ) -> Result<Tensor> {
        pooling::project(pass, &self.pooled(pass, set, samples)?)
    }

    fn load(
        &self,
        set: &TripletSet,
        sample: &Sample,
        limits: &ImageConfig,
        augmentation: &Augmentation,
    ) -> Result<ImageTensor> {
        let path = &set.images(sample.side)[sample.index];
        let bytes = std::fs::read(path).map_err(|source| TrainError::Io {
            path: path.clone(),
            source,
        })?;
        let image = load_tensor(&bytes, limits, self.spec.input_size)
            .map_err(|error| TrainError::Setting(format!("{}: {error}", path.display())))?;
        Ok(match sample.variation {
            Some(seed) => augment(&image, augmentation, seed),
            None => image,
        })
    }
}

impl TripletModel for BackboneModel {
    fn variables(&self) -> Vec<Variable> {
        let variable = |(name, variable): (&String, &candle_core::Var)| Variable {
            name: name.clone(),
            variable: variable.clone(),
            group: group_of(name),
        };
        self.weights.variables().iter().map(variable).collect()
    }

    fn embed(&self, set: &TripletSet, samples: &[Sample], graph: Graph) -> Result<Tensor> {
        let pass = Pass {
            weights: &self.weights,
            graph,
        };
        self.described(pass, set, samples)
    }

    fn embed_batch(&self) -> usize {
        EMBED_BATCH
    }

    fn outcome(
        &self,
        training: &TripletSet,
        progress: &dyn Progress,
    ) -> Result<Option<Box<dyn TripletModel + '_>>> {
        if !self.finish.changes() {
            return Ok(None);
        }
        let averaged = Averaged::of(self)?;
        if let Some(power) = self.finish.whitening {
            averaged.fit(training, power, progress)?;
        }
        Ok(Some(Box::new(averaged)))
    }
}

fn block_of(name: &str) -> Option<usize> {
    name.strip_prefix("blocks.")?
        .split('.')
        .next()?
        .parse()
        .ok()
}

fn is_trained(name: &str, blocks: TrainableBlocks, first: usize, token_norm: bool) -> bool {
    match (blocks, block_of(name)) {
        (_, None) if name.starts_with("norm.") => token_norm,
        (TrainableBlocks::Last(_), block) => block.is_some_and(|block| block >= first),
        (TrainableBlocks::All, _) => true,
    }
}

/// Whether an adapter can be added to the tensor.
fn is_matrix(name: &str) -> bool {
    let layer = name.strip_suffix(".weight");
    layer.is_some_and(|layer| MATRICES.iter().any(|matrix| layer.ends_with(matrix)))
}

fn group_of(name: &str) -> Group {
    match name {
        pooling::WEIGHT | pooling::BIAS => Group::Projection,
        name if name.starts_with(pooling::AGGREGATE) => Group::Aggregate,
        _ => Group::Blocks,
    }
}

#[cfg(test)]
mod tests;

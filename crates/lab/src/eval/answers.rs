//! The answers to all queries of a data set, as the service would give them.

use super::error::EvalError;
use super::features::{Describe, FeatureCache, Features, GlobalKind};
use super::own_places::OwnPlaces;
use super::run::{Answer, QuerySeconds, rerank_all, search_all};
use crate::datasets::Dataset;
use placeformer_core::progress::{Progress, Task};
use placeformer_vision::rerank::{PairScore, Ranking, RerankConfig, Reranker};

/// Both sides of a data set, described.
pub struct DescribedDataset {
    cache: FeatureCache,
    /// Descriptors of the database.
    pub database: Features,
    /// Descriptors of the queries.
    pub queries: Features,
}

/// The answers to a data set.
#[derive(Debug, Clone, Default)]
pub struct DatasetAnswers {
    /// To the data set as it is.
    pub answers: Vec<Answer>,
    /// To the same queries with their own place left out of the database, if they were asked so
    /// too: none of these can be right.
    pub left_out: Vec<Answer>,
    /// Mean seconds per query.
    pub seconds: QuerySeconds,
}

impl DatasetAnswers {
    /// Orders all re-ranked candidates anew.
    pub fn order_by(&mut self, ranking: &Ranking<'_>) {
        for answer in self.answers.iter_mut().chain(&mut self.left_out) {
            answer.order_by(ranking);
        }
    }

    /// The answers to these queries, of which the numbers are given in ascending order.
    pub fn only(&self, queries: &[usize]) -> Self {
        let is_wanted = |answer: &&Answer| queries.binary_search(&answer.query).is_ok();
        let kept = |answers: &[Answer]| answers.iter().filter(is_wanted).cloned().collect();
        Self {
            answers: kept(&self.answers),
            left_out: kept(&self.left_out),
            seconds: self.seconds,
        }
    }
}

impl DescribedDataset {
    /// Describes every image of `dataset`, taking from `cache` what it holds.
    ///
    /// # Errors
    /// The model fails, or the cache cannot be read or written.
    pub fn new(
        describer: &dyn Describe,
        cache: FeatureCache,
        dataset: &Dataset,
        global: GlobalKind,
        progress: &dyn Progress,
    ) -> Result<Self, EvalError> {
        let images = dataset.database.len() + dataset.queries.len();
        let task = Task::begin(progress, "describing", images as u64);
        let describe = |items, side| cache.describe_all(describer, items, side, global, &task);
        let database = describe(&dataset.database, "database")?;
        let queries = describe(&dataset.queries, "query")?;
        Ok(Self {
            cache,
            database,
            queries,
        })
    }

    /// Images that were described now; the others were cached or cannot be read.
    pub fn fresh(&self) -> usize {
        self.database.fresh + self.queries.fresh
    }

    /// Answers every query as the service would, from `candidates` candidates, ordered by S; where
    /// `own` says so a second time without its own place. Nothing is re-ranked without a
    /// configuration.
    ///
    /// # Errors
    /// Key patches cannot be read from the cache.
    pub fn answer(
        &self,
        dataset: &Dataset,
        own: Option<&OwnPlaces>,
        candidates: usize,
        rerank: Option<&RerankConfig>,
        progress: &dyn Progress,
    ) -> Result<DatasetAnswers, EvalError> {
        let wanted = |query| match own {
            Some(own) => own.widened(query, candidates),
            None => candidates,
        };
        let (mut answers, search_seconds) = search_all(&self.database, &self.queries, wanted);
        if let Some(own) = own {
            for answer in &mut answers {
                own.trim(answer, candidates);
            }
        }

        let mut seconds = QuerySeconds::default();
        if let Some(config) = rerank {
            (answers, seconds) = self.rerank(answers, config, progress)?;
        }
        seconds.search = search_seconds;

        let mut left_out = Vec::new();
        if let Some(own) = own {
            (answers, left_out) = own.part_all(dataset, &answers, candidates);
        }
        Ok(DatasetAnswers {
            answers,
            left_out,
            seconds,
        })
    }

    /// Compares a query with references that its search did not find, each alone: their indices,
    /// global distances and, with a configuration of re-ranking, scores. Images that cannot be read
    /// are left out.
    ///
    /// # Errors
    /// Key patches cannot be read from the cache.
    pub fn compare(
        &self,
        query: usize,
        references: &[usize],
        rerank: Option<&RerankConfig>,
    ) -> Result<Vec<(usize, f32, Option<PairScore>)>, EvalError> {
        let Some(global) = self.queries.global(query) else {
            return Ok(Vec::new());
        };
        let mut compared = Vec::with_capacity(references.len());
        for &index in references {
            let Some(other) = self.database.global(index) else {
                continue;
            };
            let squares = global.iter().zip(other).map(|(a, b)| (a - b) * (a - b));
            let distance = squares.sum::<f32>().sqrt();
            let score = match rerank {
                Some(config) => Some(self.score(query, index, config)?),
                None => None,
            };
            compared.push((index, distance, score));
        }
        Ok(compared)
    }

    fn score(
        &self,
        query: usize,
        reference: usize,
        config: &RerankConfig,
    ) -> Result<PairScore, EvalError> {
        let query = self.cache.patches(&self.queries, query)?;
        let reference = self.cache.patches(&self.database, reference)?;
        Ok(Reranker::new(config.clone()).score(&query, &reference))
    }

    fn rerank(
        &self,
        answers: Vec<Answer>,
        config: &RerankConfig,
        progress: &dyn Progress,
    ) -> Result<(Vec<Answer>, QuerySeconds), EvalError> {
        let task = Task::begin(progress, "re-ranking", answers.len() as u64);
        let patches = |features: &Features, index| self.cache.patches(features, index);
        rerank_all(
            &patches,
            &self.database,
            &self.queries,
            answers,
            config,
            &task,
        )
    }
}

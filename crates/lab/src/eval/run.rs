//! Search and re-ranking of every query, as the service does them, with the time each stage takes.

use super::error::EvalError;
use super::features::Features;
use placeformer_core::progress::Task;
use placeformer_core::types::{GLOBAL_DIM, PackedPatches, ReferenceFilter, ReferenceId};
use placeformer_vision::rerank::{
    Evidence, PairScore, Ranked, Ranking, RerankConfig, Reranked, Reranker,
};
use placeformer_vision::search::{IndexEntry, MapIndex};
use rayon::prelude::*;
use serde::Serialize;
use std::sync::Arc;
use std::time::Instant;

/// A database image with its distance to the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// Index into the database.
    pub index: usize,
    /// Euclidean distance of the global vectors.
    pub distance: f32,
}

/// A candidate after re-ranking.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Index into the database.
    pub index: usize,
    /// Euclidean distance of the global vectors.
    pub distance: f32,
    /// What the key patches say.
    pub score: PairScore,
    /// What the candidates are ordered by; S until [`Answer::order_by`] says otherwise.
    pub value: f64,
}

impl Candidate {
    /// A candidate to be ordered by S.
    pub fn by_inliers(neighbour: Neighbour, score: PairScore) -> Self {
        Self {
            index: neighbour.index,
            distance: neighbour.distance,
            value: f64::from(score.spatial_score),
            score,
        }
    }
}

/// The answer to one query.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// Index into the queries.
    pub query: usize,
    /// By global distance, nearest first.
    pub global: Vec<Neighbour>,
    /// By their value; empty if nothing was re-ranked.
    pub reranked: Vec<Candidate>,
}

impl Answer {
    /// Database indices by global distance.
    pub fn global_ranking(&self) -> Vec<usize> {
        self.global
            .iter()
            .map(|neighbour| neighbour.index)
            .collect()
    }

    /// Orders the re-ranked candidates anew; equal ones by distance.
    pub fn order_by(&mut self, ranking: &Ranking<'_>) {
        let mut candidates = std::mem::take(&mut self.reranked);
        candidates.sort_by(|a, b| {
            let by_distance = a.distance.total_cmp(&b.distance);
            by_distance.then(a.index.cmp(&b.index))
        });
        let ordered = ranking.order(candidates, |candidate| Evidence {
            score: &candidate.score,
            distance: candidate.distance,
        });
        let with_value = |(value, candidate)| Candidate { value, ..candidate };
        self.reranked = ordered.into_iter().map(with_value).collect();
    }

    /// Database indices in the order of re-ranking.
    pub fn reranked_ranking(&self) -> Vec<usize> {
        self.reranked
            .iter()
            .map(|candidate| candidate.index)
            .collect()
    }
}

/// Mean seconds per query.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct QuerySeconds {
    /// Finding the candidates.
    pub search: f64,
    /// Loading their key patches.
    pub load: f64,
    /// Matching and verifying them.
    pub rerank: f64,
}

/// The nearest database images of every readable query, as many as `candidates` says for it; the
/// second value is the mean seconds per query.
pub fn search_all(
    database: &Features,
    queries: &Features,
    candidates: impl Fn(usize) -> usize,
) -> (Vec<Answer>, f64) {
    let searcher = Searcher::new(database);
    let start = Instant::now();
    let answer = |query: usize| {
        let global = searcher.search(queries.global(query)?, candidates(query));
        Some(Answer {
            query,
            global,
            reranked: Vec::new(),
        })
    };
    let answers: Vec<Answer> = (0..queries.len()).filter_map(answer).collect();
    let seconds = start.elapsed().as_secs_f64() / answers.len().max(1) as f64;
    (answers, seconds)
}

/// Where key patches come from: the cache as it is, or what an ablation makes of it.
pub type LoadPatches<'a> =
    dyn Fn(&Features, usize) -> Result<Arc<PackedPatches>, EvalError> + Sync + 'a;

/// Re-ranks the candidates of every answer; the second value is the mean seconds per query (load,
/// rerank).
///
/// # Errors
/// Key patches cannot be loaded.
pub fn rerank_all(
    patches: &LoadPatches<'_>,
    database: &Features,
    queries: &Features,
    mut answers: Vec<Answer>,
    config: &RerankConfig,
    task: &Task<'_>,
) -> Result<(Vec<Answer>, QuerySeconds), EvalError> {
    let reranker = Reranker::new(config.clone());
    let mut seconds = QuerySeconds::default();
    for answer in &mut answers {
        let start = Instant::now();
        let query = patches(queries, answer.query)?;
        let load = |neighbour: &Neighbour| patches(database, neighbour.index);
        let candidates = answer.global.par_iter().map(load);
        let candidates: Vec<Arc<PackedPatches>> = candidates.collect::<Result<_, _>>()?;
        seconds.load += start.elapsed().as_secs_f64();

        let start = Instant::now();
        let ranked = rerank(&reranker, &query, &candidates)?;
        seconds.rerank += start.elapsed().as_secs_f64();

        answer.reranked = ranked
            .into_iter()
            .map(|ranked| Candidate::by_inliers(answer.global[ranked.candidate], ranked.score))
            .collect();
        task.add(1);
    }
    let count = answers.len().max(1) as f64;
    seconds.load /= count;
    seconds.rerank /= count;
    Ok((answers, seconds))
}

/// Ranks candidates that are all in memory, with all the time that it takes.
fn rerank(
    reranker: &Reranker,
    query: &PackedPatches,
    candidates: &[Arc<PackedPatches>],
) -> Result<Vec<Ranked>, EvalError> {
    let load = |i: usize| Ok::<_, EvalError>(candidates[i].clone());
    match reranker.rerank(query, candidates.len(), load, None) {
        Reranked::Complete { ranked, mut failed } => match failed.pop() {
            Some((_, error)) => Err(error),
            None => Ok(ranked),
        },
        Reranked::DeadlinePassed => Err(EvalError::Setting(
            "re-ranking stopped at a deadline though none was set".into(),
        )),
    }
}

/// Exact search over global vectors: the service's index at its length, else a plain scan.
enum Searcher<'f> {
    Index(Box<MapIndex>),
    Scan(&'f Features),
}

impl<'f> Searcher<'f> {
    fn new(database: &'f Features) -> Self {
        if database.dim != GLOBAL_DIM {
            return Self::Scan(database);
        }
        let entry = |index: usize| {
            let global = database.global(index)?.to_vec();
            Some(IndexEntry {
                id: id_of(index),
                global,
                location: None,
                alt: None,
                heading: None,
                captured_at: None,
            })
        };
        let entries = (0..database.len()).filter_map(entry).collect();
        Self::Index(Box::new(MapIndex::build(entries)))
    }

    fn search(&self, query: &[f32], k: usize) -> Vec<Neighbour> {
        match self {
            Self::Index(index) => {
                let found = index.search(query, k, &ReferenceFilter::default());
                found
                    .into_iter()
                    .map(|n| Neighbour {
                        index: index_of(n.id),
                        distance: n.distance,
                    })
                    .collect()
            }
            Self::Scan(database) => scan(database, query, k),
        }
    }
}

/// An identifier that sorts like the index it stands for.
fn id_of(index: usize) -> ReferenceId {
    ReferenceId::from_bytes((index as u128).to_be_bytes())
}

fn index_of(id: ReferenceId) -> usize {
    u128::from_be_bytes(*id.as_bytes()) as usize
}

fn scan(database: &Features, query: &[f32], k: usize) -> Vec<Neighbour> {
    let distance = |index: usize| {
        let vector = database.global(index)?;
        let squared: f32 = vector
            .iter()
            .zip(query)
            .map(|(a, b)| (a - b) * (a - b))
            .sum();
        Some(Neighbour {
            index,
            distance: squared.sqrt(),
        })
    };
    let mut all: Vec<Neighbour> = (0..database.len())
        .into_par_iter()
        .filter_map(distance)
        .collect();
    let order = |a: &Neighbour, b: &Neighbour| {
        a.distance
            .total_cmp(&b.distance)
            .then(a.index.cmp(&b.index))
    };
    if k < all.len() {
        all.select_nth_unstable_by(k, order);
        all.truncate(k);
    }
    all.sort_unstable_by(order);
    all
}

//! A photo to ranked places: global search, then re-ranking of the candidates (paper III-A, III-D,
//! III-E).

use super::blocking::blocking;
use super::extraction::Purpose;
use super::maps::LiveMap;
use super::{PipelineError, Service, Timings, Verdict};
use crate::ops::Stage;
use crate::ops::metrics::Rejection;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    Deadline, Descriptor, MapName, ModelId, Reference, ReferenceFilter, ReferenceId,
};
use placeformer_store::StoreError;
use placeformer_vision::rerank::{PairScore, Reranked};
use placeformer_vision::search::Neighbour;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// How to answer a query. Absent values take the configured default.
#[derive(Debug, Clone, Default)]
pub struct QueryOptions {
    /// Results wanted.
    pub top_k: Option<usize>,
    /// Nearest neighbours that are re-ranked.
    pub candidates: Option<usize>,
    /// False: the global ranking is the answer.
    pub rerank: Option<bool>,
    /// Which references may be answered.
    pub filter: ReferenceFilter,
    /// When the answer must be ready.
    pub deadline: Option<Deadline>,
}

/// A photo and the map it is looked for in.
#[derive(Debug, Clone)]
pub struct QueryRequest {
    /// The map.
    pub map: MapName,
    /// The photo, as it was sent.
    pub image: Bytes,
    /// How to answer.
    pub options: QueryOptions,
}

/// One place found.
#[derive(Debug, Clone, PartialEq)]
pub struct QueryResult {
    /// The reference that shows it.
    pub reference: Reference,
    /// Euclidean distance between the global descriptors.
    pub global_distance: f32,
    /// Outcome of re-ranking; absent if this result was not re-ranked.
    pub score: Option<PairScore>,
}

/// The ranked places.
#[derive(Debug, Clone)]
pub struct QueryAnswer {
    /// Best first.
    pub results: Vec<QueryResult>,
    /// Whether the order comes from re-ranking.
    pub reranked: bool,
    /// How far the first result can be trusted.
    pub verdict: Verdict,
    /// Where the time went.
    pub timings: Timings,
    /// What computed it.
    pub model: ModelId,
}

/// A candidate on its way to becoming a result.
struct Placed {
    neighbour: Neighbour,
    score: Option<PairScore>,
}

struct Plan {
    name: MapName,
    map: Arc<LiveMap>,
    top_k: usize,
    candidates: usize,
    rerank: bool,
    filter: ReferenceFilter,
    deadline: Deadline,
}

impl Service {
    /// Answers which places of a map a photo may show.
    ///
    /// Cancel safety: dropped while waiting, nothing further is computed; what is being computed is
    /// finished in its place in the queue.
    pub async fn query(
        self: &Arc<Self>,
        request: QueryRequest,
    ) -> Result<QueryAnswer, PipelineError> {
        let outcome = self.answer(request).await;
        self.count_if_late(&outcome);
        outcome
    }

    pub(super) fn count_if_late<T>(&self, outcome: &Result<T, PipelineError>) {
        if let Err(PipelineError::DeadlineExceeded { .. }) = outcome {
            self.metrics.rejected(Rejection::Deadline);
        }
    }

    async fn answer(self: &Arc<Self>, request: QueryRequest) -> Result<QueryAnswer, PipelineError> {
        let plan = match self.plan(&request.map, request.options) {
            Err(PipelineError::MapNotFound(map)) => {
                return self
                    .in_turn(&self.store_reads, move |service| {
                        Err(service.why_no_map(&map))
                    })
                    .await;
            }
            plan => plan?,
        };
        let patience = plan.deadline.remaining().min(self.patience());
        let purpose = Purpose::Answer(plan.deadline);
        purpose.not_passed("decoding")?;
        let ticket = Arc::new(self.queries.enter(patience)?);
        let mut timings = Timings::default();
        let descriptor = self
            .extraction
            .describe(request.image, purpose, &ticket, &mut timings)
            .await?;
        purpose.not_passed("search")?;
        let service = self.clone();
        let ranked = blocking(move || {
            let ranked = service.rank(&plan, &descriptor, timings);
            service.follow_damage();
            drop(ticket);
            ranked
        })
        .await;
        ranked.map_err(|_| PipelineError::Panicked { stage: "ranking" })?
    }

    fn plan(&self, map: &MapName, options: QueryOptions) -> Result<Plan, PipelineError> {
        let top_k = self
            .config
            .check_count("top_k", options.top_k.unwrap_or(self.config.top_k))?;
        let candidates = options.candidates.unwrap_or(self.config.candidates);
        Ok(Plan {
            name: map.clone(),
            map: self
                .maps
                .comparable(map, self.extraction.source().model_id())?,
            top_k,
            candidates: self.config.check_count("candidates", candidates)?,
            rerank: options.rerank.unwrap_or(true),
            filter: options.filter,
            deadline: options
                .deadline
                .unwrap_or_else(|| Deadline::after(Duration::from_millis(self.config.deadline_ms))),
        })
    }

    fn rank(
        &self,
        plan: &Plan,
        query: &Descriptor,
        mut timings: Timings,
    ) -> Result<QueryAnswer, PipelineError> {
        let started = Instant::now();
        let fetched = if plan.rerank {
            plan.candidates.max(plan.top_k)
        } else {
            plan.top_k
        };
        let neighbours = plan
            .map
            .index
            .search(&plan.map.global_of(query), fetched, &plan.filter);
        timings.record(&self.metrics, Stage::Search, started.elapsed());
        let reranked = if plan.rerank {
            self.rerank(plan, query, &neighbours, &mut timings)?
        } else {
            None
        };
        let was_reranked = reranked.is_some();
        let placed = reranked.unwrap_or_else(|| {
            neighbours
                .iter()
                .map(|&neighbour| Placed {
                    neighbour,
                    score: None,
                })
                .collect()
        });
        let results = self.with_metadata(plan, placed)?;
        let best = results.first();
        let verdict = self
            .trust
            .judge(&plan.map.model, plan.map.calibration().as_deref(), best);
        let top1 = best
            .and_then(|best| best.score.as_ref())
            .map_or(0, |score| score.spatial_score);
        self.metrics
            .query_answered(was_reranked.then_some(top1), verdict.matched);
        Ok(QueryAnswer {
            results,
            reranked: was_reranked,
            verdict,
            timings,
            model: plan.map.model.clone(),
        })
    }

    /// The candidates in their new order, followed by the neighbours beyond them; `None` if time
    /// ran out.
    fn rerank(
        &self,
        plan: &Plan,
        query: &Descriptor,
        neighbours: &[Neighbour],
        timings: &mut Timings,
    ) -> Result<Option<Vec<Placed>>, PipelineError> {
        let reserve = Duration::from_millis(self.config.answer_reserve_ms);
        let Some(time_left) = plan
            .deadline
            .remaining()
            .checked_sub(reserve)
            .filter(|left| !left.is_zero())
        else {
            return Ok(None);
        };
        let (candidates, beyond) = neighbours.split_at(neighbours.len().min(plan.candidates));
        let (started, loading_ns) = (Instant::now(), AtomicU64::new(0));
        // Loading runs on other threads, whose log lines belong to this request all the same.
        let span = tracing::Span::current();
        let load = |i: usize| {
            let begun = Instant::now();
            let loaded = span.in_scope(|| self.patches.load(&*self.store, candidates[i].id));
            loading_ns.fetch_add(begun.elapsed().as_nanos() as u64, Ordering::Relaxed);
            loaded
        };
        let outcome = self.reranker.rerank(
            &query.patches,
            candidates.len(),
            load,
            Some(Deadline::after(time_left)),
        );
        self.record_rerank(started.elapsed(), loading_ns.into_inner(), timings);
        let Reranked::Complete { ranked, failed } = outcome else {
            return Ok(None);
        };
        for (i, error) in failed {
            match error.code() {
                // Deleted since the search, or damaged: the others are answered.
                ErrorCode::ReferenceNotFound | ErrorCode::CorruptRecord => {
                    self.withdraw(plan, candidates[i].id)
                }
                _ => return Err(error.into()),
            }
        }
        let scored = ranked.into_iter().map(|ranked| Placed {
            neighbour: candidates[ranked.candidate],
            score: Some(ranked.score),
        });
        let unscored = beyond.iter().map(|&neighbour| Placed {
            neighbour,
            score: None,
        });
        Ok(Some(scored.chain(unscored).collect()))
    }

    /// Loading runs inside re-ranking, on all threads: its share of the wall time is its sum over
    /// their number.
    fn record_rerank(&self, wall: Duration, loading_ns: u64, timings: &mut Timings) {
        let loading =
            Duration::from_nanos(loading_ns / rayon::current_num_threads().max(1) as u64).min(wall);
        timings.record(&self.metrics, Stage::Load, loading);
        timings.record(&self.metrics, Stage::Rerank, wall - loading);
    }

    /// What the store does not serve is not searched again. Nothing but a deletion, or sending the
    /// image of a damaged one again, takes a reference out of the store; both take it out of the
    /// index as well, so one that is in the index and unknown to the store while no change is under
    /// way was lost.
    fn withdraw(&self, plan: &Plan, id: ReferenceId) {
        let entry = self.maps.entry(&plan.name);
        let _settled = entry.changing();
        let searched = plan.map.index.remove(id)
            && entry
                .live()
                .is_some_and(|live| Arc::ptr_eq(&live, &plan.map));
        self.patches.forget(id);
        if searched
            && matches!(
                self.store.get(id),
                Err(StoreError::ReferenceNotFound { .. })
            )
        {
            tracing::error!(reference = %id, "the store has lost a reference; check its database");
            self.metrics.corrupt_records(1);
        }
    }

    /// The first `top_k` that still exist.
    fn with_metadata(
        &self,
        plan: &Plan,
        placed: Vec<Placed>,
    ) -> Result<Vec<QueryResult>, PipelineError> {
        let top_k = plan.top_k;
        let mut results = Vec::with_capacity(top_k.min(placed.len()));
        let mut placed = placed.into_iter().peekable();
        while results.len() < top_k && placed.peek().is_some() {
            let batch: Vec<Placed> = placed.by_ref().take(top_k - results.len()).collect();
            let ids: Vec<ReferenceId> = batch.iter().map(|one| one.neighbour.id).collect();
            let mut found: HashMap<ReferenceId, Reference> = self
                .store
                .get_many(&ids)?
                .into_iter()
                .map(|reference| (reference.id, reference))
                .collect();
            results.extend(batch.into_iter().filter_map(|one| {
                let Some(reference) = found.remove(&one.neighbour.id) else {
                    self.withdraw(plan, one.neighbour.id);
                    return None;
                };
                Some(QueryResult {
                    reference,
                    global_distance: one.neighbour.distance,
                    score: one.score,
                })
            }));
        }
        Ok(results)
    }
}

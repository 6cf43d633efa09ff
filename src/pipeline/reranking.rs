//! The re-ranking of a query's candidates: their key patches are loaded, matched with those of the
//! photo (paper III-D, III-E), and the candidates ordered by what is found.

use super::query::QueryPlan;
use super::{PipelineError, Service, Timings};
use crate::ops::PipelineStage;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{Deadline, Descriptor};
use placeformer_store::StoreError;
use placeformer_vision::rerank::{Evidence, PairScore, Ranking, Reranked};
use placeformer_vision::search::Neighbour;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Outcome of re-ranking for one candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct RankedScore {
    /// What the candidates are ordered by.
    pub value: f64,
    /// What matching and verification found.
    pub pair: PairScore,
}

/// A reference in the ranking, not yet looked up in the store.
pub(super) struct RankedNeighbour {
    pub(super) neighbour: Neighbour,
    /// Outcome of re-ranking; absent if this one was not re-ranked.
    pub(super) score: Option<RankedScore>,
}

impl RankedNeighbour {
    pub(super) fn by_distance(&neighbour: &Neighbour) -> Self {
        Self {
            neighbour,
            score: None,
        }
    }
}

impl Service {
    /// The candidates in the order of `by`; `None` if the query does not want it or time ran out.
    pub(super) fn rerank(
        &self,
        plan: &QueryPlan,
        query: &Descriptor,
        candidates: &[Neighbour],
        by: Ranking<'_>,
        timings: &mut Timings,
    ) -> Result<Option<Vec<RankedNeighbour>>, PipelineError> {
        if !plan.rerank {
            return Ok(None);
        }
        let reserve = Duration::from_millis(self.config.answer_reserve_ms);
        let time_left = plan.deadline.remaining().saturating_sub(reserve);
        if time_left.is_zero() {
            return Ok(None);
        }

        let deadline = Deadline::after(time_left);
        let outcome = self.score_candidates(query, candidates, deadline, timings);
        let Reranked::Complete { mut ranked, failed } = outcome else {
            return Ok(None);
        };
        for (i, error) in failed {
            match error.code() {
                // The candidate was deleted since the search, or it is damaged. The others are
                // answered without it.
                ErrorCode::ReferenceNotFound | ErrorCode::CorruptRecord => {
                    self.withdraw(plan, candidates[i].id);
                }
                _ => return Err(error.into()),
            }
        }

        // Equal ones stay in the order of the global search.
        ranked.sort_by_key(|ranked| ranked.candidate);
        let ordered = by.order(ranked, |ranked| Evidence {
            score: &ranked.score,
            distance: candidates[ranked.candidate].distance,
        });
        let scored = ordered.into_iter().map(|(value, ranked)| RankedNeighbour {
            neighbour: candidates[ranked.candidate],
            score: Some(RankedScore {
                value,
                pair: ranked.score,
            }),
        });
        Ok(Some(scored.collect()))
    }

    /// Matches the key patches of the query with those of each candidate, which are loaded from
    /// the cache or the store on the way.
    fn score_candidates(
        &self,
        query: &Descriptor,
        candidates: &[Neighbour],
        deadline: Deadline,
        timings: &mut Timings,
    ) -> Reranked<StoreError> {
        let started = Instant::now();
        let loading_ns = AtomicU64::new(0);
        // Loading runs on other threads; their log lines belong to this request all the same.
        let span = tracing::Span::current();
        let load = |i: usize| {
            let begun = Instant::now();
            let loaded = span.in_scope(|| self.patches.load(&*self.store, candidates[i].id));
            loading_ns.fetch_add(begun.elapsed().as_nanos() as u64, Ordering::Relaxed);
            loaded
        };
        let count = candidates.len();
        let outcome = self
            .reranker
            .rerank(&query.patches, count, load, Some(deadline));
        self.record_rerank(started.elapsed(), loading_ns.into_inner(), timings);
        outcome
    }

    /// Splits the time of re-ranking into loading and matching. Loading runs within re-ranking on
    /// all threads at once, so that its share of the `wall` time is its sum by their number.
    fn record_rerank(&self, wall: Duration, loading_ns: u64, timings: &mut Timings) {
        let threads = rayon::current_num_threads().max(1) as u64;
        let loading = Duration::from_nanos(loading_ns / threads).min(wall);
        timings.record(&self.metrics, PipelineStage::Load, loading);
        timings.record(&self.metrics, PipelineStage::Rerank, wall - loading);
    }
}

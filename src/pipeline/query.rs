//! From a photo to ranked places, step by step as in the paper.
//!
//! 1. The model turns the photo into a global descriptor and key patches (paper III-A to III-C).
//! 2. Global search: the nearest global descriptors of the map are the candidates (paper III-A).
//!    What the track of a vehicle expects is added to them.
//! 3. Re-ranking: key patches of photo and candidates are matched, and a homography counts the
//!    inliers (paper III-D, III-E). It is left out if the query asks so or has no time left.
//! 4. The first results get their metadata from the store, and the best one its confidence. In a
//!    track both the order and the confidence are those of its filter.

mod track;

use super::blocking::blocking;
use super::calibrations::BestAnswer;
use super::extraction::{Described, Purpose};
use super::maps::LiveMap;
use super::tracks::{Frame, Sighting, TrackAnswer, TrackOptions};
use super::{Caller, MatchConfidence, PipelineError, Service, Timings, UnmatchedReason};
use crate::ops::PipelineStage;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    Deadline, Descriptor, MapName, ModelId, Reference, ReferenceFilter, ReferenceId,
};
use placeformer_store::StoreError;
use placeformer_track::Estimate;
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
    /// What it continues, if it is one of a track.
    pub track: Option<TrackOptions>,
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
    pub confidence: MatchConfidence,
    /// Where exactly the photo was taken; `None` if the first result is not trusted or has no
    /// position.
    pub estimate: Option<Estimate>,
    /// The track after this frame, if the query is one of a track.
    pub track: Option<TrackAnswer>,
    /// Where the time went.
    pub timings: Timings,
    /// What computed it.
    pub model: ModelId,
}

/// A reference in the ranking, not yet looked up in the store.
struct RankedNeighbour {
    neighbour: Neighbour,
    /// Outcome of re-ranking; absent if this one was not re-ranked.
    score: Option<PairScore>,
}

impl RankedNeighbour {
    fn by_distance(&neighbour: &Neighbour) -> Self {
        Self {
            neighbour,
            score: None,
        }
    }
}

/// A query with all its defaults filled in and its map found.
struct QueryPlan {
    name: MapName,
    map: Arc<LiveMap>,
    top_k: usize,
    candidates: usize,
    rerank: bool,
    filter: ReferenceFilter,
    deadline: Deadline,
    frame: Option<Frame>,
}

impl Service {
    /// Answers which places of a map a photo may show.
    ///
    /// Cancel safety: dropped while waiting, nothing further is computed; what is being computed is
    /// finished in its place in the queue.
    ///
    /// # Errors
    /// There is no such map, or it has another model; an option is out of range; the image is
    /// refused; the queue is full or the time is up; the store fails.
    pub async fn query(
        self: &Arc<Self>,
        caller: &Caller,
        request: QueryRequest,
    ) -> Result<QueryAnswer, PipelineError> {
        let outcome = self.query_in_time(caller, request).await;
        self.count_if_late(&outcome);
        outcome
    }

    async fn query_in_time(
        self: &Arc<Self>,
        caller: &Caller,
        request: QueryRequest,
    ) -> Result<QueryAnswer, PipelineError> {
        let plan = match self.plan(request.map, request.options) {
            Err(PipelineError::MapNotFound(map)) => {
                return Err(self.explain_missing(caller, map).await);
            }
            plan => plan?,
        };
        let purpose = Purpose::Answer(plan.deadline);
        purpose.check_deadline("decoding")?;
        let max_wait = plan.deadline.remaining().min(self.max_wait());
        let ticket = Arc::new(self.queries.admit(caller, max_wait)?);

        let mut timings = Timings::default();
        let described = self
            .extraction
            .describe(request.image, purpose, &ticket, &mut timings)
            .await?;
        purpose.check_deadline("search")?;

        let service = self.clone();
        let answering = blocking(move || {
            let answer = service.answer(&plan, &described, timings);
            service.follow_damage();
            drop(ticket);
            answer
        });
        let panicked = |_| PipelineError::Panicked { stage: "ranking" };
        answering.await.map_err(panicked)?
    }

    /// Fills in the defaults and finds the map.
    fn plan(&self, name: MapName, options: QueryOptions) -> Result<QueryPlan, PipelineError> {
        let config = &self.config;
        let top_k = options.top_k.unwrap_or(config.top_k);
        let top_k = config.check_count("top_k", top_k)?;
        let candidates = options.candidates.unwrap_or(config.candidates);
        let model = self.extraction.source().model_id();
        let map = self.maps.comparable(&name, model)?;
        let candidates = config.check_count("candidates", candidates)?;
        let rerank = options.rerank.unwrap_or(true);
        let frame = match &options.track {
            Some(track) => Some(self.frame(&name, &map, rerank, track)?),
            None => None,
        };
        let default_deadline = || Deadline::after(Duration::from_millis(config.deadline_ms));
        Ok(QueryPlan {
            name,
            map,
            top_k,
            candidates,
            rerank,
            filter: options.filter,
            deadline: options.deadline.unwrap_or_else(default_deadline),
            frame,
        })
    }

    /// Asks the store why a map cannot be searched.
    async fn explain_missing(self: &Arc<Self>, caller: &Caller, map: MapName) -> PipelineError {
        let asking = self.run_limited(&self.store_reads, caller, move |service| {
            Ok(service.missing_map(&map))
        });
        asking.await.unwrap_or_else(|error| error)
    }

    /// Steps 2 to 4 of the query, on a blocking thread.
    fn answer(
        &self,
        plan: &QueryPlan,
        described: &Described,
        mut timings: Timings,
    ) -> Result<QueryAnswer, PipelineError> {
        let query = &described.descriptor;
        let global = plan.map.global_of(query);
        let mut candidates = self.search(plan, &global, &mut timings);
        let mut beyond = candidates.split_off(candidates.len().min(plan.candidates));
        let localisation = self.localise(plan, &global, &mut candidates, &mut timings)?;
        if plan.frame.is_some() {
            // Some of these may have been added to the candidates.
            beyond.retain(|one| candidates.iter().all(|candidate| candidate.id != one.id));
        }
        let reranking = self.rerank(plan, query, &candidates, &mut timings)?;
        let reranked = reranking.is_some();
        let by_distance = || {
            candidates
                .iter()
                .map(RankedNeighbour::by_distance)
                .collect()
        };
        let mut ranking = reranking.unwrap_or_else(by_distance);
        let sighting = self.weigh(plan, localisation, &mut ranking, reranked, &mut timings);
        ranking.extend(beyond.iter().map(RankedNeighbour::by_distance));

        let results = self.with_metadata(plan, ranking)?;
        let best = results.first();
        let confidence = match described.lacks {
            Some(_) => MatchConfidence::unmatched(UnmatchedReason::ImageUninformative),
            None => self.confidence(plan, best, reranked, sighting.as_ref()),
        };
        self.count_answer(best, reranked, confidence);
        let best = best.map(|best| best.reference.id);
        let pose = || sighting.as_ref()?.pose(best?);
        Ok(QueryAnswer {
            estimate: if confidence.matched == Some(true) {
                pose()
            } else {
                None
            },
            track: self.continue_track(plan, sighting.as_ref(), best)?,
            results,
            reranked,
            confidence,
            timings,
            model: plan.map.model.clone(),
        })
    }

    /// The references nearest to the query by global descriptor, nearest first.
    fn search(&self, plan: &QueryPlan, global: &[f32], timings: &mut Timings) -> Vec<Neighbour> {
        let started = Instant::now();
        let wanted = if plan.rerank || plan.frame.is_some() {
            plan.candidates.max(plan.top_k)
        } else {
            plan.top_k
        };
        let neighbours = plan.map.index.search(global, wanted, &plan.filter);
        timings.record(&self.metrics, PipelineStage::Search, started.elapsed());
        neighbours
    }

    /// The candidates ordered by spatial score; `None` if the query does not want it or time ran
    /// out.
    fn rerank(
        &self,
        plan: &QueryPlan,
        query: &Descriptor,
        candidates: &[Neighbour],
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
        let Reranked::Complete { ranked, failed } = outcome else {
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

        let scored = ranked.into_iter().map(|ranked| RankedNeighbour {
            neighbour: candidates[ranked.candidate],
            score: Some(ranked.score),
        });
        Ok(Some(scored.collect()))
    }

    /// Matches the key patches of the query with those of each candidate, which are loaded from the
    /// cache or the store on the way.
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

    /// Takes a reference that the store did not return out of the map's index, so that it is not
    /// found again, and reports it if it was lost.
    ///
    /// A reference leaves the store only by being deleted or, if it is damaged, by being replaced;
    /// both take it out of the index, too, while they keep the map's entry locked. So a reference
    /// that is still in the index while nobody else has that lock, but is unknown to the store, was
    /// lost by the database.
    fn withdraw(&self, plan: &QueryPlan, id: ReferenceId) {
        let entry = self.maps.entry(&plan.name);
        let _no_change_under_way = entry.lock_for_change();
        let was_in_index = plan.map.index.remove(id);
        self.patches.forget(id);

        let index_in_force = entry
            .live()
            .is_some_and(|live| Arc::ptr_eq(&live, &plan.map));
        if !was_in_index || !index_in_force {
            return;
        }
        if let Err(StoreError::ReferenceNotFound { .. }) = self.store.get(id) {
            tracing::error!(reference = %id, "the store has lost a reference; check its database");
            self.metrics.corrupt_records(1);
        }
    }

    /// The first `top_k` of the ranking that still exist. Looks up as many as are missing at a
    /// time, because some may have been deleted since the search.
    fn with_metadata(
        &self,
        plan: &QueryPlan,
        ranking: Vec<RankedNeighbour>,
    ) -> Result<Vec<QueryResult>, PipelineError> {
        let mut results = Vec::with_capacity(plan.top_k.min(ranking.len()));
        let mut ranking = ranking.into_iter();
        while results.len() < plan.top_k {
            let missing = plan.top_k - results.len();
            let batch: Vec<RankedNeighbour> = ranking.by_ref().take(missing).collect();
            if batch.is_empty() {
                break;
            }
            let ids: Vec<ReferenceId> = batch.iter().map(|ranked| ranked.neighbour.id).collect();
            let found = self.store.get_many(&ids)?;
            let mut found: HashMap<ReferenceId, Reference> = found
                .into_iter()
                .map(|reference| (reference.id, reference))
                .collect();
            for RankedNeighbour { neighbour, score } in batch {
                match found.remove(&neighbour.id) {
                    Some(reference) => results.push(QueryResult {
                        reference,
                        global_distance: neighbour.distance,
                        score,
                    }),
                    None => self.withdraw(plan, neighbour.id),
                }
            }
        }
        Ok(results)
    }

    /// How far the best result can be trusted, by the calibration in force, or in a track by all
    /// that is known of it.
    fn confidence(
        &self,
        plan: &QueryPlan,
        best: Option<&QueryResult>,
        reranked: bool,
        sighting: Option<&Sighting>,
    ) -> MatchConfidence {
        let of_track = plan.frame.as_ref().and(sighting);
        let probability = of_track.map(|sighting| {
            let best = best.map(|best| best.reference.id);
            sighting.probability(best)
        });
        let best = best.map(|best| BestAnswer {
            spatial_score: best.score.as_ref().map(|score| score.spatial_score),
            global_distance: best.global_distance,
        });
        let own = plan.map.calibration();
        let (model, own) = (&plan.map.model, own.as_deref());
        match probability {
            Some(probability) => self.calibrations.judge(model, own, reranked, probability),
            None => self.calibrations.assess(model, own, best),
        }
    }

    /// Counts an answer with its best result in the metrics.
    fn count_answer(
        &self,
        best: Option<&QueryResult>,
        reranked: bool,
        confidence: MatchConfidence,
    ) {
        let score = best.and_then(|best| best.score.as_ref());
        let spatial_score = score.map_or(0, |score| score.spatial_score);
        let top1_score = reranked.then_some(spatial_score);
        self.metrics.query_answered(top1_score, confidence.matched);
    }
}

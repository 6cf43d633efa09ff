//! From a photo to ranked places, step by step as in the paper.
//!
//! 1. The model turns the photo into a global descriptor and key patches (paper III-A to III-C).
//! 2. Global search: the nearest global descriptors of the map are the candidates (paper III-A).
//!    What the track of a vehicle expects is added to them.
//! 3. Re-ranking: key patches of photo and candidates are matched, a homography counts the inliers
//!    (paper III-D, III-E), and candidates are ordered by S or another score of what was found. It
//!    is left out if the query asks so or has no time left.
//! 4. The first results get their metadata from the store, and the best one its confidence. In a
//!    track both the order and the confidence are those of its filter.

mod track;

use super::blocking::blocking;
use super::calibrations::BestAnswer;
use super::extraction::{Described, Purpose};
use super::maps::LiveMap;
use super::reranking::{RankedNeighbour, RankedScore};
use super::tracks::{Frame, Sighting, TrackAnswer, TrackOptions};
use super::{Caller, MatchConfidence, PipelineError, Service, Timings, UnmatchedReason};
use crate::ops::PipelineStage;
use bytes::Bytes;
use placeformer_core::types::{
    Calibration, Deadline, MapName, ModelId, Reference, ReferenceFilter, ReferenceId, ScoreKind,
};
use placeformer_store::StoreError;
use placeformer_track::Estimate;
use placeformer_vision::search::Neighbour;
use std::collections::HashMap;
use std::sync::Arc;
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
    pub score: Option<RankedScore>,
}

/// The ranked places.
#[derive(Debug, Clone)]
pub struct QueryAnswer {
    /// Best first.
    pub results: Vec<QueryResult>,
    /// What the re-ranked candidates are ordered by; absent if nothing was re-ranked.
    pub ranked_by: Option<ScoreKind>,
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

/// What an answer can be trusted by.
struct Trust<'a> {
    /// The map's calibration, if it has one.
    own: Option<&'a Calibration>,
    /// What the re-ranked candidates are ordered by; absent if nothing was re-ranked.
    ranked_by: Option<ScoreKind>,
    /// Whether the photo shows nothing by which a place could be known.
    shows_nothing: bool,
    /// What the photo and its track together say, where they can be weighed.
    sighting: Option<&'a Sighting>,
}

/// A query with all its defaults filled in and its map found.
pub(super) struct QueryPlan {
    pub(super) name: MapName,
    pub(super) map: Arc<LiveMap>,
    top_k: usize,
    pub(super) candidates: usize,
    pub(super) rerank: bool,
    filter: ReferenceFilter,
    pub(super) deadline: Deadline,
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
        // Ranking and confidence are by the same calibration, even if it is replaced meanwhile.
        let own = plan.map.calibration();
        let by = self.calibrations.ranking(&plan.map.model, own.as_deref());
        let reranking = self.rerank(plan, query, &candidates, by, &mut timings)?;
        let ranked_by = reranking.as_ref().map(|_| by.kind());
        let by_distance = || {
            candidates
                .iter()
                .map(RankedNeighbour::by_distance)
                .collect()
        };
        let mut ranking = reranking.unwrap_or_else(by_distance);
        let sighting = self.weigh(plan, localisation, &mut ranking, ranked_by, &mut timings);
        ranking.extend(beyond.iter().map(RankedNeighbour::by_distance));

        let results = self.with_metadata(plan, ranking)?;
        let trust = Trust {
            own: own.as_deref(),
            ranked_by,
            shows_nothing: described.lacks.is_some(),
            sighting: sighting.as_ref(),
        };
        let best = results.first();
        let confidence = self.confidence(plan, best, &trust);
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
            ranked_by,
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

    /// Takes a reference that the store did not return out of the map's index, so that it is not
    /// found again, and reports it if it was lost.
    ///
    /// A reference leaves the store only by being deleted or, if it is damaged, by being replaced;
    /// both take it out of the index, too, while they keep the map's entry locked. So a reference
    /// that is still in the index while nobody else has that lock, but is unknown to the store,
    /// was lost by the database.
    pub(super) fn withdraw(&self, plan: &QueryPlan, id: ReferenceId) {
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
        trust: &Trust<'_>,
    ) -> MatchConfidence {
        let confidence = self.judge(plan, best, trust);
        let score = best.and_then(|best| best.score.as_ref());
        let spatial_score = score.map_or(0, |score| score.pair.spatial_score);
        let top1_score = trust.ranked_by.map(|_| spatial_score);
        self.metrics.query_answered(top1_score, confidence.matched);
        confidence
    }

    fn judge(
        &self,
        plan: &QueryPlan,
        best: Option<&QueryResult>,
        trust: &Trust<'_>,
    ) -> MatchConfidence {
        if trust.shows_nothing {
            return MatchConfidence::unmatched(UnmatchedReason::ImageUninformative);
        }
        let model = &plan.map.model;
        if let Some(sighting) = plan.frame.as_ref().and(trust.sighting) {
            let best = best.map(|best| best.reference.id);
            let probability = sighting.probability(best);
            let is_reranked = trust.ranked_by.is_some();
            return self
                .calibrations
                .judge(model, trust.own, is_reranked, probability);
        }
        let best = best.map(|best| {
            let value = best.score.as_ref().map(|score| score.value);
            BestAnswer {
                evidence: trust
                    .ranked_by
                    .zip(value)
                    .map(|(by, value)| by.evidence(value)),
                global_distance: best.global_distance,
            }
        });
        self.calibrations.assess(model, trust.own, best)
    }
}

//! The part of a query that knows where a vehicle was: a frame of a track, or a photo about which
//! nothing is known before.

use super::{QueryPlan, RankedNeighbour};
use crate::ops::PipelineStage;
use crate::pipeline::maps::LiveMap;
use crate::pipeline::tracks::{Frame, Localisation, Sighting};
use crate::pipeline::{PipelineError, Service, Timings, TrackAnswer, TrackOptions};
use placeformer_core::types::{MapName, ReferenceId, ScoreKind, Timestamp};
use placeformer_track::Evidence;
use placeformer_vision::search::Neighbour;
use std::time::Instant;

impl Service {
    /// Checks what a query says about its track, before anything costly is done.
    pub(super) fn frame(
        &self,
        name: &MapName,
        map: &LiveMap,
        rerank: bool,
        options: &TrackOptions,
    ) -> Result<Frame, PipelineError> {
        let own = map.calibration();
        if self
            .calibrations
            .curve(&map.model, own.as_deref(), rerank)
            .is_none()
        {
            return Err(uncalibrated(name));
        }
        let of_map = (name, &map.model);
        let now = Timestamp::now();
        Ok(Frame::new(
            options,
            of_map,
            &self.tracks,
            &self.track_key,
            now,
        )?)
    }

    /// The places that the photo may show, with what its track expects of them; the places that
    /// only the track leads to are added to `candidates`. `None` if there is no calibration,
    /// without which scores say nothing.
    ///
    /// # Errors
    /// The query is one of a track, and no candidate has a position.
    pub(super) fn localise(
        &self,
        plan: &QueryPlan,
        global: &[f32],
        candidates: &mut Vec<Neighbour>,
        timings: &mut Timings,
    ) -> Result<Option<Localisation>, PipelineError> {
        let started = Instant::now();
        let own = plan.map.calibration();
        let Some(curve) = self
            .calibrations
            .curve(&plan.map.model, own.as_deref(), plan.rerank)
        else {
            return Ok(None);
        };
        let localisation = Localisation::new(
            &plan.map.index,
            &plan.filter,
            global,
            candidates,
            plan.frame.as_ref(),
            Evidence::new(curve),
        );
        if plan.frame.is_some() {
            if localisation.is_nowhere() && !candidates.is_empty() {
                return Err(PipelineError::TrackUnavailable {
                    map: plan.name.clone(),
                    reason: "none of the references that were found has a position",
                });
            }
            timings.record(&self.metrics, PipelineStage::Track, started.elapsed());
        }
        Ok(Some(localisation))
    }

    /// Weighs the places by the scores in `ranking`, which in a track is brought into the order of
    /// the outcome: what has no position comes last.
    pub(super) fn weigh(
        &self,
        plan: &QueryPlan,
        localisation: Option<Localisation>,
        ranking: &mut [RankedNeighbour],
        ranked_by: Option<ScoreKind>,
        timings: &mut Timings,
    ) -> Option<Sighting> {
        let started = Instant::now();
        let own = plan.map.calibration();
        let curve =
            self.calibrations
                .curve(&plan.map.model, own.as_deref(), ranked_by.is_some())?;
        let scores = ranking.iter().map(|ranked| {
            let value = ranked.score.as_ref().map(|score| score.value);
            let evidence = ranked_by.zip(value).map(|(by, value)| by.evidence(value));
            (ranked.neighbour.id, evidence, ranked.neighbour.distance)
        });
        let sighting = localisation?.weigh(scores, Evidence::new(curve));
        if plan.frame.is_some() {
            let density = |ranked: &RankedNeighbour| {
                let density = sighting.density(ranked.neighbour.id);
                density.unwrap_or(f64::NEG_INFINITY)
            };
            ranking.sort_by(|a, b| density(b).total_cmp(&density(a)));
            timings.record(&self.metrics, PipelineStage::Track, started.elapsed());
        }
        Some(sighting)
    }

    /// The track after this frame, if the query is one of a track.
    ///
    /// # Errors
    /// The map's calibration was removed since the query began.
    pub(super) fn continue_track(
        &self,
        plan: &QueryPlan,
        sighting: Option<&Sighting>,
        best: Option<ReferenceId>,
    ) -> Result<Option<TrackAnswer>, PipelineError> {
        let Some(frame) = &plan.frame else {
            return Ok(None);
        };
        let sighting = sighting.ok_or_else(|| uncalibrated(&plan.name))?;
        let of_map = (&plan.name, &plan.map.model);
        let answer = sighting.continued(frame, of_map, &self.track_key, best);
        if answer.lost && !frame.was_lost() {
            self.metrics.track_lost();
        }
        Ok(Some(answer))
    }
}

/// Tracks weigh places by calibrated scores.
fn uncalibrated(map: &MapName) -> PipelineError {
    PipelineError::TrackUnavailable {
        map: map.clone(),
        reason: "there is no calibration for its model and this server's re-ranking",
    }
}

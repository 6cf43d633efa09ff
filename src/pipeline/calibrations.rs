//! Whether a best answer can be trusted: judged by the calibration of its map, else by that of the
//! model. Where there is neither, the answer says nothing about it. A calibration also brings the
//! score that candidates are ranked by, where that is a learned one.

use super::PipelineError;
use placeformer_core::types::{
    Calibration, ConfidenceCurve, LearnedScore, MapName, ModelId, RerankId, ScoreKind,
};
use placeformer_models::built_in_calibrations;
use placeformer_vision::rerank::{Ranking, RerankConfig, feature_names};

/// How far the best answer can be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MatchConfidence {
    /// Whether the best answer is trusted; `None` where no calibration can be used.
    pub matched: Option<bool>,
    /// Probability, 0 to 1, that the best answer is right; `None` where no calibration can be used.
    pub confidence: Option<f64>,
    /// Why the best answer is not trusted; `None` where it is, or where nothing is known.
    pub reason: Option<UnmatchedReason>,
}

/// Why the best answer is not trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnmatchedReason {
    /// There is no answer.
    NoResults,
    /// The photo shows nothing by which a place could be known.
    ImageUninformative,
    /// Its confidence is below the threshold of the calibration.
    LowConfidence,
}

impl MatchConfidence {
    /// Certainly no match.
    pub(super) fn unmatched(reason: UnmatchedReason) -> Self {
        Self {
            matched: Some(false),
            confidence: Some(0.0),
            reason: Some(reason),
        }
    }
}

/// What the best answer of a query is judged by.
#[derive(Debug, Clone, Copy)]
pub(super) struct BestAnswer {
    /// What the ranking's value counts for ([`ScoreKind::evidence`]); absent if it was not
    /// re-ranked.
    pub(super) evidence: Option<f64>,
    /// Euclidean distance between its global descriptor and the query's.
    pub(super) global_distance: f32,
}

/// The calibrations that come with this server, and the re-ranking on whose scores it answers.
pub(super) struct Calibrations {
    built_in: Vec<Calibration>,
    rerank: RerankId,
    /// The features that a learned score must have been fitted on.
    features: Vec<String>,
}

impl Calibrations {
    /// For a server that re-ranks as `rerank` says.
    pub(super) fn new(rerank: &RerankConfig) -> Self {
        Self {
            built_in: built_in_calibrations().collect(),
            rerank: rerank.id(),
            features: feature_names(&rerank.scales),
        }
    }

    /// What the candidates of a map of `model`, with a calibration of its `own` or none, are
    /// ranked by. By S where no calibration in force has a learned score; the answer says so.
    pub(super) fn ranking<'a>(
        &'a self,
        model: &ModelId,
        own: Option<&'a Calibration>,
    ) -> Ranking<'a> {
        match self.rerank.score() {
            ScoreKind::Paper => Ranking::Paper,
            ScoreKind::Fused => Ranking::Fused,
            ScoreKind::Learned => {
                let in_force = self.in_force(model, own);
                let score = in_force.and_then(Calibration::learned_score);
                score.map_or(Ranking::Paper, Ranking::Learned)
            }
        }
    }

    /// The calibration of `model` itself.
    pub(super) fn built_in(&self, model: &ModelId) -> Option<&Calibration> {
        self.built_in
            .iter()
            .find(|calibration| calibration.model() == model)
    }

    /// How far the best answer from a map of `model`, with a calibration of its `own` or none, can
    /// be trusted. Where there is no answer, certainly none is right.
    pub(super) fn assess(
        &self,
        model: &ModelId,
        own: Option<&Calibration>,
        best: Option<BestAnswer>,
    ) -> MatchConfidence {
        let Some(best) = best else {
            return MatchConfidence::unmatched(UnmatchedReason::NoResults);
        };
        let Some(curve) = self.curve(model, own, best.evidence.is_some()) else {
            return MatchConfidence::default();
        };
        let global_distance = f64::from(best.global_distance);
        let confidence = curve.weights.confidence(best.evidence, global_distance);
        let matched = curve.trusts(confidence);
        MatchConfidence {
            matched: Some(matched),
            confidence: Some(confidence),
            reason: (!matched).then_some(UnmatchedReason::LowConfidence),
        }
    }

    /// Whether an answer that is right with this `probability` is trusted.
    pub(super) fn judge(
        &self,
        model: &ModelId,
        own: Option<&Calibration>,
        reranked: bool,
        probability: f64,
    ) -> MatchConfidence {
        match self.curve(model, own, reranked) {
            Some(curve) => {
                let matched = curve.trusts(probability);
                MatchConfidence {
                    matched: Some(matched),
                    confidence: Some(probability),
                    reason: (!matched).then_some(UnmatchedReason::LowConfidence),
                }
            }
            None => MatchConfidence::default(),
        }
    }

    /// The curve in force: the map's own before the model's. A curve of scores holds only for the
    /// re-ranking it was fitted on; a curve of distances holds for any.
    pub(super) fn curve<'a>(
        &'a self,
        model: &ModelId,
        own: Option<&'a Calibration>,
        reranked: bool,
    ) -> Option<&'a ConfidenceCurve> {
        let calibration = match reranked {
            true => self.in_force(model, own),
            false => own.or(self.built_in(model)),
        };
        Some(calibration?.curve(reranked))
    }

    /// The first calibration that holds for this server's re-ranking: the map's own, or the
    /// model's.
    fn in_force<'a>(
        &'a self,
        model: &ModelId,
        own: Option<&'a Calibration>,
    ) -> Option<&'a Calibration> {
        let mut by_precedence = own.into_iter().chain(self.built_in(model));
        by_precedence.find(|calibration| {
            let holds_for_features =
                |score: &LearnedScore| score.check_features(&self.features).is_ok();
            *calibration.rerank() == self.rerank
                && calibration.learned_score().is_none_or(holds_for_features)
        })
    }

    /// Refuses a calibration that was fitted on scores of another re-ranking than this server's,
    /// or whose learned score was fitted on other features.
    pub(super) fn check(
        &self,
        map: &MapName,
        calibration: &Calibration,
    ) -> Result<(), PipelineError> {
        if *calibration.rerank() != self.rerank {
            return Err(PipelineError::RerankMismatch {
                map: map.clone(),
                server: self.rerank.clone(),
                given: calibration.rerank().clone(),
            });
        }
        if let Some(score) = calibration.learned_score() {
            score.check_features(&self.features)?;
        }
        Ok(())
    }

    /// Logs a warning if candidates should be ranked by a learned score, but the model has none.
    pub(super) fn warn_if_nothing_learned(&self, model: &ModelId) {
        let is_by_inliers = matches!(self.ranking(model, None), Ranking::Paper);
        if self.rerank.score() == ScoreKind::Learned && is_by_inliers {
            tracing::warn!(
                "the model has no learned score: maps without one of their own are ranked by S"
            );
        }
    }

    /// Logs a warning if a map's calibration cannot be used for re-ranked answers here.
    pub(super) fn warn_if_unusable(&self, map: &MapName, calibration: Option<&Calibration>) {
        let Some(calibration) = calibration else {
            return;
        };
        if let Err(error) = self.check(map, calibration) {
            tracing::warn!(%map, %error, "the map's calibration is not used for re-ranked answers");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::{ConfidenceWeights, ScoreTerm};
    use placeformer_models::built_in_calibration;
    use placeformer_vision::extract::Head;
    use placeformer_vision::rerank::RerankConfig;

    fn curve(bias: f64, score: f64) -> ConfidenceCurve {
        let weights = ConfidenceWeights {
            bias,
            score,
            distance: -1.0,
        };
        ConfidenceCurve {
            weights,
            threshold: 0.8,
            right: 9,
            wrong: 5,
            without_match: 4,
            precision: 1.0,
            recall: 0.9,
            expected_calibration_error: 0.01,
        }
    }

    fn calibration(rerank: &str, bias: f64) -> Calibration {
        let curves = [curve(bias, 1.0), curve(bias, 0.0)];
        Calibration::new(
            ModelId::new("m"),
            RerankId::new(rerank),
            "test",
            0.99,
            curves,
        )
        .unwrap()
    }

    fn answer(spatial_score: Option<u32>, global_distance: f32) -> Option<BestAnswer> {
        let evidence = |s: u32| ScoreKind::Paper.evidence(f64::from(s));
        Some(BestAnswer {
            evidence: spatial_score.map(evidence),
            global_distance,
        })
    }

    /// Of a server that re-ranks as `rerank` says.
    fn calibrations(built_in: Vec<Calibration>, rerank: &str) -> Calibrations {
        Calibrations {
            built_in,
            rerank: RerankId::new(rerank),
            features: vec!["a".into()],
        }
    }

    fn learned(feature: &str, weight: f64) -> LearnedScore {
        let term = ScoreTerm {
            feature: feature.into(),
            mean: 0.0,
            deviation: 1.0,
            weight,
        };
        LearnedScore::new(0.0, vec![term]).unwrap()
    }

    #[test]
    fn a_learned_score_comes_from_the_map_before_the_model_and_only_where_it_holds() {
        let with = |score: LearnedScore| {
            let calibration = calibration("r:learned", -1.0);
            calibration.with_score(score).unwrap()
        };
        let model = &ModelId::new("m");
        let server = calibrations(vec![with(learned("a", 1.0))], "r:learned");
        let weight = |own: Option<&Calibration>| match server.ranking(model, own) {
            Ranking::Learned(score) => Some(score.terms()[0].weight),
            _ => None,
        };
        assert_eq!(weight(None), Some(1.0));
        assert_eq!(weight(Some(&with(learned("a", 2.0)))), Some(2.0));
        let other_features = with(learned("b", 3.0));
        assert_eq!(weight(Some(&other_features)), Some(1.0));
        let map = &"m".parse().unwrap();
        let refused = server.check(map, &other_features).unwrap_err();
        assert!(refused.to_string().contains("learned_score"), "{refused}");
        assert!(server.check(map, &calibration("r", 0.0)).is_err());

        let without = calibrations(Vec::new(), "r:learned");
        assert!(matches!(without.ranking(model, None), Ranking::Paper));
        // A curve for learned scores says nothing about S.
        let unknown = without.assess(model, None, answer(Some(100), 0.1));
        assert_eq!(unknown, MatchConfidence::default());
    }

    #[test]
    fn what_ships_can_be_read_and_holds_for_the_default_re_ranking() {
        for shipped in built_in_calibrations() {
            assert_eq!(built_in_calibration(shipped.model()), Some(shipped.clone()));
            assert_eq!(*shipped.rerank(), RerankConfig::default().id());
            // Whoever makes another head must fit another calibration, or the default model goes
            // without.
            let parts: Vec<&str> = shipped.model().as_str().split(':').collect();
            let head = Head::built_in(&parts[..3].join(":"))
                .unwrap()
                .expect("a head ships for this backbone");
            assert_eq!(
                *parts.last().unwrap(),
                format!("h{}", &head.content_hash()[..12]),
                "see `make calibration`"
            );
        }
        assert_eq!(built_in_calibration(&ModelId::new("another")), None);
    }

    #[test]
    fn the_maps_own_calibration_comes_first_and_only_where_it_holds() {
        let calibrations = calibrations(vec![calibration("r", -3.0)], "r");
        let model = &ModelId::new("m");
        let assess_sure =
            |own: Option<&Calibration>| calibrations.assess(model, own, answer(Some(1000), 0.2));
        let of_model = assess_sure(None);
        assert_eq!(of_model.matched, Some(true));
        let unsure = calibrations.assess(model, None, answer(Some(3), 1.2));
        assert_eq!(unsure.matched, Some(false));
        assert_eq!(unsure.reason, Some(UnmatchedReason::LowConfidence));
        assert_eq!(of_model.reason, None);

        let of_map = assess_sure(Some(&calibration("r", -9.0)));
        assert!(
            of_map.confidence < of_model.confidence && of_map.matched == Some(false),
            "{of_map:?}"
        );

        // A calibration for another re-ranking: its distances can still be used, its scores cannot.
        let foreign = calibration("other", -9.0);
        assert_eq!(assess_sure(Some(&foreign)), of_model);
        let by_distance = calibrations.assess(model, Some(&foreign), answer(None, 0.2));
        assert!(
            (by_distance.confidence.unwrap() - 1.0 / (1.0 + 9.2f64.exp())).abs() < 1e-6,
            "{by_distance:?}"
        );

        // A map with a head of its own has another model, and the built-in calibration knows
        // nothing of that model's distances.
        let other_head = ModelId::new("other head");
        assert_eq!(
            calibrations.assess(&other_head, None, answer(Some(1000), 0.2)),
            MatchConfidence::default()
        );
    }

    #[test]
    fn without_a_calibration_nothing_is_guessed_but_nothing_is_no_match() {
        let model = &ModelId::new("m");
        let calibrations = calibrations(Vec::new(), "r");
        assert_eq!(
            calibrations.assess(model, None, answer(Some(1000), 0.1)),
            MatchConfidence::default()
        );
        assert_eq!(
            calibrations.assess(model, None, None),
            MatchConfidence::unmatched(UnmatchedReason::NoResults)
        );
        let refused = calibrations
            .check(&"m".parse().unwrap(), &calibration("other", 0.0))
            .unwrap_err()
            .to_string();
        assert!(
            refused.contains("\"r\"") && refused.contains("\"other\""),
            "{refused}"
        );
    }
}

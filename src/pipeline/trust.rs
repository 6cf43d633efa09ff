//! Whether a best answer is to be trusted: by the map's own calibration, else by the model's, else
//! nobody says.

use super::PipelineError;
use super::query::QueryResult;
use placeformer_core::types::{Calibration, ConfidenceCurve, MapName, ModelId, RerankId};
use placeformer_models::built_in_calibrations;

/// What can be said about the best answer.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Verdict {
    /// Whether the best answer is trusted; `None` where no calibration holds.
    pub matched: Option<bool>,
    /// Probability, 0 to 1, that the best answer is right; `None` where no calibration holds.
    pub confidence: Option<f64>,
}

/// What this server can say about answers in general.
pub(super) struct Trust {
    built_in: Vec<Calibration>,
    rerank: RerankId,
}

impl Trust {
    /// For a server that re-ranks as `rerank` says.
    pub(super) fn new(rerank: RerankId) -> Self {
        Self {
            built_in: built_in_calibrations().collect(),
            rerank,
        }
    }

    /// The calibration of `model` itself.
    pub(super) fn built_in(&self, model: &ModelId) -> Option<&Calibration> {
        self.built_in
            .iter()
            .find(|calibration| calibration.model() == model)
    }

    /// Judges the best answer from a map of `model` with a calibration of its `own`. Where there is
    /// no answer, certainly none is right.
    pub(super) fn judge(
        &self,
        model: &ModelId,
        own: Option<&Calibration>,
        best: Option<&QueryResult>,
    ) -> Verdict {
        let Some(best) = best else {
            return Verdict {
                matched: Some(false),
                confidence: Some(0.0),
            };
        };
        let spatial_score = best
            .score
            .as_ref()
            .map(|score| f64::from(score.spatial_score));
        let Some(curve) = self.curve(model, own, spatial_score.is_some()) else {
            return Verdict::default();
        };
        let confidence = curve
            .weights
            .confidence(spatial_score, f64::from(best.global_distance));
        Verdict {
            matched: Some(curve.trusts(confidence)),
            confidence: Some(confidence),
        }
    }

    /// The curve in force. Scores of another re-ranking mean something else; distances do not
    /// depend on it.
    fn curve<'a>(
        &'a self,
        model: &ModelId,
        own: Option<&'a Calibration>,
        reranked: bool,
    ) -> Option<&'a ConfidenceCurve> {
        let known = own.into_iter().chain(self.built_in(model));
        let mut holding =
            known.filter(|calibration| !reranked || *calibration.rerank() == self.rerank);
        holding
            .next()
            .map(|calibration| calibration.curve(reranked))
    }

    /// Refuses a calibration whose S is not this server's.
    pub(super) fn check(
        &self,
        map: &MapName,
        calibration: &Calibration,
    ) -> Result<(), PipelineError> {
        if *calibration.rerank() == self.rerank {
            return Ok(());
        }
        Err(PipelineError::RerankMismatch {
            map: map.clone(),
            server: self.rerank.clone(),
            given: calibration.rerank().clone(),
        })
    }

    /// Says in the log if a map's calibration does not hold for re-ranked answers here.
    pub(super) fn warn_if_useless(&self, map: &MapName, calibration: Option<&Calibration>) {
        if let Some(Err(error)) = calibration.map(|calibration| self.check(map, calibration)) {
            tracing::warn!(%map, %error, "the map's calibration is not used for re-ranked answers");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::{
        ConfidenceWeights, ContentHash, Reference, ReferenceFields, ReferenceId,
    };
    use placeformer_models::built_in_calibration;
    use placeformer_vision::extract::Head;
    use placeformer_vision::rerank::{PairScore, RerankConfig};
    use time::OffsetDateTime;

    fn curve(bias: f64, score: f64) -> ConfidenceCurve {
        let weights = ConfidenceWeights {
            bias,
            score,
            distance: -1.0,
        };
        let (right, wrong, without_match) = (9, 5, 4);
        let (precision, recall, expected_calibration_error) = (1.0, 0.9, 0.01);
        let threshold = 0.8;
        ConfidenceCurve {
            weights,
            threshold,
            right,
            wrong,
            without_match,
            precision,
            recall,
            expected_calibration_error,
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

    fn result(spatial_score: Option<u32>, global_distance: f32) -> QueryResult {
        let reference = Reference {
            id: ReferenceId::generate(),
            map: "m".parse().unwrap(),
            fields: ReferenceFields::default(),
            content_hash: ContentHash([0; 32]),
            model: ModelId::new("m"),
            created_at: OffsetDateTime::UNIX_EPOCH,
        };
        let score = spatial_score.map(|spatial_score| PairScore {
            spatial_score,
            combinations: Vec::new(),
        });
        QueryResult {
            reference,
            global_distance,
            score,
        }
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
        let (trust, model) = (
            Trust {
                built_in: vec![calibration("r", -3.0)],
                rerank: RerankId::new("r"),
            },
            &ModelId::new("m"),
        );
        let (sure, unsure) = (result(Some(1000), 0.2), result(Some(3), 1.2));
        let of_model = trust.judge(model, None, Some(&sure));
        assert_eq!(of_model.matched, Some(true));
        assert_eq!(trust.judge(model, None, Some(&unsure)).matched, Some(false));
        let own = trust.judge(model, Some(&calibration("r", -9.0)), Some(&sure));
        assert!(
            own.confidence < of_model.confidence && own.matched == Some(false),
            "{own:?}"
        );
        // Fitted for another re-ranking: its distances still hold, its scores do not.
        let foreign = calibration("other", -9.0);
        assert_eq!(trust.judge(model, Some(&foreign), Some(&sure)), of_model);
        let global = trust.judge(model, Some(&foreign), Some(&result(None, 0.2)));
        assert!(
            (global.confidence.unwrap() - 1.0 / (1.0 + 9.2f64.exp())).abs() < 1e-6,
            "{global:?}"
        );
        // A map with a head of its own has another model, whose distances the built-in one knows
        // nothing of.
        assert_eq!(
            trust.judge(&ModelId::new("other head"), None, Some(&sure)),
            Verdict::default()
        );
    }

    #[test]
    fn without_a_calibration_nothing_is_guessed_but_nothing_is_no_match() {
        let model = &ModelId::new("m");
        let trust = Trust {
            built_in: Vec::new(),
            rerank: RerankId::new("r"),
        };
        assert_eq!(
            trust.judge(model, None, Some(&result(Some(1000), 0.1))),
            Verdict::default()
        );
        assert_eq!(
            trust.judge(model, None, None),
            Verdict {
                matched: Some(false),
                confidence: Some(0.0)
            }
        );
        let refused = trust
            .check(&"m".parse().unwrap(), &calibration("other", 0.0))
            .unwrap_err()
            .to_string();
        assert!(
            refused.contains("\"r\"") && refused.contains("\"other\""),
            "{refused}"
        );
    }
}

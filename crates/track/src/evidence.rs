//! What a photo says about a place, from the calibrated scores of both stages.
//!
//! A calibration turns S and global distance into the probability that an answer is right. That
//! probability holds for the mix of right and wrong answers it was fitted on. Divided by the odds
//! of that mix it is what a filter needs: how much likelier these scores are at the right place
//! than at a wrong one.

use placeformer_core::types::ConfidenceCurve;

/// A confidence nearer to 0 or 1 than this is taken as this: no photo is proof.
const SMALLEST_DOUBT: f64 = 1e-6;

/// A calibrated curve, as evidence for a filter.
#[derive(Debug, Clone, Copy)]
pub struct Evidence<'a> {
    curve: &'a ConfidenceCurve,
    /// Odds of a right answer in the mix that the curve was fitted on.
    prior_odds: f64,
}

impl<'a> Evidence<'a> {
    /// From the curve of the answers at hand: re-ranked ones, or those by distance alone.
    pub fn new(curve: &'a ConfidenceCurve) -> Self {
        // One more of each keeps a curve that was fitted on few answers from claiming certainty.
        let prior_odds = (curve.right as f64 + 1.0) / (curve.wrong as f64 + 1.0);
        Self { curve, prior_odds }
    }

    /// Probability that a best answer is right when nothing is known about it.
    pub fn prior(&self) -> f64 {
        self.prior_odds / (1.0 + self.prior_odds)
    }

    /// Logarithm of how much likelier these scores are at the right place than at a wrong one;
    /// `evidence` is what the score of a candidate counts for in its calibration (S: ln(1 + S)),
    /// `None` where nothing was re-ranked.
    pub fn log_ratio(&self, evidence: Option<f64>, global_distance: f64) -> f64 {
        let weights = &self.curve.weights;
        let confidence = weights.confidence(evidence, global_distance);
        let confidence = confidence.clamp(SMALLEST_DOUBT, 1.0 - SMALLEST_DOUBT);
        (confidence / (1.0 - confidence)).ln() - self.prior_odds.ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use placeformer_core::types::ConfidenceWeights;

    fn curve() -> ConfidenceCurve {
        ConfidenceCurve {
            weights: ConfidenceWeights {
                bias: -2.0,
                score: 3.0,
                distance: -10.0,
            },
            threshold: 0.9,
            right: 29,
            wrong: 9,
            without_match: 5,
            precision: 0.99,
            recall: 0.8,
            expected_calibration_error: 0.02,
        }
    }

    #[test]
    fn evidence_and_prior_together_are_the_confidence() {
        let curve = curve();
        let evidence = Evidence::new(&curve);
        assert!((evidence.prior() - 0.75).abs() < 1e-12);
        let score = Some(30.0f64.ln_1p());
        let odds = 3.0 * evidence.log_ratio(score, 0.9).exp();
        let confidence = curve.weights.confidence(score, 0.9);
        assert!((odds / (1.0 + odds) - confidence).abs() < 1e-9);
    }

    #[test]
    fn no_score_is_proof() {
        let curve = curve();
        let evidence = Evidence::new(&curve);
        for (score, distance) in [(Some(1e9), 0.0), (Some(0.0), 2.0), (None, 2.0)] {
            let ratio = evidence.log_ratio(score, distance);
            assert!(ratio.is_finite() && ratio.abs() < 20.0, "{ratio}");
        }
    }
}

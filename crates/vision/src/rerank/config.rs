//! Settings of re-ranking.

use placeformer_core::types::{InvalidValue, RerankId, ScaleSet, ScoreKind};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Settings of re-ranking.
///
/// The comments of the fields are printed as the manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RerankConfig {
    /// The scale combinations whose inlier counts add up to the spatial score S. The best row of
    /// the paper's table is 1, 1+2, 2+3.
    #[schema(value_type = Vec<String>)]
    pub scales: Vec<ScaleSet>,
    /// Inlier tolerance of the homography in multiples of the base patch size.
    pub tolerance_patches: f32,
    /// Most homographies scored for one combination; samples refused as degenerate or twisted do
    /// not count.
    pub max_iterations: u32,
    /// The search for a homography stops early once the best one has been seen with this
    /// probability.
    pub confidence: f64,
    /// What candidates are ordered by: paper, the number of inliers S; fused, ln(S + 10) + 2 c
    /// with the cosine c of the global descriptors; or learned, the score in the calibration of
    /// the map or the model. Calibrations hold for one of them only.
    #[schema(value_type = String)]
    pub score: ScoreKind,
}

/// With more than this, one candidate takes seconds.
const MOST_ITERATIONS: u32 = 1_000_000;

impl Default for RerankConfig {
    fn default() -> Self {
        Self {
            scales: ScaleSet::paper_default(),
            tolerance_patches: 1.5,
            max_iterations: 2000,
            confidence: 0.995,
            score: ScoreKind::Paper,
        }
    }
}

impl RerankConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// A setting under which no candidate could be scored, or only wrongly; the error names it.
    pub fn check(&self) -> Result<(), InvalidValue> {
        self.check_scales()?;
        let tolerance = self.tolerance_patches;
        if !tolerance.is_finite() || tolerance <= 0.0 {
            let reason = format!("{tolerance} is not a positive number");
            return Err(InvalidValue::new("rerank.tolerance_patches", reason));
        }
        let iterations = self.max_iterations;
        if iterations == 0 || iterations > MOST_ITERATIONS {
            let reason = format!("{iterations} is outside 1 to {MOST_ITERATIONS}");
            return Err(InvalidValue::new("rerank.max_iterations", reason));
        }
        let confidence = self.confidence;
        let is_probability = confidence > 0.0 && confidence < 1.0;
        if !is_probability {
            let reason = format!("{confidence} is not between 0 and 1");
            return Err(InvalidValue::new("rerank.confidence", reason));
        }
        Ok(())
    }

    fn check_scales(&self) -> Result<(), InvalidValue> {
        if self.scales.is_empty() {
            let reason = "no scale combination is given, so every S would be 0";
            return Err(InvalidValue::new("rerank.scales", reason));
        }
        for (i, set) in self.scales.iter().enumerate() {
            if self.scales[..i].contains(set) {
                let reason = format!("{set} is given twice");
                return Err(InvalidValue::new("rerank.scales", reason));
            }
        }
        Ok(())
    }

    /// Everything that the order depends on besides the descriptors:
    /// `1,1+2,2+3:t1.5:i2000:c0.995`, and the score, if it is not S.
    pub fn id(&self) -> RerankId {
        let scales: Vec<String> = self.scales.iter().map(ToString::to_string).collect();
        let scales = scales.join(",");
        let tolerance = self.tolerance_patches;
        let iterations = self.max_iterations;
        let confidence = self.confidence;
        let settings = format!("{scales}:t{tolerance}:i{iterations}:c{confidence}");
        RerankId::with_score(settings, self.score)
    }
}

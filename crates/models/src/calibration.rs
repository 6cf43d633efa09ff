//! Calibrations that ship with the presets: how far the answers of a model can be trusted.

use placeformer_core::types::{Calibration, ModelId};

/// One file for each model that has a calibration.
const BUILT_IN: [&str; 1] = [include_str!(
    "../../../models/dinov2-vits14-b8.calibration.json"
)];

/// The calibration built in for `model`, if there is one.
pub fn built_in_calibration(model: &ModelId) -> Option<Calibration> {
    built_in_calibrations().find(|calibration| calibration.model() == model)
}

/// Every calibration that ships.
pub fn built_in_calibrations() -> impl Iterator<Item = Calibration> {
    // The files are part of the program and a test reads every one of them, so that none is left
    // out here.
    BUILT_IN
        .iter()
        .filter_map(|text| serde_json::from_str(text).ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_calibration_that_ships_can_be_read() {
        assert_eq!(built_in_calibrations().count(), BUILT_IN.len());
    }
}

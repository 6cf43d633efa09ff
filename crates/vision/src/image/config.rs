//! Limits for the images that are accepted.

use placeformer_core::types::InvalidValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Limits that are checked before anything is decoded.
///
/// The comments of the fields are printed as the manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ImageConfig {
    /// Most bytes of an encoded image.
    pub max_bytes: usize,
    /// Longest side in pixels.
    pub max_side: u32,
    /// Most pixels, width times height.
    pub max_pixels: u64,
    /// Most samples that the scans of a JPEG may visit, all together. Each scan visits all samples
    /// of its components: a baseline photo visits 1.5 to 3 for each pixel, a progressive one mostly
    /// 8 to 14.
    pub max_jpeg_samples: u64,
}

impl Default for ImageConfig {
    fn default() -> Self {
        Self {
            max_bytes: 20 << 20,
            max_side: 16_384,
            max_pixels: 64_000_000,
            max_jpeg_samples: 1_280_000_000,
        }
    }
}

impl ImageConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// A limit of zero, which no image could meet.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let limits = [
            ("image.max_bytes", self.max_bytes as u64),
            ("image.max_side", u64::from(self.max_side)),
            ("image.max_pixels", self.max_pixels),
            ("image.max_jpeg_samples", self.max_jpeg_samples),
        ];
        for (field, value) in limits {
            if value == 0 {
                return Err(InvalidValue::new(field, "0 would refuse every image"));
            }
        }
        Ok(())
    }
}

//! What decoding a JPEG costs, before it is paid.
//!
//! Each scan is a pass over all blocks of its components, however few bytes it has: one bit can
//! stand for thousands of blocks. So the cost is the sum over the scans of the samples that each
//! visits, and that is what is bounded: neither the number of pixels nor the number of scans says
//! much alone.

use super::super::config::ImageConfig;
use super::super::error::ImageError;
use super::syntax::Layout;

/// Checks that the scans do not visit more samples than allowed.
pub(super) fn check(layout: &Layout<'_>, config: &ImageConfig) -> Result<(), ImageError> {
    let visits = layout
        .scans
        .iter()
        .map(|scan| layout.frame.samples_of(scan));
    let samples: u64 = visits.sum();
    if samples > config.max_jpeg_samples {
        return Err(ImageError::TooManyScans {
            size: layout.frame.size,
            scans: layout.scans.len(),
            samples,
            limit: config.max_jpeg_samples,
        });
    }
    Ok(())
}

//! The row of decoding and resizing a photo.

use super::baselines;
use super::context::{Bench, agree};
use super::error::BenchError;
use super::measure::paired;
use super::row::BenchRow;
use super::scenes::{PHOTO_SIZE, photo};
use placeformer_core::types::ImageSize;

impl Bench<'_> {
    /// A large photo from its bytes to a tensor; the baseline uses the `image` crate.
    pub(super) fn decode(&self) -> Result<BenchRow, BenchError> {
        let bytes = photo()?;
        let size = self.spec.input_size;
        let ours = self.tensor(&bytes)?.data;
        let plain = baselines::load_tensor(&bytes, size)?;
        let differences = ours
            .iter()
            .zip(&plain)
            .map(|(a, b)| f64::from((a - b).abs()));
        let off = differences.sum::<f64>() / ours.len() as f64;
        agree("decode_resize_1080p", off < 0.03, || {
            format!("pixels differ by {off} on average")
        })?;

        let times = paired(
            5 * self.rounds,
            || self.tensor(&bytes),
            || baselines::load_tensor(&bytes, size),
        );
        let limit = self.decode_limit_ms(bytes.len());
        BenchRow::new("decode_resize_1080p", "image crate", times, limit)
    }

    /// Milliseconds of memory traffic: the photo is read, its pixels written and read again, the
    /// tensor written.
    pub(super) fn decode_limit_ms(&self, photo_bytes: usize) -> f64 {
        let values = |size: ImageSize| 3.0 * f64::from(size.width) * f64::from(size.height);
        let pixel_bytes = 2.0 * values(PHOTO_SIZE);
        let tensor_bytes = 4.0 * values(self.spec.input_size);
        self.limits
            .memory_ms(photo_bytes as f64 + pixel_bytes + tensor_bytes)
    }
}

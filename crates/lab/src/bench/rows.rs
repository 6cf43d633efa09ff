//! From the name of a row to its measurement.

use super::context::Bench;
use super::error::BenchError;
use super::row::BenchRow;
use placeformer_vision::extract::Precision;

impl Bench<'_> {
    /// Measures one row.
    ///
    /// # Errors
    /// The name is unknown, a stage fails, or ours and the baseline disagree about the result.
    pub fn row(&self, name: &str) -> Result<BenchRow, BenchError> {
        match name {
            "decode_resize_1080p" => self.decode(),
            "extract" => self.extract(name, self.extractor.config().precision, 1),
            "extract_batch8" => self.extract(name, self.extractor.config().precision, 8),
            "extract_f32" => self.extract(name, Precision::F32, 1),
            "extract_bf16" => self.extract(name, Precision::Bf16, 1),
            "extract_mixed" => self.extract(name, Precision::Mixed, 1),
            "extract_int8" => self.extract(name, Precision::Int8, 1),
            "load_100" => self.load(),
            "rerank_100" => self.rerank("rerank_100", 0.4),
            "rerank_100_at_15" => self.rerank("rerank_100_at_15", 0.15),
            "rerank_100_at_0" => self.rerank("rerank_100_at_0", 0.0),
            "search_10k" => self.search("search_10k", 10_000),
            "search_100k" => self.search("search_100k", 100_000),
            "search_1m" => self.search("search_1m", 1_000_000),
            "search_10m" => self.search("search_10m", 10_000_000),
            "track_1m" => self.track(),
            "query_1m" => self.query(),
            "commit" => self.commit(),
            "ingest" => self.ingest(),
            "rehead_100k" => self.rehead(),
            other => Err(BenchError::UnknownRow {
                name: other.to_owned(),
            }),
        }
    }
}

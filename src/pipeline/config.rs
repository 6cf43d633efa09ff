//! Settings of the pipeline.

use placeformer_core::types::InvalidValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Bounds and defaults that belong to no single stage. The comments of the fields are printed as
/// the manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PipelineConfig {
    /// Queries that may wait for the model or be computed at once; as many new references may,
    /// besides. One caller (a key, or an address where there are no keys) may fill these places.
    /// As many again are kept for callers that hold less than their share. Beyond, a request is
    /// answered 503 overloaded.
    pub queue_capacity: usize,
    /// Longest time in milliseconds that a query may wait for the model. Callers are served in turn,
    /// so that this depends on how many queries of its own caller are ahead of it. One that would
    /// wait longer is answered 503 overloaded at once.
    pub max_wait_ms: u64,
    /// Listings and look-ups that read the store at once. It is at least two fewer than
    /// store.readers, so that queries and changes always find a connection. One that has to wait
    /// longer than max_wait_ms is answered 503 overloaded.
    pub store_reads: usize,
    /// Changes and deletions under way at once, with the same longest wait.
    pub store_writes: usize,
    /// Bytes of key patches kept in memory for the next query.
    pub patch_cache_bytes: u64,
    /// Results of a query that does not say how many it wants.
    pub top_k: usize,
    /// Candidates re-ranked for a query that does not say how many (the paper's number is 100).
    pub candidates: usize,
    /// Most results or candidates a query may ask for.
    pub max_candidates: usize,
    /// Time in milliseconds for a query that does not say how much it has, and the most it may ask
    /// for.
    pub deadline_ms: u64,
    /// Part of a query's time in milliseconds kept back for writing the answer.
    pub answer_reserve_ms: u64,
    /// Resident bytes of the process above which nothing new is taken in; 0 means 85% of what the
    /// process may use.
    pub memory_watermark_bytes: u64,
    /// Free bytes on the store's disk below which nothing new is taken in, so that deletions have
    /// room. Whatever is set, it is at most a twentieth of the disk.
    pub disk_reserve_bytes: u64,
    /// Longest metadata of a reference in bytes of JSON.
    pub max_metadata_bytes: usize,
}

impl Default for PipelineConfig {
    fn default() -> Self {
        Self {
            queue_capacity: 64,
            max_wait_ms: 2000,
            store_reads: 4,
            store_writes: 16,
            patch_cache_bytes: 256 << 20,
            top_k: 10,
            candidates: 100,
            max_candidates: 1000,
            deadline_ms: 30_000,
            answer_reserve_ms: 5,
            memory_watermark_bytes: 0,
            disk_reserve_bytes: 64 << 20,
            max_metadata_bytes: 16 << 10,
        }
    }
}

impl PipelineConfig {
    /// Checks the rules that the types cannot express.
    ///
    /// # Errors
    /// A value is out of range.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let positive = [
            ("pipeline.queue_capacity", self.queue_capacity as u64),
            ("pipeline.max_wait_ms", self.max_wait_ms),
            ("pipeline.store_reads", self.store_reads as u64),
            ("pipeline.store_writes", self.store_writes as u64),
            ("pipeline.top_k", self.top_k as u64),
            ("pipeline.candidates", self.candidates as u64),
            ("pipeline.deadline_ms", self.deadline_ms),
        ];
        if let Some((field, _)) = positive.iter().find(|(_, value)| *value == 0) {
            return Err(InvalidValue::new(field, "0 would refuse everything"));
        }
        if self.top_k.max(self.candidates) > self.max_candidates {
            return Err(InvalidValue::new(
                "pipeline.max_candidates",
                "it is below the default top_k or candidates",
            ));
        }
        let semaphores = [
            ("pipeline.queue_capacity", self.queue_capacity),
            ("pipeline.store_reads", self.store_reads),
            ("pipeline.store_writes", self.store_writes),
        ];
        let most = tokio::sync::Semaphore::MAX_PERMITS;
        if let Some((field, _)) = semaphores.iter().find(|(_, permits)| *permits > most) {
            return Err(InvalidValue::new(field, "it is too large"));
        }
        Ok(())
    }

    /// Checks a number of results or candidates that a query asks for.
    ///
    /// # Errors
    /// It is 0 or above the bound.
    pub fn check_count(&self, field: &'static str, count: usize) -> Result<usize, InvalidValue> {
        if (1..=self.max_candidates).contains(&count) {
            Ok(count)
        } else {
            Err(InvalidValue::new(
                field,
                format!("{count} is outside 1 to {}", self.max_candidates),
            ))
        }
    }
}

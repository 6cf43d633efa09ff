//! Settings of the composition.

use placeformer_core::types::InvalidValue;
use serde::{Deserialize, Serialize};

/// Bounds and defaults that belong to no single stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PipelineConfig {
    /// Queries, and beside them references, that may wait for or be in compute; one more is told to
    /// come back later.
    pub queue_capacity: usize,
    /// Longest time a query may wait for its turn, in milliseconds; one that would wait longer is
    /// told at once.
    pub max_wait_ms: u64,
    /// Listings and look-ups that read the store at once. At least two fewer than `store.readers`,
    /// so that queries always find a connection; one that gets no turn within `max_wait_ms` is told
    /// to come back later.
    pub store_reads: usize,
    /// Changes and deletions under way at once, with the same wait.
    pub store_writes: usize,
    /// Bytes of key patches kept in memory for the next query.
    pub patch_cache_bytes: u64,
    /// Results of a query that does not say.
    pub top_k: usize,
    /// Candidates re-ranked for a query that does not say (paper: 100).
    pub candidates: usize,
    /// Most results or candidates a query may ask for.
    pub max_candidates: usize,
    /// Time allowed for a query that does not say, and the most it may ask for, in milliseconds.
    pub deadline_ms: u64,
    /// Part of a query's time kept back for writing the answer, in milliseconds.
    pub answer_reserve_ms: u64,
    /// Resident bytes above which nothing new is taken in; 0 means 85% of what the process may use.
    pub memory_watermark_bytes: u64,
    /// Free bytes on the store's disk below which nothing new is taken in (a twentieth of a small
    /// disk).
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
    /// Checks what the types cannot.
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
        let places = [
            ("pipeline.queue_capacity", self.queue_capacity),
            ("pipeline.store_reads", self.store_reads),
            ("pipeline.store_writes", self.store_writes),
        ];
        if let Some((field, _)) = places
            .iter()
            .find(|(_, places)| *places > tokio::sync::Semaphore::MAX_PERMITS)
        {
            return Err(InvalidValue::new(field, "it is too large"));
        }
        Ok(())
    }

    /// Checks a number of results or candidates that a query asks for.
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

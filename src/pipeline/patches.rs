//! Key patches of candidates: a sized cache in front of the store.

use crate::ops::Metrics;
use placeformer_core::types::{PackedPatches, ReferenceId};
use placeformer_store::{PlaceStore, StoreError};
use quick_cache::sync::Cache;
use std::sync::Arc;

/// Typical size in bytes of a reference's key patches, to size the cache's table.
const TYPICAL_BYTES: u64 = 120 << 10;

/// Key patches of the references that were candidates lately.
pub(super) struct PatchCache {
    cache: Cache<ReferenceId, Arc<PackedPatches>, ByBytes>,
    metrics: Arc<Metrics>,
}

/// Weighs an entry by the memory it takes.
#[derive(Clone)]
struct ByBytes;

impl quick_cache::Weighter<ReferenceId, Arc<PackedPatches>> for ByBytes {
    fn weight(&self, _: &ReferenceId, patches: &Arc<PackedPatches>) -> u64 {
        // The entry itself costs about a hundred bytes; a weight of zero would never be evicted.
        patches.heap_bytes() as u64 + 100
    }
}

impl PatchCache {
    /// A cache of at most `bytes`.
    pub(super) fn new(bytes: u64, metrics: Arc<Metrics>) -> Self {
        let items = (bytes / TYPICAL_BYTES).max(1) as usize;
        Self {
            cache: Cache::with_weighter(items, bytes, ByBytes),
            metrics,
        }
    }

    /// The key patches of a reference, from memory or else from the store.
    pub(super) fn load(
        &self,
        store: &dyn PlaceStore,
        id: ReferenceId,
    ) -> Result<Arc<PackedPatches>, StoreError> {
        if let Some(patches) = self.cache.get(&id) {
            self.metrics.cache_lookup(true);
            return Ok(patches);
        }
        self.metrics.cache_lookup(false);
        let patches = Arc::new(store.patches(id)?);
        self.cache.insert(id, patches.clone());
        Ok(patches)
    }

    /// Drops what belongs to a deleted reference.
    pub(super) fn forget(&self, id: ReferenceId) {
        self.cache.remove(&id);
    }

    /// Memory in use.
    pub(super) fn bytes(&self) -> u64 {
        self.cache.weight()
    }
}

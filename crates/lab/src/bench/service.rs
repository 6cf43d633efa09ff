//! The whole service, as far as the rows that measure it need it.
//!
//! The service is a package above this crate, which therefore cannot name it. The command line,
//! which knows both, passes it in.

use bytes::Bytes;
use placeformer_core::types::MapName;
use placeformer_store::CombinedStore;
use placeformer_vision::extract::Extractor;
use std::sync::Arc;

/// What the service said when it failed.
pub type ServiceError = Box<dyn std::error::Error + Send + Sync>;

/// Starts services.
pub trait StartService {
    /// A service with default settings over `store`, whose requests have no deadline that a
    /// measurement could miss.
    ///
    /// # Errors
    /// The service does not start.
    fn start(
        &self,
        store: CombinedStore,
        extractor: Arc<Extractor>,
    ) -> Result<Box<dyn MeasuredService>, ServiceError>;
}

/// A running service.
pub trait MeasuredService {
    /// Asks where `photo` was taken; says whether the answer was re-ranked.
    ///
    /// # Errors
    /// The service's.
    fn query(&self, map: &MapName, photo: &Bytes) -> Result<bool, ServiceError>;

    /// Adds each photo as a reference, at most `at_once` of them at a time; returns when all are
    /// durable and can be found.
    ///
    /// # Errors
    /// The first of the service's.
    fn ingest(&self, map: &MapName, photos: &[Bytes], at_once: usize) -> Result<(), ServiceError>;
}

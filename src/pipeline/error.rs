//! Why a request through the pipeline failed.

use super::tracks::FrameError;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{ExternalId, InvalidValue, MapName, ModelId, RerankId};
use placeformer_store::StoreError;
use placeformer_vision::extract::ExtractError;
use placeformer_vision::image::{ImageError, Uninformative};
use std::time::Duration;

/// Everything that can end a request early.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The image was refused.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The image to be stored shows nothing by which a place could be known.
    #[error("the image shows no place: {0}; allow_uninformative stores it all the same")]
    Uninformative(Uninformative),
    /// The decoder panicked on this image; the process goes on.
    #[error("the decoder failed on this image")]
    DecoderPanicked,
    /// The model failed.
    #[error(transparent)]
    Extract(#[from] ExtractError),
    /// The store refused or failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// An option is out of range.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    /// No such map.
    #[error("there is no map {0}")]
    MapNotFound(MapName),
    /// The map's descriptors cannot be compared with this server's.
    #[error("map {map} was built with model {map_model}, this server runs {server_model}")]
    ModelMismatch {
        /// The map.
        map: MapName,
        /// What it is bound to.
        map_model: ModelId,
        /// What is loaded.
        server_model: ModelId,
    },
    /// What was sent is not a head.
    #[error("what was sent is not a head")]
    HeadUnreadable(#[source] ExtractError),
    /// The map's pooled vectors, or this server's, cannot be projected with the head.
    #[error("map {map} cannot take this head")]
    HeadMismatch {
        /// The map.
        map: MapName,
        /// Why not.
        source: ExtractError,
    },
    /// The calibration was fitted on scores of another re-ranking than this server's.
    #[error(
        "the calibration for map {map} was fitted for re-ranking \"{given}\", this server's is \
         \"{server}\""
    )]
    RerankMismatch {
        /// The map.
        map: MapName,
        /// What this server does.
        server: RerankId,
        /// What the calibration was fitted on.
        given: RerankId,
    },
    /// A query is one of a track, and the map does not allow that.
    #[error("map {map} cannot be tracked in: {reason}")]
    TrackUnavailable {
        /// The map.
        map: MapName,
        /// Why not.
        reason: &'static str,
    },
    /// A frame of a track is refused.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The external id already names another image.
    #[error("external id {external_id} of map {map} belongs to another image")]
    ExternalIdConflict {
        /// The map.
        map: MapName,
        /// The id.
        external_id: ExternalId,
    },
    /// The queue is full, or the request would have to wait in it for too long.
    #[error(
        "{waiting} requests are waiting or being computed, more than can be answered soon enough"
    )]
    Overloaded {
        /// Requests in the queue.
        waiting: usize,
        /// When a place is likely to be free.
        retry_after: Duration,
    },
    /// Too many other requests read or change the store.
    #[error("the store is busy with other requests, and none of them ended soon enough")]
    StoreBusy,
    /// Resident memory is above the watermark.
    #[error(transparent)]
    MemoryPressure(#[from] crate::ops::memory::MemoryShort),
    /// The disk is almost full; the rest is kept for deletions.
    #[error("the disk that holds the store is full")]
    DiskFull,
    /// The files of the store are gone, exchanged, or cannot be written.
    #[error("the storage is lost: {0}")]
    StorageLost(String),
    /// The deadline passed before any answer was ready.
    #[error("the deadline passed before {stage} was done")]
    DeadlineExceeded {
        /// The stage that was not reached or finished.
        stage: &'static str,
    },
    /// The server is stopping.
    #[error("the server is stopping")]
    ShuttingDown,
    /// A stage panicked; the process goes on.
    #[error("{stage} failed unexpectedly")]
    Panicked {
        /// Which stage.
        stage: &'static str,
    },
}

impl PipelineError {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Image(error) => error.code(),
            Self::Uninformative(_) => ErrorCode::ImageUninformative,
            Self::DecoderPanicked => ErrorCode::ImageUndecodable,
            Self::Extract(error) => error.code(),
            Self::Store(error) => error.code(),
            Self::Invalid(_) => ErrorCode::InvalidParameter,
            Self::MapNotFound(_) => ErrorCode::MapNotFound,
            Self::ModelMismatch { .. } => ErrorCode::ModelMismatch,
            Self::HeadUnreadable(_) => ErrorCode::HeadUnreadable,
            Self::HeadMismatch { .. } => ErrorCode::HeadMismatch,
            Self::RerankMismatch { .. } => ErrorCode::CalibrationMismatch,
            Self::TrackUnavailable { .. } => ErrorCode::TrackUnavailable,
            Self::Frame(FrameError::Token(error)) => error.code(),
            Self::Frame(FrameError::Invalid(_)) => ErrorCode::InvalidParameter,
            Self::ExternalIdConflict { .. } => ErrorCode::ExternalIdConflict,
            Self::Overloaded { .. } | Self::StoreBusy => ErrorCode::Overloaded,
            Self::MemoryPressure(_) => ErrorCode::MemoryPressure,
            Self::DiskFull => ErrorCode::DiskFull,
            Self::StorageLost(_) => ErrorCode::StorageLost,
            Self::DeadlineExceeded { .. } => ErrorCode::DeadlineExceeded,
            Self::ShuttingDown => ErrorCode::ShuttingDown,
            Self::Panicked { .. } => ErrorCode::Internal,
        }
    }

    /// When trying again is likely to help, where that is known.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Overloaded { retry_after, .. } => Some(*retry_after),
            _ => None,
        }
    }
}

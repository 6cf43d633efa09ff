//! Where an import puts its photos.

use crate::cli::client::UNREACHABLE;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    Altitude, ContentHash, GeoPoint, Heading, MapName, ReferenceFields, ReferenceId, Timestamp,
};
use placeformer_store::ReferencePatch;
use std::collections::HashMap;

/// A photo on its way.
pub(super) struct Upload {
    pub(super) map: MapName,
    pub(super) fields: ReferenceFields,
    /// The file's bytes.
    pub(super) image: Bytes,
}

/// A reference that the map has: what an import compares.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Stored {
    pub(super) id: ReferenceId,
    /// Hash of the photo's bytes.
    pub(super) content: ContentHash,
    pub(super) location: Option<GeoPoint>,
    pub(super) alt: Option<Altitude>,
    pub(super) heading: Option<Heading>,
    pub(super) captured_at: Option<Timestamp>,
}

/// What became of a photo or a change.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Outcome {
    /// New and durable, under this reference id.
    Created(String),
    /// It was there before.
    Present(Stored),
    /// Changed, and durable.
    Updated,
    /// Not stored, or not changed.
    Refused {
        /// A code of the error table, or `unreachable`.
        code: String,
        /// The cause.
        detail: String,
    },
}

/// An outcome with the attempts it took.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sent {
    pub(super) outcome: Outcome,
    pub(super) attempts: u32,
}

/// Takes photos from several threads at once.
pub(super) trait Sink: Sync {
    /// What the map has, by external id. A map that does not exist has nothing.
    fn present(&self, map: &MapName) -> anyhow::Result<HashMap<String, Stored>>;

    /// Stores one photo; tries again itself where that may help.
    fn send(&self, upload: Upload) -> Sent;

    /// Changes fields of a reference; tries again itself where that may help. An import only sets
    /// fields and never clears any.
    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Sent;
}

/// Whether every other photo would fail with this code, too.
pub(super) fn is_hopeless(code: &str) -> bool {
    let hopeless = [
        ErrorCode::Unauthorized,
        ErrorCode::Forbidden,
        ErrorCode::ModelMismatch,
        ErrorCode::DiskFull,
        ErrorCode::StorageLost,
        ErrorCode::RouteNotFound,
        ErrorCode::ShuttingDown,
    ];
    code == UNREACHABLE || hopeless.iter().any(|known| known.as_str() == code)
}

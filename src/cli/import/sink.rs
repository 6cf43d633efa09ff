//! Where an import puts its photos.

use crate::cli::client::UNREACHABLE;
use bytes::Bytes;
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{MapName, ReferenceFields};
use std::collections::HashMap;

/// A photo on its way.
pub(super) struct Upload {
    pub(super) map: MapName,
    pub(super) fields: ReferenceFields,
    /// The file's bytes.
    pub(super) image: Bytes,
}

/// What became of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Outcome {
    /// New and durable, under this reference id.
    Created(String),
    /// It was there before, under this reference id.
    Present(String),
    /// Not stored.
    Refused {
        /// A code of the error table, or `unreachable`.
        code: String,
        /// The cause.
        detail: String,
    },
}

/// An outcome with the attempts it took.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Sent {
    pub(super) outcome: Outcome,
    pub(super) attempts: u32,
}

/// Takes photos from several threads at once.
pub(super) trait Sink: Sync {
    /// What the map has: the SHA-256 of the content, in hexadecimal, by external id. A map that
    /// does not exist has nothing.
    fn present(&self, map: &MapName) -> anyhow::Result<HashMap<String, String>>;

    /// Stores one photo; tries again itself where that may help.
    fn send(&self, upload: Upload) -> Sent;
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

//! What the caller of one request may do, as the check of its key found out.

use super::map_scope::MapScope;
use super::problem::ApiError;
use crate::pipeline::{Caller, PipelineError, Service};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{MapName, ReferenceId};
use placeformer_store::StoreError;
use std::sync::Arc;

/// Who a request is from and which maps exist for it. [`super::authorise`] adds it to every request
/// that reaches a handler.
///
/// A map that the caller may not use is refused by its name, whether it exists or not, so that the
/// answer (403) says nothing about it. A reference is refused by its map, which only the store
/// knows; so the answer is that of a reference that does not exist (404).
#[derive(Debug, Clone)]
pub struct Access {
    /// Whose turn the request takes.
    pub caller: Caller,
    /// The maps that the caller may use.
    pub maps: MapScope,
}

impl Access {
    /// Lets a request through that names a map.
    ///
    /// # Errors
    /// `forbidden` if the caller's key is limited to others.
    pub fn check_map(&self, map: &MapName) -> Result<(), ApiError> {
        if self.maps.allows(map) {
            return Ok(());
        }
        let detail = format!("this key is limited to other maps than {map}");
        Err(ApiError::new(ErrorCode::Forbidden, detail))
    }

    /// Lets a request through that names a reference.
    ///
    /// # Errors
    /// `reference_not_found` if there is none, or if its map is one that the caller may not use.
    pub async fn check_reference(
        &self,
        service: &Arc<Service>,
        id: ReferenceId,
    ) -> Result<(), ApiError> {
        // Without a limit the map does not matter.
        if self.maps == MapScope::All {
            return Ok(());
        }
        let map = service.map_of(&self.caller, id).await?;
        if self.maps.allows(&map) {
            return Ok(());
        }
        let hidden = StoreError::ReferenceNotFound { id };
        Err(PipelineError::from(hidden).into())
    }
}

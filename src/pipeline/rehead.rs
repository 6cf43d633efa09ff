//! Giving a map another head while it is searched.
//!
//! The store writes the new global vectors next to the old ones, and a new index grows with them.
//! Meanwhile queries use the old index, and inserts go into both. Inserts and changes of this map
//! have to wait only while the new index replaces the old one, which takes one small commit,
//! because by then the new index lacks only the last references. A query keeps the index it began
//! with, so no answer mixes two heads.

use super::maps::{Change, LiveMap, MapEntry, Projection, index_entry};
use super::{Caller, PipelineError, Service};
use bytes::Bytes;
use placeformer_core::types::{MapName, ModelId};
use placeformer_store::{GlobalRow, HeadExchange, MapInfo, NewHead, StoreError};
use placeformer_vision::extract::{ExtractError, Head};
use placeformer_vision::search::{IndexBuilder, MapIndex};
use rayon::prelude::*;
use std::path::Path;
use std::sync::{Arc, RwLockWriteGuard};

impl Service {
    /// Gives a map the head in `file`, which it keeps whatever head the server runs; without a
    /// file, the server's own.
    ///
    /// Cancel safety: dropped before it began, nothing is done; dropped later, the exchange runs to
    /// its end.
    ///
    /// # Errors
    /// There is no such map; the file is not a head, or not one for the map's and the server's
    /// backbone; another head is being prepared; disk or memory is short; the store fails.
    pub async fn set_head(
        self: &Arc<Self>,
        caller: &Caller,
        map: MapName,
        file: Option<Bytes>,
    ) -> Result<MapInfo, PipelineError> {
        self.may_store()?;
        self.run_limited(&self.heads, caller, move |service| {
            service.set_head_now(&map, file.as_deref())
        })
        .await
    }

    fn set_head_now(&self, name: &MapName, file: Option<&[u8]>) -> Result<MapInfo, PipelineError> {
        let (entry, _) = self.existing(name)?;
        let journal = Journal::begin(&entry)
            .ok_or_else(|| StoreError::ReheadInProgress { map: name.clone() })?;
        let (_, old) = self.existing(name)?;
        let new = self.fitting_head(name, file, &old.model)?;
        let has_it_already = match old.projection {
            Projection::Server => file.is_none() && old.model == new.model,
            Projection::Own(_) => file.is_some() && old.model == new.model,
            Projection::Foreign | Projection::Lost => false,
        };
        if !has_it_already {
            self.exchange(name, &entry, journal, new)?;
        }
        Ok(self.store.map(name)?)
    }

    /// The head wanted, if both the map's stored vectors and this server's queries can be projected
    /// with it.
    fn fitting_head(
        &self,
        name: &MapName,
        file: Option<&[u8]>,
        map_model: &ModelId,
    ) -> Result<FittingHead, PipelineError> {
        let server_model = self.extraction.source().model_id();
        let mismatch = |source| PipelineError::HeadMismatch {
            map: name.clone(),
            source,
        };
        let head = match file {
            Some(file) => Head::from_bytes(file, Path::new("the file sent"))
                .map_err(PipelineError::HeadUnreadable)?,
            None => self.server_head().map_err(mismatch)?,
        };
        let model = head.rebind(map_model).map_err(mismatch)?;
        if head.rebind(server_model).map_err(mismatch)? != model {
            return Err(PipelineError::ModelMismatch {
                map: name.clone(),
                map_model: map_model.clone(),
                server_model: server_model.clone(),
            });
        }
        Ok(FittingHead {
            head: Arc::new(head),
            model,
            file: file.map(<[u8]>::to_vec),
        })
    }

    fn server_head(&self) -> Result<Head, ExtractError> {
        let source = self.extraction.source();
        let head = source.head().ok_or_else(|| ExtractError::NoHead {
            backbone: source.model_id().to_string(),
        })?;
        Ok(head.clone())
    }

    /// Makes the map's new vectors, in the store and in a new index, and puts the index in force.
    fn exchange(
        &self,
        name: &MapName,
        entry: &MapEntry,
        journal: Journal<'_>,
        new: FittingHead,
    ) -> Result<(), PipelineError> {
        let projection = match new.file {
            Some(_) => Projection::Own(new.head.clone()),
            None => Projection::Server,
        };
        let stored = NewHead {
            model: new.model.clone(),
            file: new.file,
        };
        let mut exchange = Exchange {
            entry,
            head: new.head,
            entries: IndexBuilder::default(),
            index: None,
            changing: None,
        };
        self.store.replace_globals(name, stored, &mut exchange)?;

        let Exchange {
            index,
            entries,
            changing,
            ..
        } = exchange;
        let index = index.unwrap_or_else(|| entries.finish());
        // The new index is in force before it reads the journal. Damage that is found in between is
        // therefore either in the journal, or taken out of the new index by whoever found it.
        let live = entry.put(LiveMap::new(new.model, projection, index, None));
        for change in journal.end() {
            change.apply(&live.index);
        }
        tracing::info!(
            map = %name,
            references = live.index.len(),
            model = %live.model,
            "the map has another head"
        );
        drop(changing);
        Ok(())
    }
}

/// A head that a map can be given.
struct FittingHead {
    head: Arc<Head>,
    /// The map's model with it.
    model: ModelId,
    /// The file that the map keeps; none for the server's own head.
    file: Option<Vec<u8>>,
}

/// Keeps the journal of a map's changes while it lives.
struct Journal<'a>(&'a MapEntry);

impl<'a> Journal<'a> {
    /// `None` while another journal is kept, because a map is given one head at a time.
    fn begin(entry: &'a MapEntry) -> Option<Self> {
        entry.begin_journal().then_some(Self(entry))
    }

    /// The changes since the beginning.
    fn end(self) -> Vec<Change> {
        self.0.end_journal()
    }
}

impl Drop for Journal<'_> {
    fn drop(&mut self) {
        self.0.end_journal();
    }
}

/// The new index, which grows as the store converts its references.
struct Exchange<'a> {
    entry: &'a MapEntry,
    head: Arc<Head>,
    entries: IndexBuilder,
    /// Present once all references that were there at the beginning are converted.
    index: Option<MapIndex>,
    /// Keeps inserts and changes waiting from then until the new index is in force.
    changing: Option<RwLockWriteGuard<'a, ()>>,
}

impl HeadExchange for Exchange<'_> {
    fn project(&mut self, pooled: &[Vec<f32>]) -> Result<Vec<Vec<f32>>, StoreError> {
        pooled
            .par_iter()
            .map(|pooled| self.head.project_stored(pooled))
            .collect::<Result<_, _>>()
            .map_err(|error| StoreError::HeadNotApplied {
                source: error.into(),
            })
    }

    fn converted(&mut self, row: GlobalRow) {
        match &self.index {
            Some(index) => index.insert(index_entry(row)),
            None => self.entries.push(index_entry(row)),
        }
    }

    fn finishing(&mut self) {
        self.index = Some(std::mem::take(&mut self.entries).finish());
        self.changing = Some(self.entry.lock_for_change());
    }
}

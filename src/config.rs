//! Settings: defaults < file < environment < flags, checked once.
//!
//! [`Config`] is every room's own settings under one roof. [`Config::load`] reads them from all
//! sources, refuses what it does not know by name, and checks the rest;
//! [`Config::to_annotated_toml`] prints what is in force with a comment on every key, so that the
//! printed file is the manual.
//!
//! An environment variable names its key with `__` between the levels:
//! `PLACEFORMER_HTTP__LISTEN=0.0.0.0:80` is `listen` of `[http]`.

use crate::http::{AuthConfig, HttpConfig};
use crate::ops::LogConfig;
use crate::pipeline::PipelineConfig;
use figment::Figment;
use figment::providers::{Env, Format, Serialized, Toml};
use placeformer_core::types::InvalidValue;
use placeformer_store::StoreConfig;
use placeformer_vision::extract::{ExtractConfig, HeadChoice, Precision, Preset};
use placeformer_vision::image::ImageConfig;
use placeformer_vision::rerank::RerankConfig;
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::path::{Path, PathBuf};

mod manual;

/// Prefix of the environment variables.
const PREFIX: &str = "PLACEFORMER_";

/// Reading connections that listings and look-ups leave alone: one for queries, one for changes.
const READERS_KEPT_FREE: usize = 2;

/// Every setting of the service.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Where the data lives.
    pub data: DataLocation,
    /// Connections, bodies, draining.
    pub http: HttpConfig,
    /// Keys and paces.
    pub auth: AuthConfig,
    /// The database.
    pub store: StoreConfig,
    /// Queue, cache, defaults of queries, watermarks.
    pub pipeline: PipelineConfig,
    /// Limits of images.
    pub image: ImageConfig,
    /// Model and descriptor.
    pub extract: ExtractConfig,
    /// Matching and verification.
    pub rerank: RerankConfig,
    /// Logs.
    pub log: LogConfig,
}

/// Where the data lives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DataLocation {
    /// Directory of the store; made if it is not there.
    pub directory: PathBuf,
}

impl Default for DataLocation {
    fn default() -> Self {
        Self {
            directory: PathBuf::from("placeformer-data"),
        }
    }
}

/// Settings given on the command line; absent ones leave the other sources in force.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
pub struct Overrides {
    /// Address and port to listen on; port 0 picks a free one.
    #[arg(long, value_name = "ADDR")]
    pub listen: Option<String>,
    /// Directory of the store.
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Log lines for people or as JSON.
    #[arg(long, value_enum)]
    pub log_format: Option<crate::ops::LogFormat>,
    /// Log filter, such as `info` or `placeformer=debug`.
    #[arg(long, value_name = "FILTER")]
    pub log: Option<String>,
    /// The model.
    #[command(flatten)]
    pub model: ModelOverrides,
}

/// The model of a service, given on the command line.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
#[command(next_help_heading = "Model")]
pub struct ModelOverrides {
    /// Backbone: dinov2-vits14, dinov2-vitb14, dinov2-vitl14 or placeformer-vits16.
    #[arg(long, value_name = "NAME")]
    pub preset: Option<Preset>,
    /// Weights file for the backbone, such as `train` writes; its published ones are pulled on
    /// first use otherwise.
    #[arg(long, env = "PLACEFORMER_WEIGHTS", value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Projection to the global descriptor: default, or a file.
    #[arg(long, value_name = "HEAD")]
    pub head: Option<HeadChoice>,
    /// Arithmetic of the transformer: f32, bf16, int8, mixed (int8 in the blocks where it shows
    /// least, bf16 in the others), or auto (mixed where the CPU has AVX-512 VNNI, else f32).
    #[arg(long, value_name = "NAME")]
    pub precision: Option<Precision>,
}

/// Why the settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file is not there or cannot be read.
    #[error("cannot read the configuration file {path}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A key is unknown or has the wrong type.
    #[error("the configuration is not valid: {0}")]
    Invalid(#[from] Box<figment::Error>),
    /// A variable looks like a setting but its levels are joined by one underscore.
    #[error(
        "{name} is not a setting: write the section and the key with two underscores between, such as {hint}"
    )]
    Variable {
        /// The variable.
        name: String,
        /// How it is probably meant.
        hint: String,
    },
    /// A value is out of range.
    #[error("the configuration is not valid: {0}")]
    Value(#[from] InvalidValue),
    /// A setting of the model breaks its rule.
    #[error("the configuration is not valid: extract.{0}")]
    Extract(#[source] InvalidValue),
    /// Without a head there is no global descriptor to search by.
    #[error(
        "the configuration is not valid: extract.head: a service cannot run with \"none\", because maps are searched by \
         the head's output; leave it at \"default\" or name a file (`placeformer head fit` makes one)"
    )]
    NoHead,
    /// The log filter cannot be parsed.
    #[error(transparent)]
    Filter(#[from] crate::ops::logging::InvalidFilter),
    /// The settings cannot be written as TOML.
    #[error("the configuration cannot be printed")]
    Print(#[from] toml::ser::Error),
}

impl Config {
    /// Reads all sources and checks the result.
    pub fn load(file: Option<&Path>, overrides: &Overrides) -> Result<Self, ConfigError> {
        let mut sources = Figment::from(Serialized::defaults(Self::default()));
        if let Some(path) = file {
            let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Unreadable {
                path: path.to_owned(),
                source,
            })?;
            sources = sources.merge(Toml::string(&text));
        }
        check_variables(std::env::vars_os().filter_map(|(name, _)| name.into_string().ok()))?;
        sources = sources.merge(environment());
        let mut config: Self = sources.extract().map_err(Box::new)?;
        config.apply(overrides);
        config.check()?;
        Ok(config)
    }

    fn apply(&mut self, overrides: &Overrides) {
        let Overrides {
            listen,
            data,
            log_format,
            log,
            model,
        } = overrides.clone();
        self.http.listen = listen.unwrap_or_else(|| std::mem::take(&mut self.http.listen));
        self.data.directory = data.unwrap_or_else(|| std::mem::take(&mut self.data.directory));
        self.log.format = log_format.unwrap_or(self.log.format);
        self.log.filter = log.unwrap_or_else(|| std::mem::take(&mut self.log.filter));
        let ModelOverrides {
            preset,
            weights,
            head,
            precision,
        } = model;
        self.extract.preset = preset.unwrap_or(self.extract.preset);
        self.extract.weights = weights.or_else(|| self.extract.weights.take());
        self.extract.head = head.unwrap_or_else(|| std::mem::take(&mut self.extract.head));
        self.extract.precision = precision.unwrap_or(self.extract.precision);
    }

    fn check(&self) -> Result<(), ConfigError> {
        self.http.check()?;
        self.auth.check()?;
        self.pipeline.check()?;
        self.image.check()?;
        self.store.check()?;
        self.rerank.check()?;
        if self.pipeline.store_reads.saturating_add(READERS_KEPT_FREE) > self.store.readers {
            let reason = format!("it must be at least {READERS_KEPT_FREE} less than store.readers");
            return Err(InvalidValue::new("pipeline.store_reads", reason).into());
        }
        // Each of its errors names the key without its section.
        self.extract.encoder_spec().map_err(ConfigError::Extract)?;
        if self.extract.head == HeadChoice::None {
            return Err(ConfigError::NoHead);
        }
        self.log.check()?;
        Ok(())
    }

    /// The settings in force as TOML, each key under its explanation.
    pub fn to_annotated_toml(&self) -> Result<String, ConfigError> {
        let sections = toml::Table::try_from(self)?;
        let mut text = String::from(manual::INTRODUCTION);
        for (section, keys) in &sections {
            let described = manual::section(section);
            // Writing to a string cannot fail.
            let _ = write!(text, "\n[{section}]\n");
            for (key, value) in keys.as_table().into_iter().flatten() {
                let comment = described
                    .iter()
                    .find(|(name, _)| name == key)
                    .map_or("", |(_, comment)| comment);
                let _ = writeln!(text, "{}{key} = {value}", commented(comment));
            }
            for (key, comment) in described.iter().filter(|(key, _)| keys.get(key).is_none()) {
                let _ = writeln!(text, "{}# {key} =", commented(comment));
            }
        }
        Ok(text)
    }
}

fn commented(comment: &str) -> String {
    comment.lines().map(|line| format!("# {line}\n")).collect()
}

/// Variables with two underscores; the others belong to single commands and tests.
fn environment() -> Env {
    Env::prefixed(PREFIX)
        .filter(|name| name.as_str().contains("__"))
        .split("__")
}

/// A variable that names a section but not in the right form would silently do nothing: it is
/// refused.
fn check_variables(names: impl Iterator<Item = String>) -> Result<(), ConfigError> {
    for name in names {
        let Some(rest) = name
            .strip_prefix(PREFIX)
            .filter(|rest| !rest.contains("__"))
        else {
            continue;
        };
        let rest = rest.to_ascii_lowercase();
        let section = manual::SECTIONS.iter().find_map(|(section, keys)| {
            let key = rest.strip_prefix(section)?.strip_prefix('_')?;
            keys.iter()
                .any(|(known, _)| *known == key)
                .then_some((section, key))
        });
        if let Some((section, key)) = section {
            let hint = format!("{PREFIX}{}__{}", section.to_uppercase(), key.to_uppercase());
            return Err(ConfigError::Variable { name, hint });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from_toml(text: &str) -> Result<Config, ConfigError> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("placeformer.toml");
        std::fs::write(&path, text).unwrap();
        Config::load(Some(&path), &Overrides::default())
    }

    #[test]
    fn the_file_changes_what_it_names_and_flags_win() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("placeformer.toml");
        std::fs::write(&path, "[http]\nlisten = \"[::1]:1\"\nmax_page = 7\n").unwrap();
        let model = ModelOverrides {
            weights: Some("own.safetensors".into()),
            head: Some(HeadChoice::File("head.safetensors".into())),
            ..Default::default()
        };
        let overrides = Overrides {
            listen: Some("127.0.0.1:0".into()),
            model,
            ..Default::default()
        };
        let config = Config::load(Some(&path), &overrides).unwrap();
        assert_eq!(config.extract.weights, Some("own.safetensors".into()));
        assert_eq!(
            config.extract.head,
            HeadChoice::File("head.safetensors".into())
        );
        assert_eq!(
            (config.http.listen.as_str(), config.http.max_page),
            ("127.0.0.1:0", 7)
        );
        assert_eq!(config.pipeline, PipelineConfig::default());
    }

    #[test]
    fn unknown_keys_and_wrong_types_are_named() {
        for (text, named) in [
            ("[http]\nlisten_on = \"x\"", "listen_on"),
            ("[web]\nlisten = \"x\"", "web"),
            ("[http]\nmax_page = \"many\"", "max_page"),
            ("[pipeline]\nqueue_capacity = 0", "queue_capacity"),
            ("[pipeline]\nstore_reads = 7", "store_reads"),
            ("[store]\nreaders = 5", "store_reads"),
            ("[log]\nfilter = \"placeformer=loud\"", "loud"),
            ("[rerank]\nscales = []", "rerank.scales"),
            (
                "[rerank]\nscales = [\"1+2\", \"1\", \"1+2\"]",
                "1+2 is given twice",
            ),
            (
                "[rerank]\ntolerance_patches = 0.0",
                "rerank.tolerance_patches",
            ),
            (
                "[rerank]\ntolerance_patches = nan",
                "rerank.tolerance_patches",
            ),
            (
                "[rerank]\ntolerance_patches = inf",
                "rerank.tolerance_patches",
            ),
            ("[rerank]\nmax_iterations = 0", "rerank.max_iterations"),
            (
                "[rerank]\nmax_iterations = 1000001",
                "rerank.max_iterations",
            ),
            ("[rerank]\nconfidence = 1.0", "rerank.confidence"),
            ("[rerank]\nconfidence = 0.0", "rerank.confidence"),
            ("[store]\npage_bytes = 5000", "store.page_bytes"),
            ("[store]\npage_bytes = 2048", "store.page_bytes"),
            ("[store]\npage_bytes = 131072", "store.page_bytes"),
            ("[store]\nreaders = 0", "store.readers"),
            ("[store]\nqueue = 0", "store.queue"),
            ("[store]\ncache_kib = 0", "store.cache_kib"),
            ("[image]\nmax_bytes = 0", "image.max_bytes"),
            ("[image]\nmax_side = 0", "image.max_side"),
            ("[image]\nmax_pixels = 0", "image.max_pixels"),
            ("[extract]\nexit_block = 12", "extract.exit_block"),
            ("[extract]\nhead = \"none\"", "extract.head"),
            (
                "[[auth.keys]]\nname = \"a\"\nsha256 = \"12\"\nrole = \"read\"",
                "sha256",
            ),
        ] {
            let error = from_toml(text).unwrap_err().to_string();
            assert!(error.contains(named), "{error:?} does not name {named:?}");
        }
    }

    #[test]
    fn the_printed_configuration_reads_back_the_same() {
        let mut config = Config::default();
        config.http.max_page = 33;
        config.auth.keys.push(crate::http::ApiKey {
            name: "fleet".into(),
            sha256: "ab".repeat(32),
            role: crate::http::Role::Read,
            requests_per_second: None,
        });
        assert_eq!(
            from_toml(&config.to_annotated_toml().unwrap()).unwrap(),
            config
        );
    }

    #[test]
    fn every_key_is_explained_and_every_explanation_has_its_key() {
        let sections = toml::Table::try_from(Config::default()).unwrap();
        for (section, keys) in &sections {
            for (key, _) in keys.as_table().unwrap() {
                assert!(
                    manual::section(section).iter().any(|(name, _)| name == key),
                    "{section}.{key} is unexplained"
                );
            }
        }
        for (section, keys) in manual::SECTIONS {
            for (key, _) in *keys {
                let text = format!("[{section}]\n{key} = {{ nonsense = 1 }}");
                let error = from_toml(&text).unwrap_err().to_string();
                assert!(
                    !error.contains("unknown field: found"),
                    "{section}.{key} is explained but unknown: {error}"
                );
            }
        }
    }

    #[test]
    fn variables_with_one_underscore_too_few_are_refused() {
        let names = |name: &str| check_variables(std::iter::once(name.to_owned()));
        let error = names("PLACEFORMER_HTTP_LISTEN").unwrap_err().to_string();
        assert!(error.contains("PLACEFORMER_HTTP__LISTEN"), "{error}");
        for fine in [
            "PLACEFORMER_HTTP__LISTEN",
            "PLACEFORMER_CACHE",
            "HTTP_LISTEN",
        ] {
            assert!(names(fine).is_ok(), "{fine}");
        }
    }
}

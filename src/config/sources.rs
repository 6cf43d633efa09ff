//! Where settings come from, remembered so that an error can name its source.
//!
//! The defaults, the configuration file and the environment are merged key by key by `figment`,
//! which keeps for each value what it was read from. Flags are laid over the result by the caller,
//! and are asked first for the origin of a value.

use super::error::{ConfigError, Origin};
use super::manual::Section;
use super::overrides::Overrides;
use figment::providers::{Format, Serialized, Toml};
use figment::value::{Dict, Map, Value};
use figment::{Figment, Metadata, Profile, Provider};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::borrow::Cow;
use std::ffi::OsString;
use std::path::Path;

/// Prefix of the environment variables.
const PREFIX: &str = "PLACEFORMER_";

/// Separates section and key in an environment variable.
const SEPARATOR: &str = "__";

/// The source of a value that nobody set.
const DEFAULTS: &str = "the defaults";

/// All sources of settings, merged.
pub(super) struct Sources<'a> {
    merged: Figment,
    overrides: &'a Overrides,
    sections: &'a [Section],
}

impl<'a> Sources<'a> {
    /// The defaults and the command line; the sources added win over the defaults and over those
    /// added earlier.
    pub(super) fn new(
        defaults: impl Serialize,
        overrides: &'a Overrides,
        sections: &'a [Section],
    ) -> Self {
        let defaults = Named::new(DEFAULTS, Serialized::defaults(defaults));
        Self {
            merged: Figment::from(defaults),
            overrides,
            sections,
        }
    }

    /// Adds the configuration file.
    ///
    /// # Errors
    /// It cannot be read. Whether it is TOML is seen by [`Sources::extract`].
    pub(super) fn add_file(&mut self, path: &Path) -> Result<(), ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let name = format!("the configuration file {}", path.display());
        self.add(Named::new(name, Toml::string(&text)));
        Ok(())
    }

    /// Adds the environment variables that name a setting. Those without two underscores belong to
    /// single commands and tests.
    ///
    /// # Errors
    /// A variable joins a section and its key by one underscore, so that it would silently do
    /// nothing.
    pub(super) fn add_environment(
        &mut self,
        variables: impl Iterator<Item = (OsString, OsString)>,
    ) -> Result<(), ConfigError> {
        for (name, value) in variables {
            let name = name.to_string_lossy();
            let Some(rest) = without_prefix(name.trim()) else {
                continue;
            };
            let rest = rest.to_ascii_lowercase();
            if rest.contains(SEPARATOR) {
                self.add_variable(&name, &rest, &value.to_string_lossy());
            } else if let Some((section, key)) = self.as_setting(&rest) {
                let hint = format!("{PREFIX}{section}{SEPARATOR}{key}").to_uppercase();
                let name = name.into_owned();
                return Err(ConfigError::Variable { name, hint });
            }
        }
        Ok(())
    }

    fn add_variable(&mut self, name: &str, levels: &str, value: &str) {
        let key = levels.replace(SEPARATOR, ".");
        if key.split('.').any(str::is_empty) {
            return;
        }
        let Ok(value) = value.parse::<Value>();
        let source = format!("the environment variable {name}");
        self.add(Named::new(source, Serialized::default(&key, value)));
    }

    fn add(&mut self, source: impl Provider) {
        self.merged = std::mem::take(&mut self.merged).merge(source);
    }

    /// Section and key, if `text` is both of them joined by one underscore.
    fn as_setting<'t>(&self, text: &'t str) -> Option<(&'a str, &'t str)> {
        self.sections.iter().find_map(|section| {
            let key = text.strip_prefix(&section.name)?.strip_prefix('_')?;
            let known = section.settings.iter().any(|setting| setting.name == key);
            known.then_some((section.name.as_str(), key))
        })
    }

    /// The values of all sources but the command line.
    ///
    /// # Errors
    /// A source cannot be parsed, or a key is unknown or has the wrong type.
    pub(super) fn extract<T: DeserializeOwned>(&self) -> Result<T, ConfigError> {
        let values = self.merged.extract();
        values.map_err(|error| ConfigError::Invalid(Box::new(error)))
    }

    /// What set `keys`; those that nobody set are left out.
    pub(super) fn origins(&self, keys: &[&str]) -> Vec<Origin> {
        keys.iter().filter_map(|key| self.origin(key)).collect()
    }

    /// The flag, the variable or the file that set `key`; `None` for a default.
    fn origin(&self, key: &str) -> Option<Origin> {
        let metadata = self.merged.find_metadata(key);
        let setter = match (self.overrides.flag_of(key), metadata) {
            (Some(flag), _) => format!("the flag {flag}"),
            (None, Some(metadata)) if metadata.name != DEFAULTS => metadata.name.to_string(),
            (None, _) => return None,
        };
        Some(Origin {
            key: key.to_owned(),
            setter,
        })
    }

    /// The error for a value that breaks a rule. Besides `key`, the rule may be about `others`.
    pub(super) fn refuse(&self, key: &str, reason: String, others: &[&str]) -> ConfigError {
        let keys = [&[key], others].concat();
        let mut origins = self.origins(&keys);
        if origins.is_empty() {
            // The value is a default, so that it broke the rule together with another setting.
            origins = self.origins_in_section_of(key);
        }
        ConfigError::Value {
            key: key.to_owned(),
            reason,
            origins,
        }
    }

    fn origins_in_section_of(&self, key: &str) -> Vec<Origin> {
        let name = key.split('.').next().unwrap_or_default();
        let section = self.sections.iter().find(|section| section.name == name);
        let settings = section.into_iter().flat_map(|section| &section.settings);
        settings
            .filter_map(|setting| self.origin(&format!("{name}.{}", setting.name)))
            .collect()
    }
}

/// Values under a name for their source that users understand.
struct Named<P> {
    metadata: Metadata,
    values: P,
}

impl<P: Provider> Named<P> {
    fn new(name: impl Into<Cow<'static, str>>, values: P) -> Self {
        // Errors write a key as the manual does: `http.listen`.
        let dotted = |_: &Profile, levels: &[&str]| levels.join(".");
        Self {
            metadata: Metadata::named(name).interpolater(dotted),
            values,
        }
    }
}

impl<P: Provider> Provider for Named<P> {
    fn metadata(&self) -> Metadata {
        self.metadata.clone()
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        self.values.data()
    }
}

/// The rest of a variable's name behind the prefix, in which case does not matter.
fn without_prefix(name: &str) -> Option<&str> {
    let (prefix, rest) = name.split_at_checked(PREFIX.len())?;
    prefix.eq_ignore_ascii_case(PREFIX).then_some(rest)
}

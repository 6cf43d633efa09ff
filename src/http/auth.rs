//! Keys and rates together, because both are replaced together while the server runs.

use super::api_keys::ApiKeys;
use super::config::AuthConfig;
use super::rate_limits::RateLimits;
use crate::ops::Metrics;
use placeformer_core::types::InvalidValue;
use std::sync::Arc;

/// Everything that the settings say about who may do what, and how often.
pub struct Auth {
    /// The settings that it was made of.
    config: AuthConfig,
    /// The keys that are accepted.
    pub keys: ApiKeys,
    /// How many requests a second each caller may send.
    pub rates: RateLimits,
    /// Unknown keys that one address may present in a minute; 0 is no bound.
    pub failed_keys_per_minute: u32,
}

impl Auth {
    /// Checks the settings and takes them over.
    ///
    /// # Errors
    /// A key is not valid.
    pub fn new(config: &AuthConfig, metrics: Arc<Metrics>) -> Result<Self, InvalidValue> {
        Ok(Self {
            keys: ApiKeys::new(config)?,
            rates: RateLimits::new(config, metrics),
            failed_keys_per_minute: config.failed_keys_per_minute,
            config: config.clone(),
        })
    }

    /// What takes the place of this one when the settings are read again; `None` if nothing has
    /// changed. Callers whose rate stays the same do not begin anew with it.
    ///
    /// # Errors
    /// A key is not valid, or no key is left: that would open the service to everyone, and a file
    /// that is being written is empty for a moment.
    pub fn renewed(&self, config: &AuthConfig) -> Result<Option<Self>, InvalidValue> {
        if *config == self.config {
            return Ok(None);
        }
        if config.keys.is_empty() && !self.config.keys.is_empty() {
            let reason = "there is none left; restart the server to open it to everyone";
            return Err(InvalidValue::new("auth.keys", reason));
        }
        Ok(Some(Self {
            keys: ApiKeys::new(config)?,
            rates: self.rates.renewed(config),
            failed_keys_per_minute: config.failed_keys_per_minute,
            config: config.clone(),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::super::config::{ApiKey, Role};
    use super::*;

    fn config(names: &[&str]) -> AuthConfig {
        let key = |name: &&str| ApiKey {
            name: (*name).to_owned(),
            sha256: std::iter::once(hex::encode([name.len() as u8; 32])).collect(),
            role: Role::Read,
            requests_per_second: None,
            maps: None,
        };
        AuthConfig {
            keys: names.iter().map(key).collect(),
            ..Default::default()
        }
    }

    #[test]
    fn settings_read_again_replace_the_old_ones_only_if_they_are_good() {
        let metrics = Arc::new(Metrics::new().unwrap());
        let auth = Auth::new(&config(&["a", "bb"]), metrics.clone()).unwrap();
        assert!(auth.renewed(&config(&["a", "bb"])).unwrap().is_none());
        assert!(auth.renewed(&config(&["a"])).unwrap().is_some());
        assert!(
            auth.renewed(&config(&["a", "b"])).is_err(),
            "two keys have one hash"
        );
        assert!(
            auth.renewed(&config(&[])).is_err(),
            "the service would be open"
        );
        let open = Auth::new(&config(&[]), metrics).unwrap();
        assert!(open.renewed(&config(&["a"])).unwrap().is_some());
    }
}

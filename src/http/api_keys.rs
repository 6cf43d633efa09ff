//! API keys: who a request comes from, and what that caller may do.
//!
//! Only hashes of the keys are kept, and they are compared in constant time, so that neither a leak
//! of the settings nor the time of an answer gives a key away.

use super::config::{AuthConfig, Role};
use super::map_scope::MapScope;
use super::problem::ApiError;
use axum::http::{HeaderMap, header};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::InvalidValue;
use sha2::{Digest, Sha256};
use std::sync::Arc;
use subtle::ConstantTimeEq;

/// Length of `"Bearer "`.
const BEARER_PREFIX_BYTES: usize = 7;

/// The accepted keys, ready to compare.
pub struct ApiKeys {
    keys: Vec<KnownKey>,
    protect_metrics: bool,
}

/// Whose keys they are, and what they allow.
#[derive(Debug, PartialEq)]
pub struct Holder {
    /// The name in the settings.
    pub name: Arc<str>,
    /// What the holder may do.
    pub role: Role,
    /// Where.
    pub maps: MapScope,
}

/// One of the keys of a holder, who may have several.
struct KnownKey {
    /// SHA-256 of the key.
    hash: [u8; 32],
    holder: Arc<Holder>,
}

impl ApiKeys {
    /// Checks the configured keys and takes them over.
    ///
    /// # Errors
    /// A name is empty or used twice, or a hash is not one or is used twice.
    pub fn new(config: &AuthConfig) -> Result<Self, InvalidValue> {
        config.check()?;
        let mut keys = Vec::with_capacity(config.keys.len());
        for key in &config.keys {
            let holder = Arc::new(Holder {
                name: key.name.as_str().into(),
                role: key.role,
                maps: MapScope::of(key.maps.as_deref()),
            });
            for hash in key.hashes()? {
                keys.push(KnownKey {
                    hash,
                    holder: holder.clone(),
                });
            }
        }
        Ok(Self {
            keys,
            protect_metrics: config.protect_metrics,
        })
    }

    /// Whether there are no keys, so that the service is open to everyone.
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }

    /// Whether `/metrics` needs a key, too.
    pub fn protect_metrics(&self) -> bool {
        self.protect_metrics
    }

    /// Whose key this is, if it is known.
    pub fn holder_of(&self, key: &[u8]) -> Option<&Arc<Holder>> {
        let hash: [u8; 32] = Sha256::digest(key).into();
        // The loop goes on after a match, so that the time taken says nothing about the keys.
        let mut found = None;
        for known in &self.keys {
            if bool::from(known.hash.ct_eq(&hash)) {
                found = Some(&known.holder);
            }
        }
        found
    }
}

impl Holder {
    /// Lets a request through that needs this role.
    ///
    /// # Errors
    /// `forbidden` if the holder's is lower.
    pub fn check_role(&self, needed: Role) -> Result<(), ApiError> {
        if self.role >= needed {
            return Ok(());
        }
        let Self { name, role, .. } = self;
        let detail = format!("key {name:?} has the role \"{role}\"; this needs \"{needed}\"");
        Err(ApiError::new(ErrorCode::Forbidden, detail))
    }
}

/// The error for a key that nobody has.
pub fn unknown_key() -> ApiError {
    ApiError::new(ErrorCode::Unauthorized, "the API key is not known")
}

/// The error for a request without a key.
pub fn missing_key() -> ApiError {
    ApiError::new(
        ErrorCode::Unauthorized,
        "send an API key as \"Authorization: Bearer KEY\" or \"X-API-Key: KEY\"",
    )
}

/// The key that a request presents in either header, if it presents one.
pub fn presented_key(headers: &HeaderMap) -> Option<&[u8]> {
    if let Some(key) = headers.get("x-api-key") {
        return Some(key.as_bytes());
    }
    let value = headers.get(header::AUTHORIZATION)?.as_bytes();
    let (scheme, key) = value.split_at_checked(BEARER_PREFIX_BYTES)?;
    scheme
        .eq_ignore_ascii_case(b"bearer ")
        .then(|| key.trim_ascii())
}

#[cfg(test)]
mod tests {
    use super::super::config::ApiKey;
    use super::*;

    fn hash_of(key: &str) -> String {
        hex::encode(Sha256::digest(key))
    }

    fn keys() -> ApiKeys {
        let key = |name: &str, keys: &[&str], role| ApiKey {
            name: name.into(),
            sha256: keys.iter().map(|key| hash_of(key)).collect(),
            role,
            requests_per_second: None,
            maps: None,
        };
        ApiKeys::new(&AuthConfig {
            keys: vec![
                key("fleet", &["secret", "next secret"], Role::Read),
                key("scraper", &["counter"], Role::Metrics),
                key("builder", &["hammer"], Role::Write),
            ],
            ..Default::default()
        })
        .unwrap()
    }

    #[test]
    fn a_key_is_found_in_either_header() {
        let presented = |name: &'static str, value: &'static str| {
            let headers = HeaderMap::from_iter([(
                header::HeaderName::from_static(name),
                header::HeaderValue::from_static(value),
            )]);
            presented_key(&headers).map(<[u8]>::to_vec)
        };
        assert_eq!(presented("x-api-key", "secret").unwrap(), b"secret");
        assert_eq!(
            presented("authorization", "bearer  secret").unwrap(),
            b"secret"
        );
        assert_eq!(
            presented("authorization", "Bearer secret").unwrap(),
            b"secret"
        );
        assert_eq!(presented("authorization", "Basic secret"), None);
        assert_eq!(presented("authorization", "Bearer"), None);
        assert_eq!(presented("accept", "secret"), None);
    }

    #[test]
    fn every_key_of_a_holder_is_known_and_no_other() {
        let keys = keys();
        let name = |key: &str| {
            keys.holder_of(key.as_bytes())
                .map(|holder| holder.name.to_string())
        };
        assert_eq!(name("secret").as_deref(), Some("fleet"));
        assert_eq!(name("next secret").as_deref(), Some("fleet"));
        assert_eq!(name("hammer").as_deref(), Some("builder"));
        for unknown in ["", "Secret", "secret ", &hash_of("secret")] {
            assert_eq!(name(unknown), None, "{unknown}");
        }
    }

    #[test]
    fn a_role_includes_the_lower_ones() {
        let keys = keys();
        let allows = |key: &str, role| {
            let holder = keys.holder_of(key.as_bytes()).unwrap();
            holder.check_role(role).map_err(|error| error.code)
        };
        for (key, allowed) in [("counter", 1), ("secret", 2), ("hammer", 3)] {
            for (i, role) in [Role::Metrics, Role::Read, Role::Write]
                .into_iter()
                .enumerate()
            {
                let expected = if i < allowed {
                    Ok(())
                } else {
                    Err(ErrorCode::Forbidden)
                };
                assert_eq!(allows(key, role), expected, "{key} {role}");
            }
        }
    }
}

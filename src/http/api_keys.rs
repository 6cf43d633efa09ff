//! API keys: who a request comes from, and what that caller may do.
//!
//! Only hashes of the keys are kept, and they are compared in constant time, so that neither a leak
//! of the settings nor the time of an answer gives a key away.

use super::config::{AuthConfig, Role};
use super::problem::ApiError;
use axum::http::{HeaderMap, header};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::InvalidValue;
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

/// Length of `"Bearer "`.
const BEARER_PREFIX_BYTES: usize = 7;

/// The accepted keys, ready to compare.
pub struct ApiKeys {
    keys: Vec<KnownKey>,
    protect_metrics: bool,
}

struct KnownKey {
    name: String,
    /// SHA-256 of the key.
    hash: [u8; 32],
    role: Role,
}

impl ApiKeys {
    /// Checks the configured keys and takes them over.
    ///
    /// # Errors
    /// A name is empty or used twice, or a hash is not one.
    pub fn new(config: &AuthConfig) -> Result<Self, InvalidValue> {
        config.check()?;
        let mut keys = Vec::with_capacity(config.keys.len());
        for key in &config.keys {
            keys.push(KnownKey {
                name: key.name.clone(),
                hash: key.hash()?,
                role: key.role,
            });
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

    /// The name of the key that `headers` carry, if its role is at least `needed`.
    ///
    /// # Errors
    /// `unauthorized` without a known key, `forbidden` if its role is too low.
    pub fn holder(&self, headers: &HeaderMap, needed: Role) -> Result<String, ApiError> {
        let key = presented_key(headers)?;
        let hash: [u8; 32] = Sha256::digest(key).into();
        // The loop goes on after a match, so that the time taken says nothing about the keys.
        let mut found = None;
        for known in &self.keys {
            if bool::from(known.hash.ct_eq(&hash)) {
                found = Some(known);
            }
        }
        let found = found
            .ok_or_else(|| ApiError::new(ErrorCode::Unauthorized, "the API key is not known"))?;
        if found.role < needed {
            let name = &found.name;
            let detail = format!("key {name:?} may read; this needs a key that may write");
            return Err(ApiError::new(ErrorCode::Forbidden, detail));
        }
        Ok(found.name.clone())
    }
}

/// The key that a request presents in either header.
fn presented_key(headers: &HeaderMap) -> Result<&[u8], ApiError> {
    if let Some(key) = headers.get("x-api-key") {
        return Ok(key.as_bytes());
    }
    let missing = || {
        ApiError::new(
            ErrorCode::Unauthorized,
            "send an API key as \"Authorization: Bearer KEY\" or \"X-API-Key: KEY\"",
        )
    };
    let value = headers.get(header::AUTHORIZATION).ok_or_else(missing)?;
    let (scheme, key) = value
        .as_bytes()
        .split_at_checked(BEARER_PREFIX_BYTES)
        .ok_or_else(missing)?;
    if !scheme.eq_ignore_ascii_case(b"bearer ") {
        return Err(missing());
    }
    Ok(key.trim_ascii())
}

#[cfg(test)]
mod tests {
    use super::super::config::ApiKey;
    use super::*;

    fn keys() -> ApiKeys {
        // SHA-256 of "secret".
        let sha256 = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b".to_owned();
        let key = ApiKey {
            name: "fleet".into(),
            sha256,
            role: Role::Read,
            requests_per_second: None,
        };
        ApiKeys::new(&AuthConfig {
            keys: vec![key],
            ..Default::default()
        })
        .unwrap()
    }

    #[test]
    fn keys_are_found_in_either_header_and_roles_hold() {
        let headers = |name: &'static str, value: &'static str| {
            HeaderMap::from_iter([(
                header::HeaderName::from_static(name),
                header::HeaderValue::from_static(value),
            )])
        };
        let keys = keys();
        let code =
            |headers: HeaderMap, role| keys.holder(&headers, role).map_err(|error| error.code);
        assert_eq!(
            code(headers("x-api-key", "secret"), Role::Read).unwrap(),
            "fleet"
        );
        assert_eq!(
            code(headers("authorization", "bearer secret"), Role::Read).unwrap(),
            "fleet"
        );
        assert_eq!(
            code(headers("authorization", "Bearer secret"), Role::Write),
            Err(ErrorCode::Forbidden)
        );
        assert_eq!(
            code(headers("authorization", "Basic secret"), Role::Read),
            Err(ErrorCode::Unauthorized)
        );
        assert_eq!(
            code(headers("x-api-key", "Secret"), Role::Read),
            Err(ErrorCode::Unauthorized)
        );
        assert_eq!(
            code(HeaderMap::new(), Role::Read),
            Err(ErrorCode::Unauthorized)
        );
    }
}

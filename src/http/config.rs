//! Settings of the web surface.

use placeformer_core::types::InvalidValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Limits and timeouts of connections and bodies. The comments of the fields are printed as the
/// manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct HttpConfig {
    /// Address and port to listen on; port 0 picks a free one.
    pub listen: String,
    /// Connections open at once; further ones wait in the kernel's backlog.
    pub max_connections: usize,
    /// Time for a request's head to arrive, also between two requests of one connection, in
    /// milliseconds.
    pub header_timeout_ms: u64,
    /// Time for a whole body to arrive, in milliseconds.
    pub body_timeout_ms: u64,
    /// Longest pause within a body, in milliseconds.
    pub body_idle_timeout_ms: u64,
    /// Largest head of a request in bytes, at least 8192.
    pub max_header_bytes: usize,
    /// Bytes of bodies kept in memory at once over all requests; beyond, a request is answered 503
    /// overloaded.
    pub max_buffered_bytes: usize,
    /// Most references in one page of a listing.
    pub max_page: usize,
    /// After SIGTERM: time between failing /readyz and refusing connections, in milliseconds, so
    /// that a load balancer notices.
    pub drain_delay_ms: u64,
    /// After SIGTERM: time for requests under way to finish, in milliseconds.
    pub drain_timeout_ms: u64,
}

impl Default for HttpConfig {
    fn default() -> Self {
        Self {
            listen: "127.0.0.1:8080".into(),
            max_connections: 1024,
            header_timeout_ms: 15_000,
            body_timeout_ms: 30_000,
            body_idle_timeout_ms: 10_000,
            max_header_bytes: 32 << 10,
            max_buffered_bytes: 512 << 20,
            max_page: 1000,
            drain_delay_ms: 0,
            drain_timeout_ms: 20_000,
        }
    }
}

impl HttpConfig {
    /// Checks what the types cannot.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let positive = [
            ("http.max_connections", self.max_connections as u64),
            ("http.header_timeout_ms", self.header_timeout_ms),
            ("http.body_timeout_ms", self.body_timeout_ms),
            ("http.body_idle_timeout_ms", self.body_idle_timeout_ms),
            ("http.max_buffered_bytes", self.max_buffered_bytes as u64),
            ("http.max_page", self.max_page as u64),
        ];
        if let Some((field, _)) = positive.iter().find(|(_, value)| *value == 0) {
            return Err(InvalidValue::new(field, "0 would refuse everything"));
        }
        if self.max_header_bytes < 8 << 10 {
            return Err(InvalidValue::new(
                "http.max_header_bytes",
                "use at least 8192",
            ));
        }
        Ok(())
    }
}

/// Who may do what. Without keys the service is open. The comments of the fields are printed as the
/// manual of the configuration file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AuthConfig {
    /// Accepted API keys; without any, the service is open to everyone.
    pub keys: Vec<ApiKey>,
    /// Whether /metrics needs a key, too.
    pub protect_metrics: bool,
    /// Requests per second of one key (of one address where there are no keys); 0 is unbounded.
    pub requests_per_second: u32,
    /// Requests that may come at once beyond that rate; 0 is as many as one second allows.
    pub burst: u32,
}

/// What a key allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Queries, matches and listings.
    Read,
    /// Everything.
    Write,
}

/// One accepted key. The key itself is nowhere kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ApiKey {
    /// Who uses it; appears in logs.
    pub name: String,
    /// SHA-256 of the key in hexadecimal (printf %s KEY | sha256sum).
    pub sha256: String,
    /// "read" (queries, matches and listings) or "write" (everything).
    #[schema(value_type = String)]
    pub role: Role,
    /// Requests per second of this key, if they differ from those of the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub requests_per_second: Option<u32>,
}

impl AuthConfig {
    /// Checks names and hashes.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let mut names = std::collections::HashSet::new();
        for key in &self.keys {
            if key.name.is_empty() || !names.insert(&key.name) {
                return Err(InvalidValue::new(
                    "auth.keys",
                    format!("the name {:?} is empty or used twice", key.name),
                ));
            }
            key.hash()?;
        }
        Ok(())
    }
}

impl ApiKey {
    /// The 32 bytes of the hash.
    pub fn hash(&self) -> Result<[u8; 32], InvalidValue> {
        let wrong = || {
            InvalidValue::new(
                "auth.keys",
                format!(
                    "sha256 of key {:?} is not 64 hexadecimal digits (printf %s KEY | sha256sum)",
                    self.name
                ),
            )
        };
        let mut hash = [0; 32];
        hex::decode_to_slice(&self.sha256, &mut hash).map_err(|_| wrong())?;
        Ok(hash)
    }
}

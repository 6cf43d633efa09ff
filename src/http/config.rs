//! Settings of the web surface.

use super::cross_origin::CrossOriginRules;
use super::map_scope::MapPattern;
use placeformer_core::types::InvalidValue;
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use utoipa::ToSchema;

/// Limits and timeouts of connections and bodies. The comments of the fields are printed as the
/// manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct HttpConfig {
    /// Address and port to listen on; port 0 picks a free one. Without API keys it must be a
    /// loopback address, unless `insecure` is true.
    pub listen: String,
    /// Lets a service without API keys listen on an address that other machines reach: whoever
    /// reaches it can then read and change everything.
    pub insecure: bool,
    /// Names by which clients may address the server (the header Host), without a port. Empty: any
    /// name, except on a loopback address without API keys, where only localhost and loopback
    /// addresses are answered, so that no web page can reach the service through a name of its
    /// own. Those are always allowed.
    pub allowed_hosts: Vec<String>,
    /// Origins of web pages that may use the service from a browser, such as
    /// `https://console.example.com`. Pages of other origins than the service's own are refused.
    pub allowed_origins: Vec<String>,
    /// File of the certificate chain (PEM) for HTTPS, together with tls_key; plain HTTP without. Both
    /// are read again on SIGHUP and when they change; broken files leave the old in force.
    #[schema(value_type = Option<String>)]
    pub tls_cert: Option<PathBuf>,
    /// File of the certificate's private key (PEM).
    #[schema(value_type = Option<String>)]
    pub tls_key: Option<PathBuf>,
    /// Connections open at once. A further client takes the place of the idlest connection of the
    /// address that has most; if none is idle, it gets one of reserved_connections.
    pub max_connections: usize,
    /// Connections open at once from one address; of IPv6, from one network of 64 bits. A further
    /// one takes the place of the address's idlest, or gets one of reserved_connections.
    pub max_connections_per_address: usize,
    /// Addresses of proxies, behind which there are many clients, so that
    /// max_connections_per_address does not hold for them.
    #[schema(value_type = Vec<String>)]
    pub trusted_proxies: Vec<IpAddr>,
    /// Connections beyond max_connections that only get /livez, /readyz and /metrics, and 503
    /// overloaded for everything else.
    pub reserved_connections: usize,
    /// Time that a connection may take to send its first byte while more than three quarters of
    /// max_connections are open, in milliseconds; otherwise header_timeout_ms holds.
    pub crowded_silence_ms: u64,
    /// Age at which a connection is closed after the answer under way, in milliseconds.
    pub max_connection_age_ms: u64,
    /// Time for a request's head to arrive, also between two requests of one connection, in
    /// milliseconds.
    pub header_timeout_ms: u64,
    /// Time for a whole body to arrive, in milliseconds.
    pub body_timeout_ms: u64,
    /// Longest pause within a body, in milliseconds.
    pub body_idle_timeout_ms: u64,
    /// Slowest average rate of a body in bytes a second, once body_idle_timeout_ms have passed.
    pub min_body_bytes_per_second: u64,
    /// Time in which a client must take min_answer_bytes_per_second of an answer that waits for it,
    /// in milliseconds; one that takes less, or nothing, is cut off.
    pub answer_stall_timeout_ms: u64,
    /// Slowest rate in bytes a second at which a client may take an answer that waits for it.
    pub min_answer_bytes_per_second: u64,
    /// Largest head of a request in bytes, at least 8192.
    pub max_header_bytes: usize,
    /// Bytes of bodies kept in memory at once over all requests; beyond, a request is answered 503
    /// overloaded.
    pub max_buffered_bytes: usize,
    /// Bytes of answers kept in memory at once, from their making until their clients have taken
    /// them; beyond, a request is answered 503 overloaded.
    pub max_unsent_bytes: usize,
    /// Bodies taken apart, and answers written as JSON, at the same time, each on a thread.
    pub codec_threads: usize,
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
            insecure: false,
            allowed_hosts: Vec::new(),
            allowed_origins: Vec::new(),
            tls_cert: None,
            tls_key: None,
            max_connections: 1024,
            max_connections_per_address: 256,
            trusted_proxies: Vec::new(),
            reserved_connections: 16,
            crowded_silence_ms: 2_000,
            max_connection_age_ms: 3_600_000,
            header_timeout_ms: 15_000,
            body_timeout_ms: 30_000,
            body_idle_timeout_ms: 10_000,
            min_body_bytes_per_second: 4 << 10,
            answer_stall_timeout_ms: 10_000,
            min_answer_bytes_per_second: 8 << 10,
            max_header_bytes: 32 << 10,
            max_buffered_bytes: 512 << 20,
            max_unsent_bytes: 128 << 20,
            codec_threads: 2,
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
            (
                "http.max_connections_per_address",
                self.max_connections_per_address as u64,
            ),
            (
                "http.reserved_connections",
                self.reserved_connections as u64,
            ),
            ("http.crowded_silence_ms", self.crowded_silence_ms),
            ("http.max_connection_age_ms", self.max_connection_age_ms),
            ("http.header_timeout_ms", self.header_timeout_ms),
            ("http.body_timeout_ms", self.body_timeout_ms),
            ("http.body_idle_timeout_ms", self.body_idle_timeout_ms),
            ("http.answer_stall_timeout_ms", self.answer_stall_timeout_ms),
            ("http.max_buffered_bytes", self.max_buffered_bytes as u64),
            ("http.max_unsent_bytes", self.max_unsent_bytes as u64),
            ("http.codec_threads", self.codec_threads as u64),
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
        if self.tls_cert.is_some() != self.tls_key.is_some() {
            return Err(InvalidValue::new(
                "http.tls_cert",
                "http.tls_cert and http.tls_key belong together: set both or neither",
            ));
        }
        CrossOriginRules::new(self)?;
        Ok(())
    }

    /// Whether the server speaks HTTPS.
    pub fn has_tls(&self) -> bool {
        self.tls_cert.is_some()
    }
}

/// Who may do what. Without keys the service is open. The comments of the fields are printed as the
/// manual of the configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AuthConfig {
    /// Accepted API keys; without any, the service is open to everyone. They are read again on
    /// SIGHUP and when the configuration file changes, and so are the other settings of this
    /// section. A file that is not valid, or has no keys left, is reported in the log and changes
    /// nothing.
    pub keys: Vec<ApiKey>,
    /// Whether /metrics needs a key, too. If not, a request without a key gets all numbers, but no
    /// name of a map, where there are keys.
    pub protect_metrics: bool,
    /// Requests per second of one key (of one address where there are no keys, of one /64 network of
    /// IPv6); 0 is unbounded.
    pub requests_per_second: u32,
    /// Requests that may come at once beyond that rate; 0 is as many as one second allows.
    pub burst: u32,
    /// Unknown keys that one address may present in a minute; then it is answered 429 until the
    /// minute is over, whatever it presents. 0 is unbounded, which is the choice behind a proxy:
    /// all requests come from its address, and one client with an old key would shut out the
    /// others.
    pub failed_keys_per_minute: u32,
}

impl Default for AuthConfig {
    fn default() -> Self {
        Self {
            keys: Vec::new(),
            protect_metrics: false,
            requests_per_second: 0,
            burst: 0,
            failed_keys_per_minute: 30,
        }
    }
}

/// What a key allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// The metrics, with the names of maps.
    Metrics,
    /// Queries, matches and listings; the metrics, too.
    Read,
    /// Everything.
    Write,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Metrics => "metrics",
            Self::Read => "read",
            Self::Write => "write",
        })
    }
}

/// Who holds keys, and what they allow. The keys themselves are nowhere kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ApiKey {
    /// Who uses it; appears in logs.
    pub name: String,
    /// SHA-256 of the key in hexadecimal (printf %s KEY | sha256sum). A list of several: each of
    /// these keys is good, so that one can be replaced by the next without a gap.
    #[schema(value_type = String)]
    pub sha256: KeyHashes,
    /// "read" (queries, matches, listings and metrics), "write" (everything), or "metrics" (only
    /// these).
    #[schema(value_type = String)]
    pub role: Role,
    /// Requests per second of all keys of this name together, if they differ from those of the
    /// others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub requests_per_second: Option<u32>,
    /// The maps that it is limited to, by name or by the beginning of names (["city-*"]). Left out:
    /// all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Vec<String>>)]
    pub maps: Option<Vec<MapPattern>>,
}

/// The hashes of one or several keys, as a text or a list of them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "OneOrSeveral", into = "OneOrSeveral")]
pub struct KeyHashes(Vec<String>);

impl FromIterator<String> for KeyHashes {
    fn from_iter<I: IntoIterator<Item = String>>(hashes: I) -> Self {
        Self(hashes.into_iter().collect())
    }
}

impl From<String> for KeyHashes {
    fn from(hash: String) -> Self {
        Self(vec![hash])
    }
}

/// How hashes are written in the settings.
#[derive(Serialize, Deserialize)]
#[serde(untagged, expecting = "a text, or a list of texts")]
enum OneOrSeveral {
    One(String),
    Several(Vec<String>),
}

impl From<OneOrSeveral> for KeyHashes {
    fn from(hashes: OneOrSeveral) -> Self {
        match hashes {
            OneOrSeveral::One(hash) => Self(vec![hash]),
            OneOrSeveral::Several(hashes) => Self(hashes),
        }
    }
}

impl From<KeyHashes> for OneOrSeveral {
    fn from(hashes: KeyHashes) -> Self {
        match <[String; 1]>::try_from(hashes.0) {
            Ok([hash]) => Self::One(hash),
            Err(hashes) => Self::Several(hashes),
        }
    }
}

impl AuthConfig {
    /// Checks names, hashes and maps.
    ///
    /// # Errors
    /// Names the first key that breaks a rule.
    pub fn check(&self) -> Result<(), InvalidValue> {
        let broken = |reason| InvalidValue::new("auth.keys", reason);
        let mut names = HashSet::new();
        let mut hashes = HashSet::new();
        for key in &self.keys {
            let name = &key.name;
            if name.is_empty() || !names.insert(name) {
                let reason = format!("the name {name:?} is empty or used twice");
                return Err(broken(reason));
            }
            for hash in key.hashes()? {
                if !hashes.insert(hash) {
                    let reason = format!("a key of {name:?} is listed a second time");
                    return Err(broken(reason));
                }
            }
            if key.maps.as_ref().is_some_and(Vec::is_empty) {
                let reason = format!("maps of key {name:?} is empty: leave it out to allow all");
                return Err(broken(reason));
            }
        }
        Ok(())
    }
}

impl ApiKey {
    /// The 32 bytes of each hash.
    ///
    /// # Errors
    /// There is none, or one is not 64 hexadecimal digits.
    pub fn hashes(&self) -> Result<Vec<[u8; 32]>, InvalidValue> {
        let wrong = || {
            let reason = format!(
                "sha256 of key {:?} is not 64 hexadecimal digits (printf %s KEY | sha256sum), nor \
                 a list of such",
                self.name
            );
            InvalidValue::new("auth.keys", reason)
        };
        if self.sha256.0.is_empty() {
            return Err(wrong());
        }
        let mut hashes = Vec::with_capacity(self.sha256.0.len());
        for text in &self.sha256.0 {
            let mut hash = [0; 32];
            hex::decode_to_slice(text, &mut hash).map_err(|_| wrong())?;
            hashes.push(hash);
        }
        Ok(hashes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(name: &str, hashes: &[&str]) -> ApiKey {
        ApiKey {
            name: name.into(),
            sha256: hashes.iter().map(|hash| (*hash).to_owned()).collect(),
            role: Role::Read,
            requests_per_second: None,
            maps: None,
        }
    }

    fn check(keys: Vec<ApiKey>) -> Result<(), InvalidValue> {
        AuthConfig {
            keys,
            ..Default::default()
        }
        .check()
    }

    #[test]
    fn only_hexadecimal_digits_are_a_hash() {
        let good = "0123456789abcdefABCDEF".repeat(3)[..64].to_owned();
        check(vec![key("a", &[&good])]).unwrap();
        for wrong in [
            // A parser of numbers takes a sign before a digit.
            "+f".repeat(32),
            format!("+{}", &good[1..]),
            format!("-{}", &good[1..]),
            format!(" {}", &good[1..]),
            format!("0x{}", &good[2..]),
            format!("{}g", &good[1..]),
            "é".repeat(32),
            good[1..].to_owned(),
            format!("{good}0"),
            String::new(),
        ] {
            let error = check(vec![key("a", &[&wrong])]).unwrap_err();
            assert!(error.reason.contains("hexadecimal"), "{wrong}: {error}");
        }
        assert!(check(vec![key("a", &[&good, "x"])]).is_err());
        assert!(check(vec![key("a", &[])]).is_err());
    }

    #[test]
    fn nobody_shares_a_name_or_a_key() {
        let hash = |digit: &str| digit.repeat(64);
        let [one, two, three] = [hash("1"), hash("2"), hash("3")];
        check(vec![key("a", &[&one, &two]), key("b", &[&three])]).unwrap();
        let refused = [
            vec![key("a", &[&one]), key("a", &[&two])],
            vec![key("a", &[&one]), key("b", &[&one])],
            vec![key("a", &[&one, &one])],
            vec![key("", &[&one])],
            vec![ApiKey {
                maps: Some(vec![]),
                ..key("a", &[&one])
            }],
        ];
        for keys in refused {
            assert!(check(keys.clone()).is_err(), "{keys:?}");
        }
    }
}

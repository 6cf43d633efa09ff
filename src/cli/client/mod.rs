//! The client of a running server, for every subcommand that asks one.
//!
//! [`Connection`] knows the address, the API key and the time-out; it is asynchronous, as a load
//! test needs it. [`ServerClient`] is the same for the commands that do one thing after the other,
//! and can try again. Both report failures as one [`ClientError`].

mod answer;
mod connection;
mod error;
mod metrics;

pub(super) use answer::Answer;
pub(super) use connection::Connection;
pub(super) use error::{ClientError, UNREACHABLE};
pub(super) use metrics::resident_bytes;

use placeformer_core::retry::RetryPolicy;
use reqwest::header::CONTENT_TYPE;
use reqwest::{Method, RequestBuilder};
#[cfg(feature = "lab")]
use serde::Serialize;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::runtime::Runtime;

/// The content type of image and model files: the server looks at the bytes themselves.
pub(super) const BYTES: &str = "application/octet-stream";

/// The shortest wait before the second attempt; the waits double from then on.
const FIRST_WAIT: Duration = Duration::from_millis(200);
/// The longest wait, also where the server asks for a longer one.
const LONGEST_WAIT: Duration = Duration::from_secs(60);

/// Where the server is and who asks.
#[derive(Debug, Clone, clap::Args)]
pub struct ServerArgs {
    /// Address of the server.
    #[arg(
        long,
        env = "PLACEFORMER_SERVER",
        default_value = "http://127.0.0.1:8080",
        value_name = "URL"
    )]
    pub server: String,
    /// API key, where the server wants one.
    #[arg(
        long,
        env = "PLACEFORMER_API_KEY",
        hide_env_values = true,
        value_name = "KEY"
    )]
    pub api_key: Option<String>,
    /// Whose certificates are trusted.
    #[command(flatten)]
    pub trust: TrustArgs,
    /// Seconds to wait for an answer.
    #[arg(long, default_value_t = 60, value_name = "SECONDS")]
    pub timeout: u64,
}

/// Whose certificates are trusted over HTTPS.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct TrustArgs {
    /// Certificate (PEM) that the server's is signed by, beside those that the system trusts.
    #[arg(long, env = "PLACEFORMER_CA_CERT", value_name = "FILE")]
    pub ca_cert: Option<PathBuf>,
}

/// Sends one request after the other and blocks until each is answered. Several threads may share
/// it.
pub(super) struct ServerClient {
    connection: Connection,
    /// Drives the connection, which is asynchronous.
    runtime: Runtime,
    retry: RetryPolicy,
}

/// What came of a request that was sent as often as it helped.
pub(super) struct Attempted {
    /// A successful answer, or the failure of the last attempt.
    pub(super) answer: Result<Answer, ClientError>,
    /// How often the request was sent.
    pub(super) attempts: u32,
}

impl ServerClient {
    /// Prepares a client that sends every request once; nothing is sent yet.
    ///
    /// # Errors
    /// The system refuses what the client needs, such as a thread.
    pub(super) fn new(args: ServerArgs) -> Result<Self, ClientError> {
        Self::with_attempts(args, 1)
    }

    /// Prepares a client that sends a request of [`Self::attempt`] up to `attempts` times.
    ///
    /// # Errors
    /// The system refuses what the client needs, such as a thread.
    pub(super) fn with_attempts(args: ServerArgs, attempts: u32) -> Result<Self, ClientError> {
        let timeout = Duration::from_secs(args.timeout);
        let connection = Connection::new(&args.server, args.api_key, args.trust, timeout)?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(ClientError::Runtime)?;
        let retry = RetryPolicy {
            attempts,
            first_wait: FIRST_WAIT,
            longest_wait: LONGEST_WAIT,
        };
        Ok(Self {
            connection,
            runtime,
            retry,
        })
    }

    /// A GET of `path`.
    pub(super) fn get(&self, path: &str) -> Result<Value, ClientError> {
        self.json(self.connection.request(Method::GET, path))
    }

    /// A DELETE of `path`.
    pub(super) fn delete(&self, path: &str) -> Result<Value, ClientError> {
        self.json(self.connection.request(Method::DELETE, path))
    }

    /// A PUT of a JSON body.
    #[cfg(feature = "lab")]
    pub(super) fn put_json(&self, path: &str, body: &impl Serialize) -> Result<Value, ClientError> {
        self.json(self.connection.request(Method::PUT, path).json(body))
    }

    /// A PUT of a file's bytes.
    pub(super) fn put_file(&self, path: &str, file: &[u8]) -> Result<Value, ClientError> {
        let request = self
            .connection
            .request(Method::PUT, path)
            .header(CONTENT_TYPE, BYTES)
            .body(file.to_vec());
        self.json(request)
    }

    /// A POST of an image file with query parameters.
    pub(super) fn post_image(
        &self,
        path: &str,
        image: &Path,
        parameters: &[(&str, String)],
    ) -> Result<Value, ClientError> {
        let bytes = std::fs::read(image).map_err(|source| ClientError::ReadFile {
            path: image.to_owned(),
            source,
        })?;
        let request = self
            .connection
            .request(Method::POST, path)
            .query(parameters)
            .header(CONTENT_TYPE, BYTES)
            .body(bytes);
        self.json(request)
    }

    /// Status and body of a GET, whatever the status is.
    pub(super) fn probe(&self, path: &str) -> Result<(u16, String), ClientError> {
        let answer = self.exchange(self.connection.request(Method::GET, path))?;
        Ok((answer.status().as_u16(), answer.text().into_owned()))
    }

    /// Sends a request until it succeeds, is refused for good, or has been sent often enough.
    /// `request` makes it anew for every attempt.
    pub(super) fn attempt(&self, request: impl Fn(&Connection) -> RequestBuilder) -> Attempted {
        let mut attempts = 0;
        let once = || {
            attempts += 1;
            self.exchange(request(&self.connection))?.into_success()
        };
        let answer = self.retry.run(once, ClientError::retry);
        Attempted { answer, attempts }
    }

    fn json(&self, request: RequestBuilder) -> Result<Value, ClientError> {
        Ok(self.exchange(request)?.into_success()?.json())
    }

    fn exchange(&self, request: RequestBuilder) -> Result<Answer, ClientError> {
        self.runtime.block_on(self.connection.exchange(request))
    }
}

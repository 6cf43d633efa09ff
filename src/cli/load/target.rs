//! The server under load: one request and what became of it, and the server's memory meanwhile.

use crate::cli::client::{Answer, BYTES, ClientError, Connection, TrustArgs, resident_bytes};
use anyhow::{Context, ensure};
use bytes::Bytes;
use reqwest::header::CONTENT_TYPE;
use reqwest::{Method, StatusCode, Url};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Longest wait for one answer.
const TIMEOUT: Duration = Duration::from_secs(60);

/// What became of one due request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum RequestOutcome {
    /// Answered.
    Admitted,
    /// Turned away for now (429, 503 or 504).
    Rejected {
        /// Whether the server said when to come back.
        retry_after: bool,
    },
    /// Neither answered nor properly turned away.
    Failed(String),
    /// Too many were under way, so it never left.
    NotSent,
}

/// The server under load and the photos it is asked about.
pub(super) struct Target {
    connection: Connection,
    /// Path and parameters of every query.
    query: String,
    images: Vec<Bytes>,
    /// Resident bytes of the server, in the order sampled.
    memory: Mutex<Vec<u64>>,
}

impl Target {
    /// Prepares to ask the server about `map`; `options` are more query parameters.
    pub(super) fn new(
        server: &str,
        map: &str,
        options: &str,
        api_key: Option<String>,
        trust: TrustArgs,
        images: Vec<Bytes>,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            connection: Connection::new(server, api_key, trust, TIMEOUT)?,
            query: query_path(server, map, options)?,
            images,
            memory: Mutex::default(),
        })
    }

    /// Fails early, with the server's own words, when a run would only measure errors.
    pub(super) async fn expect_ready(&self) -> anyhow::Result<()> {
        let answer = self.get("/readyz").await?;
        let is_ready = answer.status().is_success();
        ensure!(is_ready, "the server is not ready: {}", answer.text());
        Ok(())
    }

    /// Sends the photo of this number; the photos are sent in turn.
    pub(super) async fn query(&self, number: usize) -> RequestOutcome {
        let image = self.images[number % self.images.len()].clone();
        let request = self
            .connection
            .request(Method::POST, &self.query)
            .header(CONTENT_TYPE, BYTES)
            .body(image);
        match self.connection.exchange(request).await {
            Ok(answer) => outcome(&answer),
            Err(ClientError::Unreachable { source, .. }) => {
                RequestOutcome::Failed(source.to_string())
            }
            Err(ClientError::BrokenOff { source, .. }) => {
                RequestOutcome::Failed(format!("the answer broke off: {source}"))
            }
            Err(other) => RequestOutcome::Failed(other.to_string()),
        }
    }

    /// Resident bytes of the server, in the order sampled.
    pub(super) fn memory_samples(&self) -> Vec<u64> {
        let samples = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
        samples.clone()
    }

    async fn get(&self, path: &str) -> Result<Answer, ClientError> {
        let request = self.connection.request(Method::GET, path);
        self.connection.exchange(request).await
    }

    async fn sample_memory(&self) {
        // A server that is too busy to answer now is asked again soon.
        let Ok(answer) = self.get("/metrics").await else {
            return;
        };
        if let Some(bytes) = resident_bytes(&answer.text()) {
            let mut samples = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
            samples.push(bytes);
        }
    }
}

/// Path and parameters of the queries, after a look at the address.
fn query_path(server: &str, map: &str, options: &str) -> anyhow::Result<String> {
    let mut url = Url::parse(server)
        .with_context(|| format!("{server:?} is not an address such as http://127.0.0.1:8080"))?;
    url.query_pairs_mut().clear().append_pair("map", map);
    let parameters = url.query().unwrap_or_default();
    let separator = if options.is_empty() { "" } else { "&" };
    Ok(format!("/query?{parameters}{separator}{options}"))
}

fn outcome(answer: &Answer) -> RequestOutcome {
    let status = answer.status();
    if status.is_success() {
        RequestOutcome::Admitted
    } else if is_rejection(status) {
        RequestOutcome::Rejected {
            retry_after: answer.has_retry_after(),
        }
    } else {
        RequestOutcome::Failed(format!("{status}: {}", answer.text()))
    }
}

fn is_rejection(status: StatusCode) -> bool {
    matches!(
        status,
        StatusCode::TOO_MANY_REQUESTS
            | StatusCode::SERVICE_UNAVAILABLE
            | StatusCode::GATEWAY_TIMEOUT
    )
}

/// Samples the server's resident memory from its metrics until aborted.
pub(super) async fn watch_memory(target: Arc<Target>, every: Duration) {
    loop {
        target.sample_memory().await;
        tokio::time::sleep(every).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_query_names_the_map_and_the_options() {
        let server = "http://127.0.0.1:8080/";
        assert_eq!(query_path(server, "m", "").unwrap(), "/query?map=m");
        assert_eq!(
            query_path(server, "a b", "top_k=5").unwrap(),
            "/query?map=a+b&top_k=5"
        );
        let error = query_path("localhost", "m", "").unwrap_err().to_string();
        assert!(error.contains("\"localhost\" is not an address"), "{error}");
    }
}

//! One request and what became of it; the server's memory while the load runs.

use crate::cli::client::resident_bytes;
use anyhow::{Context, ensure};
use bytes::Bytes;
use reqwest::StatusCode;
use reqwest::header::{CONTENT_TYPE, RETRY_AFTER};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// What became of one due request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Outcome {
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
    client: reqwest::Client,
    base: String,
    query_url: String,
    api_key: Option<String>,
    images: Vec<Bytes>,
    memory: Mutex<Vec<u64>>,
}

impl Target {
    pub(super) fn new(
        server: &str,
        map: &str,
        options: &str,
        api_key: Option<String>,
        images: Vec<Bytes>,
    ) -> anyhow::Result<Self> {
        let base = server.trim_end_matches('/').to_owned();
        let mut query_url = reqwest::Url::parse(&format!("{base}/query")).with_context(|| {
            format!("{server:?} is not an address such as http://127.0.0.1:8080")
        })?;
        query_url.query_pairs_mut().append_pair("map", map);
        let query_url = match options {
            "" => query_url.to_string(),
            more => format!("{query_url}&{more}"),
        };
        let client = reqwest::Client::builder()
            .timeout(Duration::from_secs(60))
            .build()?;
        Ok(Self {
            client,
            base,
            query_url,
            api_key,
            images,
            memory: Mutex::default(),
        })
    }

    /// Fails early, with the server's own words, when a run would only measure errors.
    pub(super) async fn expect_ready(&self) -> anyhow::Result<()> {
        let url = format!("{}/readyz", self.base);
        let answer = self
            .client
            .get(&url)
            .send()
            .await
            .with_context(|| format!("cannot reach {url}"))?;
        let status = answer.status();
        let text = answer.text().await.unwrap_or_default();
        ensure!(status.is_success(), "the server is not ready: {text}");
        Ok(())
    }

    /// Sends the photo whose turn it is.
    pub(super) async fn query(&self, number: usize) -> Outcome {
        let image = self.images[number % self.images.len()].clone();
        // The server looks at the bytes themselves.
        let mut request = self
            .client
            .post(&self.query_url)
            .header(CONTENT_TYPE, "application/octet-stream")
            .body(image);
        if let Some(key) = &self.api_key {
            request = request.bearer_auth(key);
        }
        let answer = match request.send().await {
            Ok(answer) => answer,
            Err(error) => return Outcome::Failed(format!("{error:#}")),
        };
        let status = answer.status();
        let retry_after = answer.headers().contains_key(RETRY_AFTER);
        match answer.bytes().await {
            Err(error) => Outcome::Failed(format!("the answer broke off: {error:#}")),
            Ok(_) if status.is_success() => Outcome::Admitted,
            Ok(_) if is_rejection(status) => Outcome::Rejected { retry_after },
            Ok(body) => Outcome::Failed(format!("{status}: {}", String::from_utf8_lossy(&body))),
        }
    }

    /// Resident bytes of the server, in the order sampled.
    pub(super) fn memory_samples(&self) -> Vec<u64> {
        self.memory
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
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
    let url = format!("{}/metrics", target.base);
    loop {
        if let Ok(answer) = target.client.get(&url).send().await
            && let Ok(text) = answer.text().await
            && let Some(bytes) = resident_bytes(&text)
        {
            target
                .memory
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .push(bytes);
        }
        tokio::time::sleep(every).await;
    }
}

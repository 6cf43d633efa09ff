//! A client of a running server, for the subcommands that ask one.

use anyhow::{Context, bail};
use reqwest::blocking::{Client, RequestBuilder, Response};
use serde::Serialize;
use serde_json::Value;
use std::path::Path;
use std::time::Duration;

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
    /// Seconds to wait for an answer.
    #[arg(long, default_value_t = 60, value_name = "SECONDS")]
    pub timeout: u64,
}

/// Sends requests and turns refusals into sentences.
pub struct ServerClient {
    client: Client,
    args: ServerArgs,
}

impl ServerClient {
    /// Prepares a client; nothing is sent yet.
    pub fn new(args: ServerArgs) -> anyhow::Result<Self> {
        let client = Client::builder()
            .timeout(Duration::from_secs(args.timeout))
            .build()?;
        Ok(Self { client, args })
    }

    /// A GET of `path`.
    pub fn get(&self, path: &str) -> anyhow::Result<Value> {
        self.json(self.client.get(self.url(path)))
    }

    /// A DELETE of `path`.
    pub fn delete(&self, path: &str) -> anyhow::Result<Value> {
        self.json(self.client.delete(self.url(path)))
    }

    /// A PUT of a JSON body.
    pub fn put_json(&self, path: &str, body: &impl Serialize) -> anyhow::Result<Value> {
        self.json(self.client.put(self.url(path)).json(body))
    }

    /// A PUT of a file's bytes.
    pub fn put_file(&self, path: &str, file: &[u8]) -> anyhow::Result<Value> {
        let request = self
            .client
            .put(self.url(path))
            .header("content-type", "application/octet-stream");
        self.json(request.body(file.to_vec()))
    }

    /// A POST of an image file with query parameters.
    pub fn post_image(
        &self,
        path: &str,
        image: &Path,
        parameters: &[(&str, String)],
    ) -> anyhow::Result<Value> {
        let bytes =
            std::fs::read(image).with_context(|| format!("cannot read {}", image.display()))?;
        let request = self.client.post(self.url(path)).query(parameters);
        // The server looks at the bytes themselves.
        self.json(
            request
                .header("content-type", "application/octet-stream")
                .body(bytes),
        )
    }

    /// Status and body of a GET, whatever the status is.
    pub fn probe(&self, path: &str) -> anyhow::Result<(u16, String)> {
        let answer = self.send(self.client.get(self.url(path)))?;
        let status = answer.status().as_u16();
        Ok((status, answer.text().unwrap_or_default()))
    }

    fn url(&self, path: &str) -> String {
        format!("{}{path}", self.args.server.trim_end_matches('/'))
    }

    fn send(&self, mut request: RequestBuilder) -> anyhow::Result<Response> {
        if let Some(key) = &self.args.api_key {
            request = request.bearer_auth(key);
        }
        request.send().with_context(|| {
            format!(
                "cannot reach the server at {} (is it running?)",
                self.args.server
            )
        })
    }

    fn json(&self, request: RequestBuilder) -> anyhow::Result<Value> {
        let answer = self.send(request)?;
        let status = answer.status();
        let body = answer.text().context("the answer broke off")?;
        let value: Value = if body.is_empty() {
            Value::Null
        } else {
            serde_json::from_str(&body).unwrap_or_default()
        };
        if status.is_success() {
            return Ok(value);
        }
        let text = |key: &str| value[key].as_str().unwrap_or_default().to_owned();
        bail!(
            "{} ({}): {} [request {}]",
            text("title"),
            status.as_u16(),
            text("detail"),
            text("request_id")
        )
    }
}

/// Resident bytes of a server, from what it answers at `/metrics`.
pub(super) fn resident_bytes(metrics: &str) -> Option<u64> {
    let line = metrics
        .lines()
        .find(|line| line.starts_with("process_resident_memory_bytes "))?;
    line.split_whitespace()
        .nth(1)?
        .parse::<f64>()
        .ok()
        .map(|bytes| bytes as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resident_memory_is_read_from_the_exposition_format() {
        let text =
            "# TYPE process_resident_memory_bytes gauge\nprocess_resident_memory_bytes 123456789\n";
        assert_eq!(resident_bytes(text), Some(123_456_789));
        assert_eq!(resident_bytes("something_else 1\n"), None);
    }
}

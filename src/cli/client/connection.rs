//! Address, API key and time-out of a server.

use super::{Answer, ClientError, TrustArgs};
use reqwest::header::RETRY_AFTER;
use reqwest::{Certificate, Client, Method, RequestBuilder};
use std::path::Path;
use std::time::Duration;

/// How requests reach a server. Connections are kept open and shared.
pub(in crate::cli) struct Connection {
    client: Client,
    /// Without a slash at the end.
    base: String,
    api_key: Option<String>,
}

impl Connection {
    /// Prepares a connection; nothing is sent yet. `trust` says whose certificates are
    /// trusted beside those of the system. `timeout` bounds one request with its answer.
    ///
    /// # Errors
    /// The certificate cannot be read, or the system refuses what the client needs.
    pub(in crate::cli) fn new(
        server: &str,
        api_key: Option<String>,
        trust: TrustArgs,
        timeout: Duration,
    ) -> Result<Self, ClientError> {
        let mut client = Client::builder().timeout(timeout);
        if let Some(path) = trust.ca_cert {
            client = client.tls_certs_merge(read_certificates(&path)?);
        }
        let client = client.build().map_err(ClientError::Client)?;
        Ok(Self {
            client,
            base: server.trim_end_matches('/').to_owned(),
            api_key,
        })
    }

    /// A request for `path`, which carries the API key.
    pub(in crate::cli) fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.client.request(method, format!("{}{path}", self.base));
        match &self.api_key {
            Some(key) => request.bearer_auth(key),
            None => request,
        }
    }

    /// Sends a request and reads the whole answer, whatever its status is.
    ///
    /// # Errors
    /// No answer came, or it broke off.
    pub(in crate::cli) async fn exchange(
        &self,
        request: RequestBuilder,
    ) -> Result<Answer, ClientError> {
        let response = request
            .send()
            .await
            .map_err(|source| ClientError::Unreachable {
                server: self.base.clone(),
                source,
            })?;
        let status = response.status();
        let retry_after = response
            .headers()
            .get(RETRY_AFTER)
            .map(|value| String::from_utf8_lossy(value.as_bytes()).into_owned());
        match response.bytes().await {
            Ok(body) => Ok(Answer::new(status, retry_after, body)),
            Err(source) => Err(ClientError::BrokenOff {
                retry_after,
                source,
            }),
        }
    }
}

/// The certificates in a file of PEM, of which there must be one at least.
fn read_certificates(path: &Path) -> Result<Vec<Certificate>, ClientError> {
    let bytes = std::fs::read(path).map_err(|source| ClientError::ReadFile {
        path: path.to_owned(),
        source,
    })?;
    let certificates = Certificate::from_pem_bundle(&bytes).unwrap_or_default();
    if certificates.is_empty() {
        let path = path.to_owned();
        return Err(ClientError::NoCertificate { path });
    }
    Ok(certificates)
}

//! Files of the Hugging Face hub: resumable, checked against the hash the hub states.
//!
//! A first request, without following the redirect to the storage host, learns the file's size and
//! (for large files) its SHA-256. The body then goes to a `.part` file named after that hash, so
//! that an interrupted download continues where it stopped and a changed file is never spliced onto
//! an old beginning.

mod download;

use crate::error::PullError;
use download::Download;
use placeformer_core::files::{hash_file, with_suffix};
use placeformer_core::progress::{Progress, Task};
use placeformer_core::retry::{Retry, RetryPolicy, parse_retry_after};
use reqwest::StatusCode;
use reqwest::blocking::{Client, RequestBuilder, Response};
use reqwest::header::{
    ACCEPT_ENCODING, CONTENT_LENGTH, ETAG, HeaderMap, HeaderName, LOCATION, RETRY_AFTER,
};
use reqwest::redirect::Policy;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Once;
use std::time::Duration;

/// Attempts at one request.
const ATTEMPTS: u32 = 4;
/// The longest pause between two attempts.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// Redirections followed for one request.
const REDIRECTIONS: usize = 5;

/// Hash of a large file, which the hub sends beside the redirect to its storage.
const LINKED_ETAG: HeaderName = HeaderName::from_static("x-linked-etag");
/// Size of a large file, sent likewise.
const LINKED_SIZE: HeaderName = HeaderName::from_static("x-linked-size");

/// Where the hub is and how to talk to it.
#[derive(Debug, Clone)]
pub struct Hub {
    endpoint: String,
    token: Option<String>,
    retry: RetryPolicy,
}

/// What the hub says of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Stated {
    size: Option<u64>,
    sha256: Option<String>,
    etag: String,
}

impl Hub {
    /// The hub named by `HF_ENDPOINT`, with the token of `HF_TOKEN`; the public hub without either.
    pub fn from_env() -> Self {
        let set = |name| {
            std::env::var(name)
                .ok()
                .filter(|value| !value.trim().is_empty())
        };
        let endpoint = set("HF_ENDPOINT").unwrap_or_else(|| "https://huggingface.co".into());
        Self::new(endpoint, set("HF_TOKEN"), Duration::from_millis(500))
    }

    /// A hub at `endpoint`, which is asked again after `pause` when a request fails for a reason
    /// that may pass. The pause doubles with every attempt.
    pub fn new(endpoint: impl Into<String>, token: Option<String>, pause: Duration) -> Self {
        let retry = RetryPolicy {
            attempts: ATTEMPTS,
            first_wait: pause,
            longest_wait: LONGEST_PAUSE,
        };
        Self {
            endpoint: endpoint.into().trim_end_matches('/').to_owned(),
            token,
            retry,
        }
    }

    /// The address of a file.
    pub fn url(&self, repository: &str, file: &str) -> String {
        format!("{}/{repository}/resolve/main/{file}", self.endpoint)
    }

    /// Downloads `file` of `repository` to a temporary file beside `target` and returns its path;
    /// the caller renames it once it has proved usable.
    ///
    /// # Errors
    /// The hub cannot be reached, has no such file, or sends other bytes than its hash states; or
    /// the temporary file cannot be written.
    pub fn fetch(
        &self,
        repository: &str,
        file: &str,
        target: &Path,
        progress: &dyn Progress,
    ) -> Result<PathBuf, PullError> {
        install_tls_provider();
        let url = self.url(repository, file);
        let task = Task::begin_bytes(progress, &url);
        let stated = self.retrying(|| self.ask(&url))?;
        let part = part_path(target, &stated.etag);
        let download = Download {
            hub: self,
            url: &url,
            part: &part,
            size: stated.size,
            task: &task,
        };
        download.complete()?;
        if check(&part, &stated).is_err() {
            // An earlier attempt may have left wrong bytes, so one more starts from nothing.
            remove(&part)?;
            download.complete()?;
            // The caller needs to know of the wrong hash, not of a removal that failed.
            check(&part, &stated).inspect_err(|_| drop(remove(&part)))?;
        }
        Ok(part)
    }

    fn client(&self, redirects: Policy) -> Result<Client, PullError> {
        Client::builder()
            .user_agent(concat!("placeformer/", env!("CARGO_PKG_VERSION")))
            .connect_timeout(Duration::from_secs(10))
            // This bounds each wait for data, not the whole transfer.
            .timeout(Duration::from_secs(60))
            .redirect(redirects)
            .build()
            .map_err(|error| permanent(&self.endpoint, chain(&error)))
    }

    /// Size and hash of the file, from the hub itself rather than the storage it redirects to.
    fn ask(&self, url: &str) -> Result<Stated, PullError> {
        let client = self.client(Policy::none())?;
        let mut address = url.to_owned();
        for _ in 0..REDIRECTIONS {
            // Without this a server may answer with the length of the compressed body.
            let request = client.head(&address).header(ACCEPT_ENCODING, "identity");
            let response = self.send(request, &address)?;
            let status = response.status();
            let headers = response.headers();
            let is_linked = headers.contains_key(&LINKED_ETAG);
            if status.is_success() || (status.is_redirection() && is_linked) {
                return stated(headers, url);
            }
            let location = header(headers, &LOCATION).filter(|_| status.is_redirection());
            let Some(location) = location else {
                return Err(refused(&address, &response));
            };
            address = self.absolute(location);
        }
        Err(permanent(url, "too many redirections".into()))
    }

    /// Renamed repositories answer with an address relative to the hub.
    fn absolute(&self, location: String) -> String {
        if location.starts_with('/') {
            format!("{}{location}", self.endpoint)
        } else {
            location
        }
    }

    /// Sends a request for `url`. The token goes to the hub alone, never to a host that the hub
    /// redirects to.
    fn send(&self, request: RequestBuilder, url: &str) -> Result<Response, PullError> {
        let is_own = url.starts_with(&format!("{}/", self.endpoint));
        let request = match &self.token {
            Some(token) if is_own => request.bearer_auth(token),
            _ => request,
        };
        request.send().map_err(|error| broken(url, &error))
    }

    /// Repeats what failed for a reason that may pass.
    fn retrying<T>(&self, attempt: impl FnMut() -> Result<T, PullError>) -> Result<T, PullError> {
        self.retry.run(attempt, |error| match error {
            PullError::Http { url, reason, retry } => {
                tracing::debug!(%url, %reason, ?retry, "the request failed");
                *retry
            }
            _ => Retry::Never,
        })
    }
}

/// Chooses the TLS implementation, once per process.
fn install_tls_provider() {
    static ONCE: Once = Once::new();
    // Fails only if the process has chosen already, which serves as well.
    ONCE.call_once(|| drop(rustls::crypto::ring::default_provider().install_default()));
}

/// The temporary file of one content: its name carries the start of the hash.
fn part_path(target: &Path, etag: &str) -> PathBuf {
    let tag: String = etag
        .chars()
        .filter(char::is_ascii_alphanumeric)
        .take(16)
        .collect();
    with_suffix(target, &format!(".{tag}.part"))
}

fn stated(headers: &HeaderMap, url: &str) -> Result<Stated, PullError> {
    let etag = header(headers, &LINKED_ETAG).or_else(|| header(headers, &ETAG));
    let Some(etag) = etag else {
        let reason = "the answer carries no ETag, so it is not a file of the hub";
        return Err(permanent(url, reason.into()));
    };
    let etag = etag.trim_start_matches("W/").trim_matches('"').to_owned();
    let size = header(headers, &LINKED_SIZE).or_else(|| header(headers, &CONTENT_LENGTH));
    let is_sha256 = etag.len() == 64 && etag.bytes().all(|b| b.is_ascii_hexdigit());
    Ok(Stated {
        size: size.and_then(|size| size.parse().ok()),
        sha256: is_sha256.then(|| etag.to_ascii_lowercase()),
        etag,
    })
}

/// Compares the file with the hash that the hub stated, if it stated one.
fn check(part: &Path, stated: &Stated) -> Result<(), PullError> {
    let Some(expected) = &stated.sha256 else {
        return Ok(());
    };
    let actual = hash_file(part).map_err(PullError::io(part))?;
    if actual == *expected {
        return Ok(());
    }
    Err(PullError::WrongHash {
        what: part.display().to_string(),
        expected: expected.clone(),
        actual,
    })
}

fn header(headers: &HeaderMap, name: &HeaderName) -> Option<String> {
    headers.get(name)?.to_str().ok().map(str::to_owned)
}

fn remove(path: &Path) -> Result<(), PullError> {
    fs::remove_file(path).map_err(PullError::io(path))
}

/// An error that another attempt would meet again.
fn permanent(url: &str, reason: String) -> PullError {
    PullError::Http {
        url: url.to_owned(),
        reason,
        retry: Retry::Never,
    }
}

/// The error for an answer that is no success.
fn refused(url: &str, response: &Response) -> PullError {
    let status = response.status();
    let hint = match status {
        StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => {
            " (a private or gated repository needs HF_TOKEN)"
        }
        _ => "",
    };
    let may_pass = status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS;
    let retry = if may_pass {
        let after = header(response.headers(), &RETRY_AFTER);
        Retry::Later {
            after: after.as_deref().and_then(parse_retry_after),
        }
    } else {
        Retry::Never
    };
    PullError::Http {
        url: url.to_owned(),
        reason: format!("the server answered {status}{hint}"),
        retry,
    }
}

/// The error for a request without an answer.
fn broken(url: &str, error: &reqwest::Error) -> PullError {
    // A host that cannot be reached at all is reported at once: there is another source to try.
    let retry = if error.is_connect() || error.is_builder() {
        Retry::Never
    } else {
        Retry::Later { after: None }
    };
    PullError::Http {
        url: url.to_owned(),
        reason: chain(error),
        retry,
    }
}

/// An error with everything that caused it.
fn chain(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    let causes: Vec<String> = causes.map(|error| error.to_string()).collect();
    causes.join(": ")
}

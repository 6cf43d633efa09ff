//! Files of the Hugging Face hub: resumable, checked against the hash the hub states.
//!
//! A first request, without following the redirect to the storage host, learns the file's size and
//! (for large files) its SHA-256. The body then goes to a `.part` file named after that hash, so
//! that an interrupted download continues where it stopped and a changed file is never spliced onto
//! an old beginning.

use super::PullError;
use indicatif::ProgressBar;
use placeformer_core::files::{hash_file, with_suffix};
use reqwest::StatusCode;
use reqwest::blocking::{Client, Response};
use reqwest::header::{ACCEPT_ENCODING, CONTENT_LENGTH, ETAG, HeaderMap, LOCATION, RANGE};
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

const ATTEMPTS: u32 = 4;

/// Where the hub is and how to talk to it.
#[derive(Debug, Clone)]
pub struct Hub {
    endpoint: String,
    token: Option<String>,
    /// Pause before the first retry; doubled each time.
    pause: Duration,
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

    /// A hub at `endpoint`.
    pub fn new(endpoint: impl Into<String>, token: Option<String>, pause: Duration) -> Self {
        Self {
            endpoint: endpoint.into().trim_end_matches('/').to_owned(),
            token,
            pause,
        }
    }

    /// The address of a file.
    pub fn url(&self, repository: &str, file: &str) -> String {
        format!("{}/{repository}/resolve/main/{file}", self.endpoint)
    }

    /// Downloads `file` of `repository` to a temporary file beside `target` and returns its path;
    /// the caller renames it once it has proved usable.
    pub fn fetch(
        &self,
        repository: &str,
        file: &str,
        target: &Path,
        bar: &ProgressBar,
    ) -> Result<PathBuf, PullError> {
        super::install_tls_provider();
        let url = self.url(repository, file);
        let stated = self.retrying(|| self.ask(&url))?;
        let tag: String = stated
            .etag
            .chars()
            .filter(char::is_ascii_alphanumeric)
            .take(16)
            .collect();
        let part = with_suffix(target, &format!(".{tag}.part"));
        self.complete(&url, &part, &stated, bar)?;
        if self.check(&part, &stated).is_err() {
            // What was there before may be the culprit: once more from nothing.
            remove(&part)?;
            self.complete(&url, &part, &stated, bar)?;
            self.check(&part, &stated)
                .inspect_err(|_| drop(remove(&part)))?;
        }
        Ok(part)
    }

    fn client(&self, redirects: bool) -> Result<Client, PullError> {
        let policy = if redirects {
            reqwest::redirect::Policy::limited(5)
        } else {
            reqwest::redirect::Policy::none()
        };
        Client::builder()
            .user_agent(concat!("placeformer/", env!("CARGO_PKG_VERSION")))
            .connect_timeout(Duration::from_secs(10))
            // Bounds each wait for data, not the whole transfer.
            .timeout(Duration::from_secs(60))
            .redirect(policy)
            .build()
            .map_err(|e| PullError::Http {
                url: self.endpoint.clone(),
                reason: chain(&e),
                transient: false,
            })
    }

    /// Size and hash of the file, from the hub itself rather than the storage it redirects to.
    fn ask(&self, url: &str) -> Result<Stated, PullError> {
        let client = self.client(false)?;
        let mut address = url.to_owned();
        for _ in 0..5 {
            // Without this a server may answer with the length of the compressed body.
            let request = self.authorised(
                client.head(&address).header(ACCEPT_ENCODING, "identity"),
                &address,
            );
            let response = request.send().map_err(|e| broken(&address, &e))?;
            let headers = response.headers();
            let status = response.status();
            let linked = headers.contains_key("x-linked-etag");
            if status.is_success() || (status.is_redirection() && linked) {
                return stated(headers, url);
            }
            // Renamed repositories answer with a relative address on the same host.
            let moved = status
                .is_redirection()
                .then(|| header(headers, LOCATION.as_str()))
                .flatten();
            match moved {
                Some(location) if location.starts_with('/') => {
                    address = format!("{}{location}", self.endpoint)
                }
                Some(location) => address = location,
                None => return Err(refused(&address, status)),
            }
        }
        Err(PullError::Http {
            url: url.to_owned(),
            reason: "too many redirections".into(),
            transient: false,
        })
    }

    /// The token goes to the hub alone, never to a host it redirects to.
    fn authorised(
        &self,
        request: reqwest::blocking::RequestBuilder,
        url: &str,
    ) -> reqwest::blocking::RequestBuilder {
        match &self.token {
            Some(token) if url.starts_with(&format!("{}/", self.endpoint)) => {
                request.bearer_auth(token)
            }
            _ => request,
        }
    }

    /// Brings `part` to its full length, continuing what is there.
    fn complete(
        &self,
        url: &str,
        part: &Path,
        stated: &Stated,
        bar: &ProgressBar,
    ) -> Result<(), PullError> {
        if let Some(size) = stated.size {
            bar.set_length(size);
        }
        self.retrying(|| {
            let mut file = OpenOptions::new()
                .create(true)
                .append(true)
                .open(part)
                .map_err(PullError::io(part))?;
            let have = file.metadata().map_err(PullError::io(part))?.len();
            if stated.size == Some(have) {
                return Ok(());
            }
            if stated.size.is_some_and(|size| have > size) {
                file.set_len(0).map_err(PullError::io(part))?;
            }
            let have = file.metadata().map_err(PullError::io(part))?.len();
            let mut response = self.request_from(url, have)?;
            if have > 0 && response.status() != StatusCode::PARTIAL_CONTENT {
                // The server ignored the range and sends everything.
                file.set_len(0).map_err(PullError::io(part))?;
            }
            bar.set_position(file.metadata().map_err(PullError::io(part))?.len());
            copy(&mut response, &mut file, url, part, bar)?;
            let have = file.metadata().map_err(PullError::io(part))?.len();
            file.sync_all().map_err(PullError::io(part))?;
            match stated.size {
                Some(size) if have != size => Err(PullError::Http {
                    url: url.to_owned(),
                    reason: format!("the connection ended after {have} of {size} bytes"),
                    transient: true,
                }),
                _ => Ok(()),
            }
        })
    }

    fn request_from(&self, url: &str, have: u64) -> Result<Response, PullError> {
        let request = self
            .client(true)?
            .get(url)
            .header(ACCEPT_ENCODING, "identity");
        let request = if have > 0 {
            request.header(RANGE, format!("bytes={have}-"))
        } else {
            request
        };
        let response = self
            .authorised(request, url)
            .send()
            .map_err(|e| broken(url, &e))?;
        if response.status().is_success() {
            Ok(response)
        } else {
            Err(refused(url, response.status()))
        }
    }

    fn check(&self, part: &Path, stated: &Stated) -> Result<(), PullError> {
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

    /// Repeats what failed for a reason that may pass.
    fn retrying<T>(
        &self,
        mut attempt: impl FnMut() -> Result<T, PullError>,
    ) -> Result<T, PullError> {
        let mut pause = self.pause;
        for _ in 1..ATTEMPTS {
            match attempt() {
                Err(PullError::Http {
                    transient: true,
                    reason,
                    url,
                }) => {
                    tracing::debug!(%url, %reason, "trying again");
                    std::thread::sleep(pause);
                    pause *= 2;
                }
                settled => return settled,
            }
        }
        attempt()
    }
}

fn stated(headers: &HeaderMap, url: &str) -> Result<Stated, PullError> {
    let bare = |text: String| text.trim_start_matches("W/").trim_matches('"').to_owned();
    let etag = header(headers, "x-linked-etag")
        .or_else(|| header(headers, ETAG.as_str()))
        .map(bare);
    let size =
        header(headers, "x-linked-size").or_else(|| header(headers, CONTENT_LENGTH.as_str()));
    let etag = etag.ok_or_else(|| PullError::Http {
        url: url.to_owned(),
        reason: "the answer carries no ETag, so it is not a file of the hub".into(),
        transient: false,
    })?;
    let is_sha256 = etag.len() == 64 && etag.bytes().all(|b| b.is_ascii_hexdigit());
    Ok(Stated {
        size: size.and_then(|size| size.parse().ok()),
        sha256: is_sha256.then(|| etag.to_ascii_lowercase()),
        etag,
    })
}

fn copy(
    response: &mut Response,
    file: &mut File,
    url: &str,
    part: &Path,
    bar: &ProgressBar,
) -> Result<(), PullError> {
    let mut buffer = vec![0; 1 << 16];
    loop {
        let read = response.read(&mut buffer).map_err(|e| PullError::Http {
            url: url.to_owned(),
            reason: chain(&e),
            transient: true,
        })?;
        if read == 0 {
            return Ok(());
        }
        file.write_all(&buffer[..read])
            .map_err(PullError::io(part))?;
        bar.inc(read as u64);
    }
}

fn header(headers: &HeaderMap, name: &str) -> Option<String> {
    headers.get(name)?.to_str().ok().map(str::to_owned)
}

fn remove(path: &Path) -> Result<(), PullError> {
    std::fs::remove_file(path).map_err(PullError::io(path))
}

fn refused(url: &str, status: StatusCode) -> PullError {
    let hint = match status {
        StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => {
            " (a private or gated repository needs HF_TOKEN)"
        }
        _ => "",
    };
    let transient = status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS;
    PullError::Http {
        url: url.to_owned(),
        reason: format!("the server answered {status}{hint}"),
        transient,
    }
}

fn broken(url: &str, error: &reqwest::Error) -> PullError {
    // A host that cannot be reached at all is reported at once: there is another source to try.
    PullError::Http {
        url: url.to_owned(),
        reason: chain(error),
        transient: !error.is_connect() && !error.is_builder(),
    }
}

/// An error with everything that caused it.
fn chain(error: &dyn std::error::Error) -> String {
    let causes =
        std::iter::successors(Some(error), |error| error.source()).map(|error| error.to_string());
    causes.collect::<Vec<_>>().join(": ")
}

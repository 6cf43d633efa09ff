//! Why a request failed, in the server's own words where it has some.

use placeformer_core::retry::{Retry, parse_retry_after};
use reqwest::StatusCode;
use serde::Deserialize;
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

/// The code of a failure without an answer, where the server's error codes are shown.
pub(in crate::cli) const UNREACHABLE: &str = "unreachable";

/// A request to a server failed.
#[derive(Debug, thiserror::Error)]
pub(in crate::cli) enum ClientError {
    /// The HTTP client cannot be made.
    #[error("the HTTP client cannot be made")]
    Client(#[source] reqwest::Error),
    /// The thread that drives the connection cannot be started.
    #[error("the HTTP client cannot start")]
    Runtime(#[source] io::Error),
    /// A file that was to be sent cannot be read.
    #[error("cannot read {}", path.display())]
    ReadFile {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file that should hold a certificate holds none.
    #[error("there is no certificate (PEM) in {}", path.display())]
    NoCertificate {
        /// The file.
        path: PathBuf,
    },
    /// No answer came.
    #[error("cannot reach the server at {server} (is it running?)")]
    Unreachable {
        /// Its address.
        server: String,
        /// Why.
        source: reqwest::Error,
    },
    /// An answer began and did not end.
    #[error("the answer broke off")]
    BrokenOff {
        /// The header of this name, which had arrived already.
        retry_after: Option<String>,
        /// Why.
        source: reqwest::Error,
    },
    /// The server answered that it will not.
    #[error("{0}")]
    Refused(Problem),
}

impl ClientError {
    /// Whether the same request may succeed later.
    pub(in crate::cli) fn retry(&self) -> Retry {
        match self {
            Self::Unreachable { .. } => Retry::Later { after: None },
            Self::BrokenOff { retry_after, .. } => Retry::Later {
                after: retry_after.as_deref().and_then(parse_retry_after),
            },
            Self::Refused(problem) => problem.retry(),
            Self::Client(_)
            | Self::Runtime(_)
            | Self::ReadFile { .. }
            | Self::NoCertificate { .. } => Retry::Never,
        }
    }

    /// A code of the server's error table, or [`UNREACHABLE`] where no answer came.
    pub(in crate::cli) fn code(&self) -> &str {
        match self {
            Self::Refused(problem) => &problem.code,
            _ => UNREACHABLE,
        }
    }

    /// The cause in one sentence, without the address.
    pub(in crate::cli) fn detail(&self) -> String {
        match self {
            Self::Refused(problem) => problem.detail_or_title(),
            Self::Unreachable { source, .. } => chain(source),
            Self::BrokenOff { source, .. } => source.to_string(),
            other => chain(other),
        }
    }
}

/// An error with everything that caused it.
fn chain(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    let causes: Vec<String> = causes.map(|error| error.to_string()).collect();
    causes.join(": ")
}

/// A refusal, from the problem document (RFC 9457) that the server sends. A proxy in front of the
/// server refuses without one; then the status alone is known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::cli) struct Problem {
    status: StatusCode,
    code: String,
    title: Option<String>,
    detail: Option<String>,
    request_id: Option<String>,
    retryable: bool,
    retry_after: Option<Duration>,
}

/// The fields of a problem document that are of use here.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Document {
    code: Option<String>,
    title: Option<String>,
    detail: Option<String>,
    request_id: Option<String>,
    retryable: Option<bool>,
}

impl Problem {
    pub(super) fn read(status: StatusCode, retry_after: Option<&str>, body: &[u8]) -> Self {
        let document: Document = serde_json::from_slice(body).unwrap_or_default();
        let code = document
            .code
            .unwrap_or_else(|| format!("http_{}", status.as_u16()));
        // A proxy that cannot reach a restarting server says so without our document.
        let passes = matches!(status.as_u16(), 408 | 429 | 500 | 502 | 503 | 504);
        Self {
            status,
            code,
            title: document.title,
            detail: document.detail,
            request_id: document.request_id,
            retryable: document.retryable.unwrap_or(passes),
            retry_after: retry_after.and_then(parse_retry_after),
        }
    }

    fn retry(&self) -> Retry {
        if self.retryable {
            Retry::Later {
                after: self.retry_after,
            }
        } else {
            Retry::Never
        }
    }

    fn detail_or_title(&self) -> String {
        self.detail
            .clone()
            .or_else(|| self.title.clone())
            .unwrap_or_else(|| format!("the server answered {}", self.status))
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(title) = &self.title else {
            return f.write_str(&self.detail_or_title());
        };
        let status = self.status.as_u16();
        let detail = self.detail.as_deref().unwrap_or_default();
        let request_id = self.request_id.as_deref().unwrap_or_default();
        write!(f, "{title} ({status}): {detail} [request {request_id}]")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BUSY: &[u8] = br#"{"title": "Overloaded", "code": "overloaded", "retryable": true,
        "detail": "the queue is full", "request_id": "r-1"}"#;

    #[test]
    fn a_problem_document_is_shown_with_its_request() {
        let busy = Problem::read(StatusCode::SERVICE_UNAVAILABLE, Some("3"), BUSY);
        assert_eq!(
            busy.to_string(),
            "Overloaded (503): the queue is full [request r-1]"
        );
        let error = ClientError::Refused(busy);
        assert_eq!(error.code(), "overloaded");
        assert_eq!(error.detail(), "the queue is full");
        let after = Some(Duration::from_secs(3));
        assert_eq!(error.retry(), Retry::Later { after });
    }

    #[test]
    fn the_servers_word_on_retries_counts_more_than_the_status() {
        let read = |status, body: &[u8]| Problem::read(status, None, body).retry();
        let later = Retry::Later { after: None };
        let unavailable = StatusCode::SERVICE_UNAVAILABLE;
        assert_eq!(read(unavailable, b"<html>"), later);
        assert_eq!(read(unavailable, br#"{"retryable": false}"#), Retry::Never);
        assert_eq!(read(StatusCode::CONFLICT, b""), Retry::Never);
        assert_eq!(read(StatusCode::CONFLICT, br#"{"retryable": true}"#), later);
    }

    #[test]
    fn a_refusal_without_a_document_names_its_status() {
        let error = ClientError::Refused(Problem::read(StatusCode::BAD_GATEWAY, None, b"<html>"));
        assert_eq!(error.to_string(), "the server answered 502 Bad Gateway");
        assert_eq!(error.code(), "http_502");
    }
}

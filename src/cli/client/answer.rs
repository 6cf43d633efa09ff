//! One answer of the server, read to its end.

use super::ClientError;
use super::error::Problem;
use bytes::Bytes;
use reqwest::StatusCode;
use serde_json::Value;
use std::borrow::Cow;

/// What the server answered.
#[derive(Debug)]
pub(in crate::cli) struct Answer {
    status: StatusCode,
    /// The header of this name, as it came.
    retry_after: Option<String>,
    body: Bytes,
}

impl Answer {
    pub(super) fn new(status: StatusCode, retry_after: Option<String>, body: Bytes) -> Self {
        Self {
            status,
            retry_after,
            body,
        }
    }

    /// Its status.
    pub(in crate::cli) fn status(&self) -> StatusCode {
        self.status
    }

    /// Whether the server says when to come back.
    pub(in crate::cli) fn has_retry_after(&self) -> bool {
        self.retry_after.is_some()
    }

    /// Its body as text.
    pub(in crate::cli) fn text(&self) -> Cow<'_, str> {
        String::from_utf8_lossy(&self.body)
    }

    /// Its body as JSON; null where it is none.
    pub(in crate::cli) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_default()
    }

    /// The answer itself if its status is a success, else the error that it describes.
    ///
    /// # Errors
    /// [`ClientError::Refused`] for every other status.
    pub(in crate::cli) fn into_success(self) -> Result<Self, ClientError> {
        if self.status.is_success() {
            return Ok(self);
        }
        let problem = Problem::read(self.status, self.retry_after.as_deref(), &self.body);
        Err(ClientError::Refused(problem))
    }
}

//! The body of one file, which continues where an earlier attempt stopped.

use super::{Hub, chain, refused};
use crate::error::PullError;
use placeformer_core::progress::Task;
use placeformer_core::retry::Retry;
use reqwest::StatusCode;
use reqwest::blocking::Response;
use reqwest::header::{ACCEPT_ENCODING, RANGE};
use reqwest::redirect::Policy;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::Path;

/// Bytes read from the connection at once.
const CHUNK: usize = 1 << 16;

/// One file on its way to the disk.
pub(super) struct Download<'a> {
    pub(super) hub: &'a Hub,
    pub(super) url: &'a str,
    /// Where the bytes go.
    pub(super) part: &'a Path,
    /// How many there are, if the hub states it.
    pub(super) size: Option<u64>,
    pub(super) task: &'a Task<'a>,
}

impl Download<'_> {
    /// Brings the file to its full length, in as many attempts as the hub is worth.
    pub(super) fn complete(&self) -> Result<(), PullError> {
        if let Some(size) = self.size {
            self.task.set_total(size);
        }
        self.hub.retrying(|| self.attempt())
    }

    fn attempt(&self) -> Result<(), PullError> {
        let mut file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(self.part)
            .map_err(PullError::io(self.part))?;
        let mut have = self.length(&file)?;
        if self.size == Some(have) {
            return Ok(());
        }
        if self.size.is_some_and(|size| have > size) {
            self.truncate(&file)?;
            have = 0;
        }
        let response = self.request_from(have)?;
        if have > 0 && response.status() != StatusCode::PARTIAL_CONTENT {
            // The server ignored the range and sends everything.
            self.truncate(&file)?;
            have = 0;
        }
        self.task.set_done(have);
        self.append(response, &mut file)?;
        file.sync_all().map_err(PullError::io(self.part))?;
        self.expect_whole(self.length(&file)?)
    }

    fn length(&self, file: &File) -> Result<u64, PullError> {
        let metadata = file.metadata().map_err(PullError::io(self.part))?;
        Ok(metadata.len())
    }

    fn truncate(&self, file: &File) -> Result<(), PullError> {
        file.set_len(0).map_err(PullError::io(self.part))
    }

    /// Asks for the bytes from `start` on.
    fn request_from(&self, start: u64) -> Result<Response, PullError> {
        let client = self.hub.client(Policy::limited(super::REDIRECTIONS))?;
        let mut request = client.get(self.url).header(ACCEPT_ENCODING, "identity");
        if start > 0 {
            request = request.header(RANGE, format!("bytes={start}-"));
        }
        let response = self.hub.send(request, self.url)?;
        if response.status().is_success() {
            Ok(response)
        } else {
            Err(refused(self.url, &response))
        }
    }

    fn append(&self, mut response: Response, file: &mut File) -> Result<(), PullError> {
        let mut buffer = vec![0; CHUNK];
        loop {
            let read = response
                .read(&mut buffer)
                .map_err(|error| self.interrupted(chain(&error)))?;
            if read == 0 {
                return Ok(());
            }
            file.write_all(&buffer[..read])
                .map_err(PullError::io(self.part))?;
            self.task.add(read as u64);
        }
    }

    fn expect_whole(&self, have: u64) -> Result<(), PullError> {
        match self.size {
            Some(size) if have != size => {
                let reason = format!("the connection ended after {have} of {size} bytes");
                Err(self.interrupted(reason))
            }
            _ => Ok(()),
        }
    }

    /// The error for a transfer that broke off; the next attempt continues it.
    fn interrupted(&self, reason: String) -> PullError {
        PullError::Http {
            url: self.url.to_owned(),
            reason,
            retry: Retry::Later { after: None },
        }
    }
}

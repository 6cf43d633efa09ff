//! What became of every photo, as JSON lines and as a summary.

use anyhow::Context;
use serde::Serialize;
use std::fmt;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// What became of a photo.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Status {
    /// New in the map.
    Created,
    /// Sent, and found to be in the map already.
    Present,
    /// Known to be in the map, so not sent.
    Skipped,
    /// Not in the map.
    Failed,
}

/// One line of the report: what became of one photo.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct PhotoRecord {
    /// The photo's name below the folder.
    pub(super) file: String,
    pub(super) status: Status,
    /// The reference it became.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) reference: Option<String>,
    /// Whether its position is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) located: Option<bool>,
    /// Why it failed: a code of the error table or one of the import's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) code: Option<String>,
    /// Why it failed, in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) detail: Option<String>,
    /// How often it was sent.
    pub(super) attempts: u32,
}

impl PhotoRecord {
    fn new(file: &str, status: Status, attempts: u32) -> Self {
        Self {
            file: file.into(),
            status,
            reference: None,
            located: None,
            code: None,
            detail: None,
            attempts,
        }
    }

    pub(super) fn skipped(file: &str) -> Self {
        Self::new(file, Status::Skipped, 0)
    }

    pub(super) fn stored(
        file: &str,
        status: Status,
        reference: String,
        located: bool,
        attempts: u32,
    ) -> Self {
        Self {
            reference: Some(reference),
            located: Some(located),
            ..Self::new(file, status, attempts)
        }
    }

    pub(super) fn failed(file: &str, code: &str, detail: String, attempts: u32) -> Self {
        Self {
            code: Some(code.into()),
            detail: Some(detail),
            ..Self::new(file, Status::Failed, attempts)
        }
    }
}

/// Counts over all photos.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Summary {
    /// New in the map.
    pub(super) created: usize,
    /// Sent, and found to be in the map already.
    pub(super) present: usize,
    /// Known to be in the map, so not sent.
    pub(super) skipped: usize,
    /// Not in the map.
    pub(super) failed: usize,
    /// Of those created, how many have no position.
    pub(super) without_position: usize,
}

impl Summary {
    fn count(&mut self, record: &PhotoRecord) {
        match record.status {
            Status::Created => self.created += 1,
            Status::Present => self.present += 1,
            Status::Skipped => self.skipped += 1,
            Status::Failed => self.failed += 1,
        }
        if record.status == Status::Created && record.located == Some(false) {
            self.without_position += 1;
        }
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let there = self.present + self.skipped;
        write!(
            f,
            "{} created, {there} already there, {} failed",
            self.created, self.failed
        )?;
        if self.without_position > 0 {
            write!(
                f,
                "; {} of the created have no position",
                self.without_position
            )?;
        }
        Ok(())
    }
}

/// Collects the records of all threads. Every line is handed to the system before the thread goes
/// on to its next photo.
pub(super) struct ImportReport(Mutex<Inner>);

struct Inner {
    file: Option<File>,
    summary: Summary,
}

impl ImportReport {
    /// Starts a new report; without a path only the summary is kept.
    pub(super) fn create(path: Option<&Path>) -> anyhow::Result<Self> {
        let file = match path {
            Some(path) => {
                let file = File::create(path)
                    .with_context(|| format!("cannot write {}", path.display()))?;
                Some(file)
            }
            None => None,
        };
        let summary = Summary::default();
        Ok(Self(Mutex::new(Inner { file, summary })))
    }

    /// Adds a record.
    ///
    /// # Errors
    /// The report's file cannot be written.
    pub(super) fn add(&self, record: &PhotoRecord) -> std::io::Result<()> {
        let mut inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        inner.summary.count(record);
        if let Some(file) = &mut inner.file {
            let line = serde_json::to_string(record).map_err(std::io::Error::other)? + "\n";
            file.write_all(line.as_bytes())?;
        }
        Ok(())
    }

    /// Makes the report durable and returns the counts.
    pub(super) fn finish(self) -> anyhow::Result<Summary> {
        let inner = self.0.into_inner().unwrap_or_else(PoisonError::into_inner);
        if let Some(file) = inner.file {
            file.sync_all().context("cannot write the report")?;
        }
        Ok(inner.summary)
    }
}

//! What became of every photo, as JSON lines and as a summary.

use anyhow::Context;
use serde::Serialize;
use std::fmt;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::sync::Mutex;

/// The kinds of verdict.
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

/// One line of the report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Verdict {
    pub(super) file: String,
    pub(super) status: Status,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) reference: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) located: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) code: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) detail: Option<String>,
    pub(super) attempts: u32,
}

impl Verdict {
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

/// Counts of all verdicts.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Summary {
    pub(super) created: usize,
    pub(super) present: usize,
    pub(super) skipped: usize,
    pub(super) failed: usize,
    /// Of those created, how many have no position.
    pub(super) without_position: usize,
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

/// Collects verdicts from all threads; every line is on its way to the disk before the next image
/// begins.
pub(super) struct VerdictLog(Mutex<Inner>);

struct Inner {
    file: Option<File>,
    summary: Summary,
}

impl VerdictLog {
    /// Starts a new report; without a path only the summary is kept.
    pub(super) fn create(path: Option<&Path>) -> anyhow::Result<Self> {
        let create = |path: &Path| {
            File::create(path).with_context(|| format!("cannot write {}", path.display()))
        };
        let file = path.map(create).transpose()?;
        Ok(Self(Mutex::new(Inner {
            file,
            summary: Summary::default(),
        })))
    }

    /// Adds a verdict.
    pub(super) fn add(&self, verdict: &Verdict) -> std::io::Result<()> {
        let mut inner = self
            .0
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        match verdict.status {
            Status::Created => inner.summary.created += 1,
            Status::Present => inner.summary.present += 1,
            Status::Skipped => inner.summary.skipped += 1,
            Status::Failed => inner.summary.failed += 1,
        }
        inner.summary.without_position +=
            usize::from(verdict.status == Status::Created && verdict.located == Some(false));
        if let Some(file) = &mut inner.file {
            let line = serde_json::to_string(verdict).map_err(std::io::Error::other)? + "\n";
            file.write_all(line.as_bytes())?;
        }
        Ok(())
    }

    /// Makes the report durable and returns the counts.
    pub(super) fn finish(self) -> anyhow::Result<Summary> {
        let inner = self
            .0
            .into_inner()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        if let Some(file) = inner.file {
            file.sync_all().context("cannot write the report")?;
        }
        Ok(inner.summary)
    }
}

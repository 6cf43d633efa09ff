//! What became of every photo, as JSON lines and as a summary.

use anyhow::Context;
use placeformer_core::folder::{PassReason, PassedOver};
use placeformer_core::printable::Printable;
use serde::Serialize;
use std::cmp::Reverse;
use std::collections::BTreeMap;
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
    /// In the map before; what the map knows about it was changed.
    Updated,
    /// Not in the map, or not as it should be.
    Failed,
    /// No photo that can be imported.
    Ignored,
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
    /// Which fields of the reference were changed.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) changed: Vec<&'static str>,
    /// What is wrong with the position in its name; the photo was imported all the same.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) warning: Option<String>,
    /// Why it failed or was ignored: a code of the error table or one of the import's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) code: Option<String>,
    /// Why it failed or was ignored, in words.
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
            changed: Vec::new(),
            warning: None,
            code: None,
            detail: None,
            attempts,
        }
    }

    pub(super) fn skipped(file: &str, attempts: u32) -> Self {
        Self::new(file, Status::Skipped, attempts)
    }

    pub(super) fn updated(
        file: &str,
        reference: String,
        changed: Vec<&'static str>,
        attempts: u32,
    ) -> Self {
        Self {
            reference: Some(reference),
            changed,
            ..Self::new(file, Status::Updated, attempts)
        }
    }

    /// An entry of the folder that is no image.
    pub(super) fn passed_over(entry: &PassedOver) -> Self {
        let status = match entry.is_loss {
            true => Status::Failed,
            false => Status::Ignored,
        };
        Self {
            code: Some(entry.reason.code().into()),
            detail: Some(entry.reason.detail()),
            ..Self::new(&entry.name, status, 0)
        }
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
    /// In the map before, and changed.
    pub(super) updated: usize,
    /// Not in the map, or not as they should be.
    pub(super) failed: usize,
    /// No photos that can be imported.
    pub(super) ignored: usize,
    /// Photos whose name carries a doubtful position.
    pub(super) warned: usize,
    /// Of those created, how many have no position.
    pub(super) without_position: usize,
}

impl Summary {
    fn count(&mut self, record: &PhotoRecord) {
        match record.status {
            Status::Created => self.created += 1,
            Status::Present => self.present += 1,
            Status::Skipped => self.skipped += 1,
            Status::Updated => self.updated += 1,
            Status::Failed => self.failed += 1,
            Status::Ignored => self.ignored += 1,
        }
        self.warned += usize::from(record.warning.is_some());
        if record.status == Status::Created && record.located == Some(false) {
            self.without_position += 1;
        }
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let there = self.present + self.skipped;
        write!(f, "{} created, ", self.created)?;
        if self.updated > 0 {
            write!(f, "{} updated, ", self.updated)?;
        }
        write!(f, "{there} already there, {} failed", self.failed)?;
        if self.ignored > 0 {
            write!(f, ", {} ignored", self.ignored)?;
        }
        if self.without_position > 0 {
            write!(
                f,
                "; {} of the created have no position",
                self.without_position
            )?;
        }
        if self.warned > 0 {
            write!(f, "; {} names carry a doubtful position", self.warned)?;
        }
        Ok(())
    }
}

/// What was ignored, in words, the most frequent first: `2 heic, 1 mp4, 1 hidden`. At most a few
/// kinds are named.
pub(super) fn describe_ignored(entries: &[PassedOver]) -> String {
    const NAMED: usize = 8;
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for entry in entries.iter().filter(|entry| !entry.is_loss) {
        let kind = match &entry.reason {
            PassReason::OtherFile(Some(ending)) => Printable(ending).to_string(),
            PassReason::OtherFile(None) => "without an ending".to_owned(),
            other => other.code().replace('_', " "),
        };
        *counts.entry(kind).or_default() += 1;
    }
    let mut counts: Vec<(String, usize)> = counts.into_iter().collect();
    counts.sort_by_key(|(_, count)| Reverse(*count));
    let rest: usize = counts.iter().skip(NAMED).map(|(_, count)| count).sum();
    let named = counts.iter().take(NAMED);
    let mut parts: Vec<String> = named
        .map(|(kind, count)| format!("{count} {kind}"))
        .collect();
    if rest > 0 {
        parts.push(format!("{rest} others"));
    }
    parts.join(", ")
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_ignored_is_named_by_kind() {
        let entry = |reason, is_loss| PassedOver {
            name: "x".into(),
            reason,
            is_loss,
        };
        let heic = || PassReason::OtherFile(Some("heic".into()));
        let entries = [
            entry(PassReason::LinkedFolder, false),
            entry(heic(), false),
            entry(PassReason::OtherFile(None), false),
            entry(heic(), false),
            entry(PassReason::SpecialFile, true),
            entry(PassReason::OtherFile(Some("\u{1b}[2J".into())), false),
        ];
        let described = describe_ignored(&entries);
        let expected = "2 heic, 1 \\u{1b}[2J, 1 linked folder, 1 without an ending";
        assert_eq!(described, expected);
        assert_eq!(describe_ignored(&[]), "");
    }
}

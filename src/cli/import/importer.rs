//! The import itself: several threads take photos from one list and hand them to the sink.

use super::metadata::{Metadata, PhotoFacts};
use super::photo_file;
use super::report::{ImportReport, PhotoRecord, Status};
use super::sink::{self, Outcome, Sink, Stored, Upload};
use crate::cli::output::note;
use placeformer_core::printable::Printable;
use placeformer_core::progress::{Progress, Task};
use placeformer_core::types::{ContentHash, ExternalId, GeoPoint, MapName};
use placeformer_store::ReferencePatch;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

/// What an import needs besides the photos.
pub(super) struct Importer<'a> {
    pub(super) sink: &'a dyn Sink,
    pub(super) metadata: &'a Metadata,
    pub(super) map: &'a MapName,
    /// What the map has already, by external id.
    pub(super) present: &'a HashMap<String, Stored>,
    /// Whether photos for which no position is known are refused.
    pub(super) requires_position: bool,
    /// Names shown so far to be wrong.
    pub(super) warnings: AtomicUsize,
    pub(super) report: &'a ImportReport,
    pub(super) progress: &'a dyn Progress,
}

/// The photos, as the threads share them.
struct Queue<'a> {
    images: &'a [(String, PathBuf)],
    /// The next photo to take.
    next: AtomicUsize,
    /// Why all threads should stop, once one of them knows a reason.
    stopped: OnceLock<String>,
}

impl<'a> Queue<'a> {
    /// The next photo, unless there is none or the import was stopped.
    fn take(&self) -> Option<&'a (String, PathBuf)> {
        if self.stopped.get().is_some() {
            return None;
        }
        self.images.get(self.next.fetch_add(1, Ordering::Relaxed))
    }

    /// Stops the import; the first reason counts.
    fn stop(&self, reason: String) {
        let _ = self.stopped.set(reason);
    }
}

/// A photo that did not get into the map.
pub(super) struct Failure {
    /// A code of the error table or one of the import's own.
    code: String,
    detail: String,
    attempts: u32,
}

impl Failure {
    pub(super) fn unsent(code: &str, detail: impl Into<String>) -> Self {
        Self {
            code: code.to_owned(),
            detail: detail.into(),
            attempts: 0,
        }
    }

    #[cfg(test)]
    pub(super) fn code(&self) -> &str {
        &self.code
    }

    fn unexpected(attempts: u32) -> Self {
        Self {
            attempts,
            ..Self::unsent("unexpected_answer", "the answer belongs to another request")
        }
    }

    /// Adds what is wrong with the photo's name, which may be why it failed.
    fn with_doubt(mut self, doubt: Option<&str>) -> Self {
        if let Some(doubt) = doubt.filter(|_| self.code == "no_position") {
            self.detail = format!("{}; the name: {doubt}", self.detail);
        }
        self
    }
}

impl Importer<'_> {
    /// Imports all photos from `concurrency` threads; says why if it had to stop before the end.
    pub(super) fn run(&self, images: &[(String, PathBuf)], concurrency: usize) -> Option<String> {
        let queue = Queue {
            images,
            next: AtomicUsize::new(0),
            stopped: OnceLock::new(),
        };
        let task = Task::begin(self.progress, "importing", images.len() as u64);
        std::thread::scope(|scope| {
            for _ in 0..concurrency.min(images.len()) {
                scope.spawn(|| self.work(&queue, &task));
            }
        });
        queue.stopped.into_inner()
    }

    /// Imports one photo after the other until none is left.
    fn work(&self, queue: &Queue<'_>, task: &Task<'_>) {
        while let Some((name, path)) = queue.take() {
            let record = match self.import(name, path) {
                Ok(record) => record,
                Err(failure) => self.failed(name, failure, queue),
            };
            if let Err(error) = self.report.add(&record) {
                queue.stop(format!("cannot write the report: {error}"));
            }
            task.add(1);
        }
    }

    /// Shows a failure at once, and stops the import if every other photo would fail, too.
    fn failed(&self, name: &str, failure: Failure, queue: &Queue<'_>) -> PhotoRecord {
        let Failure {
            code,
            detail,
            attempts,
        } = failure;
        self.show(name, &detail);
        if sink::is_hopeless(&code) {
            queue.stop(detail.clone());
        }
        PhotoRecord::failed(name, &code, detail, attempts)
    }

    fn show(&self, name: &str, detail: &str) {
        let line = format!("{name}: {detail}");
        let shown = Printable(line);
        self.progress.suspend(&mut || note!("{shown}"));
    }

    /// Imports one photo, or brings up to date what the map knows about it.
    fn import(&self, name: &str, path: &Path) -> Result<PhotoRecord, Failure> {
        let external_id: ExternalId = name
            .parse()
            .map_err(|error| Failure::unsent("invalid_parameter", format!("{error}")))?;
        let image = photo_file::read(path)?;
        let facts = self.metadata.facts(name, external_id, &image);
        let doubt = facts.doubt.clone();
        let record = match self.present.get(name) {
            Some(stored) if stored.content != ContentHash::of(&image) => Err(conflict()),
            Some(stored) => self.refresh(name, stored, &facts, 0),
            None => self.send(name, facts, image),
        };
        let record = record.map_err(|failure| failure.with_doubt(doubt.as_deref()))?;
        if let Some(doubt) = &doubt {
            self.warn(name, doubt);
        }
        Ok(PhotoRecord {
            warning: doubt,
            ..record
        })
    }

    /// Shows what is wrong with a name. If it is wrong with many, the report says so of the others.
    fn warn(&self, name: &str, doubt: &str) {
        const SHOWN: usize = 10;
        match self.warnings.fetch_add(1, Ordering::Relaxed) {
            before if before < SHOWN => self.show(name, &format!("warning: {doubt}")),
            SHOWN => self.show("warning", "more names are wrong; --report has them all"),
            _ => {}
        }
    }

    fn send(&self, name: &str, facts: PhotoFacts, image: Vec<u8>) -> Result<PhotoRecord, Failure> {
        self.check_position(facts.fields.location)?;
        let located = facts.fields.location.is_some();
        let sent = self.sink.send(Upload {
            map: self.map.clone(),
            fields: facts.fields.clone(),
            image: image.into(),
        });
        let attempts = sent.attempts;
        match sent.outcome {
            Outcome::Created(id) => {
                let status = Status::Created;
                Ok(PhotoRecord::stored(name, status, id, located, attempts))
            }
            Outcome::Present(stored) => {
                let record = self.refresh(name, &stored, &facts, attempts)?;
                let is_unchanged = record.status == Status::Skipped;
                let id = stored.id.to_string();
                let located = stored.location.is_some();
                let present = PhotoRecord::stored(name, Status::Present, id, located, attempts);
                Ok(if is_unchanged { present } else { record })
            }
            Outcome::Updated => Err(Failure::unexpected(attempts)),
            Outcome::Refused { code, detail } => Err(Failure {
                code,
                detail,
                attempts,
            }),
        }
    }

    /// Sends what this import knows better than the map about a photo that is there.
    fn refresh(
        &self,
        name: &str,
        stored: &Stored,
        facts: &PhotoFacts,
        attempts: u32,
    ) -> Result<PhotoRecord, Failure> {
        self.check_position(facts.fields.location.or(stored.location))?;
        let (patch, changed) = difference(stored, facts);
        if changed.is_empty() {
            return Ok(PhotoRecord::skipped(name, attempts));
        }
        let sent = self.sink.update(stored.id, patch);
        let attempts = attempts + sent.attempts;
        match sent.outcome {
            Outcome::Updated => {
                let id = stored.id.to_string();
                Ok(PhotoRecord::updated(name, id, changed, attempts))
            }
            Outcome::Refused { code, detail } => Err(Failure {
                code,
                detail: format!("the map holds it, but it could not be updated: {detail}"),
                attempts,
            }),
            Outcome::Created(_) | Outcome::Present(_) => Err(Failure::unexpected(attempts)),
        }
    }

    fn check_position(&self, location: Option<GeoPoint>) -> Result<(), Failure> {
        if self.requires_position && location.is_none() {
            let detail = "no position in the positions file, the name or the photo itself";
            return Err(Failure::unsent("no_position", detail));
        }
        Ok(())
    }
}

fn conflict() -> Failure {
    let detail = "the map holds another image under this name; delete it there or rename this one";
    Failure::unsent("external_id_conflict", detail)
}

/// What to change of a reference, and the names of those fields. A value replaces another only if
/// it was given to this import; nothing is ever cleared.
fn difference(stored: &Stored, facts: &PhotoFacts) -> (ReferencePatch, Vec<&'static str>) {
    let PhotoFacts { fields, given, .. } = facts;
    let location = better(
        fields.location,
        stored.location,
        given.location,
        PartialEq::eq,
    );
    let alt = better(fields.alt, stored.alt, given.alt, PartialEq::eq);
    let heading = better(fields.heading, stored.heading, given.heading, PartialEq::eq);
    let captured_at = better(
        fields.captured_at,
        stored.captured_at,
        given.captured_at,
        PartialEq::eq,
    );
    let names = [
        ("location", location.is_some()),
        ("alt", alt.is_some()),
        ("heading", heading.is_some()),
        ("captured_at", captured_at.is_some()),
    ];
    let changed = names.into_iter().filter(|(_, is_changed)| *is_changed);
    let patch = ReferencePatch {
        location: location.map(Some),
        alt: alt.map(Some),
        heading: heading.map(Some),
        captured_at: captured_at.map(Some),
        ..ReferencePatch::default()
    };
    (patch, changed.map(|(name, _)| name).collect())
}

/// The value known now, if it should take the place of the stored one.
fn better<T>(
    known: Option<T>,
    stored: Option<T>,
    is_given: bool,
    is_same: fn(&T, &T) -> bool,
) -> Option<T> {
    let known = known?;
    match stored {
        None => Some(known),
        Some(stored) => (is_given && !is_same(&known, &stored)).then_some(known),
    }
}

#[cfg(test)]
mod tests;

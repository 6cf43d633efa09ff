//! The import itself: several threads take photos from one list and hand them to the sink.

use super::metadata::Metadata;
use super::report::{ImportReport, PhotoRecord, Status};
use super::sink::{self, Outcome, Sink, Upload};
use crate::cli::output::note;
use placeformer_core::progress::{Progress, Task};
use placeformer_core::types::{ContentHash, ExternalId, MapName};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

/// What an import needs besides the photos.
pub(super) struct Importer<'a> {
    pub(super) sink: &'a dyn Sink,
    pub(super) metadata: &'a Metadata,
    pub(super) map: &'a MapName,
    /// What the map has already: the hash of the content by external id.
    pub(super) present: &'a HashMap<String, String>,
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
struct Failure {
    /// A code of the error table or one of the import's own.
    code: String,
    detail: String,
    attempts: u32,
}

impl Failure {
    fn unsent(code: &str, detail: impl Into<String>) -> Self {
        Self {
            code: code.to_owned(),
            detail: detail.into(),
            attempts: 0,
        }
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
        self.progress.suspend(&mut || note!("{name}: {detail}"));
        if sink::is_hopeless(&code) {
            queue.stop(detail.clone());
        }
        PhotoRecord::failed(name, &code, detail, attempts)
    }

    /// Imports one photo, or skips it if the map has it.
    fn import(&self, name: &str, path: &Path) -> Result<PhotoRecord, Failure> {
        let external_id: ExternalId = name
            .parse()
            .map_err(|error| Failure::unsent("invalid_parameter", format!("{error}")))?;
        let image = std::fs::read(path)
            .map_err(|error| Failure::unsent("unreadable_file", error.to_string()))?;
        if let Some(present) = self.present.get(name) {
            return skip(name, present, &image);
        }
        let fields = self
            .metadata
            .fields(name, external_id, &image)
            .map_err(|detail| Failure::unsent("no_position", detail))?;
        let located = fields.location.is_some();
        let sent = self.sink.send(Upload {
            map: self.map.clone(),
            fields,
            image: image.into(),
        });
        let attempts = sent.attempts;
        let stored = |status, id| PhotoRecord::stored(name, status, id, located, attempts);
        match sent.outcome {
            Outcome::Created(id) => Ok(stored(Status::Created, id)),
            Outcome::Present(id) => Ok(stored(Status::Present, id)),
            Outcome::Refused { code, detail } => Err(Failure {
                code,
                detail,
                attempts,
            }),
        }
    }
}

/// The record of a photo whose name the map knows with content of the hash `present`.
fn skip(name: &str, present: &str, image: &[u8]) -> Result<PhotoRecord, Failure> {
    if present == ContentHash::of(image).to_string() {
        return Ok(PhotoRecord::skipped(name));
    }
    let detail = "the map holds another image under this name; delete it there or rename this one";
    Err(Failure::unsent("external_id_conflict", detail))
}

#[cfg(test)]
mod tests {
    use super::super::report::Summary;
    use super::super::sink::Sent;
    use super::*;
    use placeformer_core::folder::list_images;
    use placeformer_core::progress::Silent;
    use std::sync::Mutex;

    /// Keeps what it is sent; refuses images that start with `!`, with the code that follows.
    #[derive(Default)]
    struct Memory(Mutex<HashMap<String, String>>);

    impl Sink for Memory {
        fn present(&self, _map: &MapName) -> anyhow::Result<HashMap<String, String>> {
            Ok(self.0.lock().unwrap().clone())
        }

        fn send(&self, upload: Upload) -> Sent {
            if let Some(code) = upload.image.strip_prefix(b"!") {
                let code = String::from_utf8_lossy(code).into_owned();
                return Sent {
                    outcome: Outcome::Refused {
                        code,
                        detail: "refused".into(),
                    },
                    attempts: 1,
                };
            }
            let id = upload.fields.external_id.unwrap().to_string();
            self.0
                .lock()
                .unwrap()
                .insert(id, ContentHash::of(&upload.image).to_string());
            Sent {
                outcome: Outcome::Created("id".into()),
                attempts: 1,
            }
        }
    }

    fn import(folder: &Path, sink: &Memory, path: &Path) -> (Summary, Option<String>) {
        let images = list_images(folder).unwrap();
        let metadata = Metadata::read(None, Path::new("."), None, false).unwrap();
        let map = "m".parse().unwrap();
        let present = sink.present(&map).unwrap();
        let report = ImportReport::create(Some(path)).unwrap();
        let importer = Importer {
            sink,
            metadata: &metadata,
            map: &map,
            present: &present,
            report: &report,
            progress: &Silent,
        };
        let stopped = importer.run(&images, 3);
        (report.finish().unwrap(), stopped)
    }

    #[test]
    fn a_second_import_skips_what_is_there_and_reports_what_changed() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        std::fs::create_dir_all(photos.join("sub")).unwrap();
        for name in ["a.jpg", "b.jpg", "sub/c.png"] {
            std::fs::write(photos.join(name), name).unwrap();
        }
        std::fs::write(photos.join("bad.jpg"), b"!image_undecodable").unwrap();
        let sink = Memory::default();
        let report = folder.path().join("report.jsonl");
        let (summary, stopped) = import(&photos, &sink, &report);
        assert_eq!((summary.created, summary.failed, stopped), (3, 1, None));
        std::fs::write(photos.join("b.jpg"), "other").unwrap();
        std::fs::remove_file(photos.join("bad.jpg")).unwrap();
        std::fs::write(photos.join("d.jpg"), "new").unwrap();
        let (summary, _) = import(&photos, &sink, &report);
        assert_eq!(
            (summary.created, summary.skipped, summary.failed),
            (1, 2, 1)
        );
        let lines: Vec<serde_json::Value> = std::fs::read_to_string(&report)
            .unwrap()
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect();
        assert_eq!(lines.len(), 4);
        let changed = lines.iter().find(|line| line["file"] == "b.jpg").unwrap();
        assert_eq!(
            (&changed["status"], &changed["code"]),
            (&"failed".into(), &"external_id_conflict".into())
        );
    }

    #[test]
    fn what_holds_for_every_image_stops_the_import() {
        let folder = tempfile::tempdir().unwrap();
        for i in 0..50 {
            std::fs::write(
                folder.path().join(format!("{i:02}.jpg")),
                b"!model_mismatch",
            )
            .unwrap();
        }
        let report = folder.path().join("report.jsonl");
        let (summary, stopped) = import(folder.path(), &Memory::default(), &report);
        assert!(
            summary.failed <= 3 && stopped.is_some(),
            "{summary} {stopped:?}"
        );
    }
}

use super::super::positions::Positions;
use super::super::report::Summary;
use super::super::sink::Sent;
use super::*;
use placeformer_core::folder::scan_folder;
use placeformer_core::progress::Silent;
use placeformer_core::types::{Heading, ReferenceId};
use std::sync::Mutex;

/// Keeps what it is sent; refuses images that start with `!`, with the code that follows.
#[derive(Default)]
struct Memory(Mutex<HashMap<String, Stored>>);

impl Memory {
    fn get(&self, name: &str) -> Stored {
        self.0.lock().unwrap()[name].clone()
    }
}

fn sent(outcome: Outcome) -> Sent {
    Sent {
        outcome,
        attempts: 1,
    }
}

impl Sink for Memory {
    fn present(&self, _map: &MapName) -> anyhow::Result<HashMap<String, Stored>> {
        Ok(self.0.lock().unwrap().clone())
    }

    fn send(&self, upload: Upload) -> Sent {
        if let Some(code) = upload.image.strip_prefix(b"!") {
            return sent(Outcome::Refused {
                code: String::from_utf8_lossy(code).into_owned(),
                detail: "refused".into(),
            });
        }
        let fields = upload.fields;
        let name = fields.external_id.unwrap().to_string();
        let mut map = self.0.lock().unwrap();
        if let Some(stored) = map.get(&name) {
            return sent(Outcome::Present(stored.clone()));
        }
        let stored = Stored {
            id: ReferenceId::generate(),
            content: ContentHash::of(&upload.image),
            location: fields.location,
            alt: fields.alt,
            heading: fields.heading,
            captured_at: fields.captured_at,
        };
        let id = stored.id.to_string();
        map.insert(name, stored);
        sent(Outcome::Created(id))
    }

    fn update(&self, id: ReferenceId, patch: ReferencePatch) -> Sent {
        let mut map = self.0.lock().unwrap();
        let stored = map.values_mut().find(|stored| stored.id == id).unwrap();
        if let Some(location) = patch.location {
            stored.location = location;
        }
        if let Some(alt) = patch.alt {
            stored.alt = alt;
        }
        if let Some(heading) = patch.heading {
            stored.heading = heading;
        }
        if let Some(captured_at) = patch.captured_at {
            stored.captured_at = captured_at;
        }
        sent(Outcome::Updated)
    }
}

/// An import into `sink`, with what is known of the photos.
struct Run<'a> {
    sink: &'a Memory,
    metadata: Metadata,
    requires_position: bool,
}

impl<'a> Run<'a> {
    fn new(sink: &'a Memory) -> Self {
        Self {
            sink,
            metadata: Metadata::default(),
            requires_position: false,
        }
    }

    fn with_positions(mut self, folder: &Path, csv: &str) -> Self {
        let table = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(table.path(), csv).unwrap();
        let images = scan_folder(folder).unwrap().images;
        self.metadata.positions = Positions::read(table.path(), folder, &images, None).unwrap();
        self
    }

    /// Imports, knowing what the map has.
    fn import(&self, folder: &Path, report: &Path) -> (Summary, Option<String>) {
        let present = self.sink.present(&"m".parse().unwrap()).unwrap();
        self.import_knowing(present, folder, report)
    }

    fn import_knowing(
        &self,
        present: HashMap<String, Stored>,
        folder: &Path,
        report: &Path,
    ) -> (Summary, Option<String>) {
        let images = scan_folder(folder).unwrap().images;
        let map = "m".parse().unwrap();
        let report = ImportReport::create(Some(report)).unwrap();
        let importer = Importer {
            sink: self.sink,
            metadata: &self.metadata,
            map: &map,
            present: &present,
            requires_position: self.requires_position,
            warnings: AtomicUsize::new(0),
            report: &report,
            progress: &Silent,
        };
        let stopped = importer.run(&images, 3);
        (report.finish().unwrap(), stopped)
    }
}

fn lines(report: &Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(report).unwrap();
    let lines = text.lines().map(|line| serde_json::from_str(line).unwrap());
    lines.collect()
}

fn folder_of(names: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in names {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, name).unwrap();
    }
    folder
}

#[test]
fn a_second_import_skips_what_is_there_and_reports_what_changed() {
    let folder = folder_of(&["photos/a.jpg", "photos/b.jpg", "photos/sub/c.png"]);
    let photos = folder.path().join("photos");
    std::fs::write(photos.join("bad.jpg"), b"!image_undecodable").unwrap();
    let sink = Memory::default();
    let report = folder.path().join("report.jsonl");
    let (summary, stopped) = Run::new(&sink).import(&photos, &report);
    assert_eq!((summary.created, summary.failed, stopped), (3, 1, None));
    std::fs::write(photos.join("b.jpg"), "other").unwrap();
    std::fs::remove_file(photos.join("bad.jpg")).unwrap();
    std::fs::write(photos.join("d.jpg"), "new").unwrap();
    let (summary, _) = Run::new(&sink).import(&photos, &report);
    assert_eq!(
        (summary.created, summary.skipped, summary.failed),
        (1, 2, 1)
    );
    let lines = lines(&report);
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
        let path = folder.path().join(format!("{i:02}.jpg"));
        std::fs::write(path, b"!model_mismatch").unwrap();
    }
    let report = folder.path().join("report.jsonl");
    let sink = Memory::default();
    let (summary, stopped) = Run::new(&sink).import(folder.path(), &report);
    assert!(
        summary.failed <= 3 && stopped.is_some(),
        "{summary} {stopped:?}"
    );
}

#[test]
fn positions_arrive_later_and_nothing_replaces_them_but_positions() {
    let folder = folder_of(&["photos/a.jpg", "photos/@500000@5000000@33@T@@@@@90@.jpg"]);
    let photos = folder.path().join("photos");
    let named = "@500000@5000000@33@T@@@@@90@.jpg";
    let report = folder.path().join("report.jsonl");
    let sink = Memory::default();
    let counts = |summary: Summary| {
        let there = summary.skipped + summary.present;
        (summary.created, summary.updated, there, summary.failed)
    };
    let (summary, _) = Run::new(&sink).import(&photos, &report);
    assert_eq!(counts(summary), (2, 0, 0, 0));
    let from_name = sink.get(named).location.unwrap();

    let csv = format!("file,lat,lon,captured_at\na.jpg,1,2,2026-05-17T09:30:00Z\n{named},3,4,\n");
    let with_positions = Run::new(&sink).with_positions(&photos, &csv);
    let (summary, _) = with_positions.import(&photos, &report);
    assert_eq!(counts(summary), (0, 2, 0, 0));
    assert_eq!(sink.get("a.jpg").location, GeoPoint::new(1.0, 2.0).ok());
    assert_eq!(sink.get(named).location, GeoPoint::new(3.0, 4.0).ok());
    assert_eq!(sink.get(named).heading, Heading::new(90.0).ok());
    assert_ne!(sink.get(named).location, Some(from_name));
    let changed = lines(&report);
    let a = changed.iter().find(|line| line["file"] == "a.jpg").unwrap();
    assert_eq!(a["status"], "updated");
    assert_eq!(a["changed"], serde_json::json!(["location", "captured_at"]));
    assert_eq!(a["reference"], sink.get("a.jpg").id.to_string());

    // Again, with and without the table: nothing changes.
    let (summary, _) = with_positions.import(&photos, &report);
    assert_eq!(counts(summary), (0, 0, 2, 0));
    let (summary, _) = Run::new(&sink).import(&photos, &report);
    assert_eq!(counts(summary), (0, 0, 2, 0));
    assert_eq!(sink.get(named).location, GeoPoint::new(3.0, 4.0).ok());

    // The map knows the photos, although the listing did not show them.
    let csv = "file,lat,lon\na.jpg,5,6\n";
    let other_positions = Run::new(&sink).with_positions(&photos, csv);
    let (summary, _) = other_positions.import_knowing(HashMap::new(), &photos, &report);
    assert_eq!(counts(summary), (0, 1, 1, 0));
    assert_eq!(sink.get("a.jpg").location, GeoPoint::new(5.0, 6.0).ok());
    assert!(sink.get("a.jpg").captured_at.is_some());
}

#[test]
fn a_required_position_may_be_the_maps() {
    let folder = folder_of(&["photos/a.jpg", "photos/@48.85@2.29@.jpg"]);
    let photos = folder.path().join("photos");
    let report = folder.path().join("report.jsonl");
    let sink = Memory::default();
    let require = |run: Run<'_>| {
        let run = Run {
            requires_position: true,
            ..run
        };
        let (summary, _) = run.import(&photos, &report);
        (summary.created, summary.skipped, summary.failed)
    };
    let csv = "file,lat,lon\na.jpg,1,2\n";
    assert_eq!(
        require(Run::new(&sink).with_positions(&photos, csv)),
        (1, 0, 1)
    );
    let failed = lines(&report);
    let failed = failed.iter().find(|line| line["status"] == "failed");
    let detail = failed.unwrap()["detail"].to_string();
    assert!(detail.contains("no UTM coordinates"), "{detail}");
    assert_eq!(require(Run::new(&sink)), (0, 1, 1));
    let (summary, _) = Run::new(&sink).import(&photos, &report);
    assert_eq!((summary.created, summary.warned), (1, 1));
}
